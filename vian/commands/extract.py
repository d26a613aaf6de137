"""`vian extract`: run an extractor on a video or a live stream."""

import re
import signal
import threading
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from extractors.addresses import Address, parsed
from extractors.live import LiveLimits
from extractors.media import Shape
from extractors.motion import MotionConfig, read_ignored_area
from store import Projector
from vian import options
from vian.errors import WrongUsage
from vian.extraction import Extraction, Job, extract_motion
from vian.options import has_zone, opened, settings_for, time_of
from vian.output import Output
from vian.settings import Settings

app = typer.Typer(help="Run an extractor on a video; its events go into the log.", no_args_is_help=True)

_EXAMPLE = "Example: vian extract motion gate.mp4 --source gate --start 2026-01-31T12:00:00Z"


@app.command(epilog=_EXAMPLE)
def motion(
    video: Annotated[
        str,
        typer.Argument(
            metavar="VIDEO",
            help="Video file, folder of pictures, address of a live stream (rtsp, rtsps, http, https), or number "
            "of a camera of this machine.",
        ),
    ],
    source: Annotated[str, typer.Option("--source", help="Name of the camera that recorded it.")],
    start: Annotated[
        str | None,
        typer.Option(
            "--start",
            help="Time of the first frame (ISO 8601, UTC).",
            show_default="from the file's metadata, else its modification time; of a live stream from itself",
        ),
    ] = None,
    fps: Annotated[
        float | None,
        typer.Option(
            "--fps", help="Use at most so many pictures per second; of a folder: they were taken at this rate."
        ),
    ] = None,
    resize: Annotated[
        str | None,
        typer.Option("--resize", help="Largest size of a picture, such as 1280x720; events stay in the video's px."),
    ] = None,
    mask: Annotated[
        Path | None, typer.Option("--mask", help="PNG that is white where motion is ignored, black where not.")
    ] = None,
    login_file: Annotated[
        Path | None, typer.Option("--login-file", help="File with `user:password` for the address.")
    ] = None,
    again: Annotated[int, typer.Option("--again", help="Repeat it as process number N.", min=1)] = 1,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Detect and track what moves in a video or live stream: track points, ended tracks, activity intervals."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    started_at = time_of("--start", start)
    if start is not None and started_at is not None and not has_zone(start):
        output.note(f"--start names no time zone: taken as UTC, {started_at.isoformat()}")
    place = _place(video, login_file)
    shape, ignored = _shape(fps, resize), read_ignored_area(mask) if mask else None
    stopping = _stop_on_signals() if isinstance(place, Address) else threading.Event()
    with opened(settings, data_dir=data_dir, is_made=True) as log, output.progress("frames", None) as bar:

        def show(done: int, expected: int | None) -> None:
            bar.at(done, expected)

        extraction = extract_motion(
            Job(
                log=log,
                station=settings.station,
                source=source,
                path=place,
                started_at=started_at,
                config=MotionConfig(),
                shape=shape,
                ignored=ignored,
                live=_live_limits(settings),
                run=again,
                database_wait_s=settings.database_wait_s,
                on_progress=show,
                on_note=output.note,
                is_stopped=stopping.is_set,
            )
        )
        Projector(log).catch_up()
    report(output, extraction)


def _place(video: str, login_file: Path | None) -> Path | Address:
    """What the command line names, with its login."""
    place = parsed(video)
    if login_file is None:
        return place
    if not isinstance(place, Address):
        raise WrongUsage(f"--login-file is for an address, got the file {video}. Next: leave it out")
    try:
        login = login_file.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise WrongUsage(f"--login-file {login_file} cannot be read: {error}") from error
    return place.with_login(login)


def _shape(fps: float | None, resize: str | None) -> Shape:
    """Which pictures are wanted."""
    if fps is not None and not 0 < fps <= 1000:
        raise WrongUsage(f"--fps must be above 0 and at most 1000, got {fps:g}")
    if resize is None:
        return Shape(fps=fps)
    size = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", resize)
    if size is None:
        raise WrongUsage(f"--resize must be WIDTHxHEIGHT in px, such as 1280x720, got {resize!r}")
    return Shape(width_max=int(size[1]), height_max=int(size[2]), fps=fps)


def _live_limits(settings: Settings) -> LiveLimits:
    return LiveLimits(
        connect_s=settings.live_connect_s,
        stall_s=settings.live_stall_s,
        retry_s_min=settings.live_retry_s_min,
        retry_s_max=max(settings.live_retry_s_min, settings.live_retry_s_max),
        give_up_s=settings.live_give_up_h * 3600,
        queue_frames=settings.live_queue_frames,
    )


def _stop_on_signals() -> threading.Event:
    """An event that SIGINT or SIGTERM sets: a live stream has no end of its own."""
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stopping


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
    if not extraction.events:
        text += ": nothing moved that was large and steady enough"
    if extraction.was_done:
        text += " (done in an earlier run; --again 2 repeats it as a new process)"
    output.result(values, text)
