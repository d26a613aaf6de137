"""`vian demo`: one event's whole life on real video."""

import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated

import typer

from extractors import video as video_files
from store import open_log
from store.schema import safe_dsn
from vian import options
from vian.demo.cameras import CameraFound
from vian.demo.clip import Origin, choose, shown
from vian.demo.place import folder_for
from vian.demo.run import ANSWER_SQL, CENTRAL_DIR, Summary, obstacle, run_demo, summary_rows
from vian.errors import WorldFailed
from vian.options import open_from, settings_for
from vian.output import Output

REPORT = Path("vian-demo-report.html")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: vian demo --video gate.mp4 --data-dir ~/vian-demo")(demo)


def demo(
    video: Annotated[
        Path | None,
        typer.Option(
            "--video",
            help="Video file.",
            show_default="a sample clip: VIAN_DATA, download, or rendered",
            callback=options.existing,
        ),
    ] = None,
    rendered: Annotated[
        bool, typer.Option("--rendered", help="Show the street scene that ViAn renders itself; needs no network.")
    ] = False,
    report: Annotated[Path, typer.Option("--report", help="File of the HTML report.")] = REPORT,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    as_json: options.Json = False,
) -> None:
    """Turn videos into events, situations, an answer in SQL, a second log, and a report."""
    settings = settings_for(data_dir, dsn)
    output = Output(is_json=as_json)
    _check_writable(report)
    clip = choose(video, settings.data, output.note, is_rendered=rendered)
    output.note(f"clip: {clip.path}" + (f"\n{clip.attribution}" if clip.attribution else ""))
    if clip.origin is Origin.GIVEN:
        video_files.probe(clip.path)  # what is no video is told before two servers are started
    clips = shown(clip)
    if settings.dsn is None or data_dir is not None:
        folder = folder_for(settings.data_dir, lambda log: obstacle(log, clips), output.note)
        if folder != settings.data_dir:
            data_dir = folder
            settings = settings.model_copy(update={"data_dir": folder})
    summary = run_demo(
        lambda: open_from(settings, data_dir=data_dir),
        lambda: open_log(data_dir=settings.data_dir / CENTRAL_DIR),
        clips,
        report,
        output,
    )
    _print(summary, output, _place(data_dir, dsn))
    if not summary.is_sound:
        raise WorldFailed("the two logs do not verify or do not agree. Next: vian verify")


def _place(data_dir: Path | None, dsn: str | None) -> str:
    """The options by which another command finds this log; none for the default one."""
    if data_dir is not None:
        return f" --data-dir {shlex.quote(str(data_dir))}"
    return f" --dsn {shlex.quote(safe_dsn(dsn))}" if dsn is not None else ""


def _program() -> str:
    """How this program is called from here: by name if the shell finds it, else by its path."""
    if shutil.which("vian") is not None:
        return "vian"
    beside = Path(sys.executable).with_name("vian")
    here = Path.cwd()
    return str(beside.relative_to(here) if beside.is_relative_to(here) else beside)


def _print(summary: Summary, output: Output, place: str) -> None:
    if output.is_json:
        output.result(
            {
                "clip": str(summary.clips[0].path),
                "origin": summary.clips[0].origin,
                "frames": summary.frames,
                "events": summary.events,
                "bytes_per_event": round(summary.bytes_per_event, 2),
                "situations": {row["rule"]: row["situations"] for row in summary.situations.to_pylist()},
                "cameras": {found.source: _camera(found) for found in summary.cameras},
                "in_metres": list(summary.in_metres),
                "events_replicated": summary.events_replicated,
                "sound": summary.is_sound,
                "seconds": round(summary.seconds, 2),
                "report": str(summary.report.resolve()),
            }
        )
        return
    output.table(f"ViAn demo, {summary.seconds:.1f} s", ("what", "value"), summary_rows(summary))
    for title in summary.in_metres:
        output.line(f"in metres: {title}")
    output.line(f"report: {summary.report.resolve()}")
    program = _program()
    output.line(f'next:   {program} query{place} "{ANSWER_SQL}"')
    output.line(f'        {program} query{place} "SELECT type, count(*) FROM events GROUP BY ALL"')
    output.line(f"        {program} tail{place} --type situation_detected")


def _camera(found: CameraFound) -> dict[str, float | None]:
    """What was found of a camera, for machines."""
    estimate, calibration = found.estimate, found.calibration
    return {
        "slope": estimate.slope if estimate else None,
        "offset_px": estimate.offset_px if estimate else None,
        "focal_px": calibration.focal_px if calibration else None,
        "height_m": calibration.height_m if calibration else None,
    }


def _check_writable(report: Path) -> None:
    if not report.resolve().parent.is_dir() or report.is_dir():
        raise WorldFailed(f"the report cannot be written to {report}: no such folder. Next: give another --report FILE")
