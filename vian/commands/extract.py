"""`vian extract`: run an extractor on a video, or on what the log holds."""

from pathlib import Path
from typing import Annotated

import typer

from extractors.motion import MotionConfig
from store import Projector
from vian import options
from vian.commands import extract_calibration
from vian.extraction import Extraction, Job, extract_motion
from vian.options import has_zone, opened, settings_for, time_of
from vian.output import Output

app = typer.Typer(help="Run an extractor on a video or on tracks; its events go into the log.", no_args_is_help=True)

_EXAMPLE = "Example: vian extract motion gate.mp4 --source gate --start 2026-01-31T12:00:00Z"


@app.command(epilog=_EXAMPLE)
def motion(
    video: Annotated[Path, typer.Argument(help="Video file.")],
    source: Annotated[str, typer.Option("--source", help="Name of the camera that recorded it.")],
    start: Annotated[
        str | None,
        typer.Option(
            "--start",
            help="Time of the first frame (ISO 8601, UTC).",
            show_default="from the file's metadata, else its modification time",
        ),
    ] = None,
    again: Annotated[int, typer.Option("--again", help="Repeat it as process number N.", min=1)] = 1,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Detect and track what moves in a video: track points, ended tracks, activity intervals."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    started_at = time_of("--start", start)
    if start is not None and started_at is not None and not has_zone(start):
        output.note(f"--start names no time zone: taken as UTC, {started_at.isoformat()}")
    with opened(settings, data_dir=data_dir, is_made=True) as log, output.progress("frames", None) as bar:

        def show(done: int, expected: int | None) -> None:
            bar.at(done, expected)

        extraction = extract_motion(
            Job(
                log=log,
                station=settings.station,
                source=source,
                path=video,
                started_at=started_at,
                config=MotionConfig(),
                run=again,
                database_wait_s=settings.database_wait_s,
                on_progress=show,
                on_note=output.note,
            )
        )
        Projector(log).catch_up()
    report(output, extraction)


app.command(epilog=extract_calibration.EXAMPLE)(extract_calibration.calibration)


def report(output: Output, extraction: Extraction) -> None:
    """Print what an extraction came to."""
    values = {
        "process": extraction.process,
        "source": extraction.source,
        "frames": extraction.frames,
        "events": extraction.events,
        "gaps": extraction.gaps,
        "was_done": extraction.was_done,
    }
    text = (
        f"process {extraction.process}: {extraction.frames} frames, {extraction.events} events found besides the "
        f"process's own, {extraction.gaps} gaps"
    )
    if extraction.was_done:
        text += " (done in an earlier run; --again 2 repeats it as a new process)"
    output.result(values, text)
