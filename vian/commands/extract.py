"""`vian extract`: run an extractor on a video, on a live stream, or on what the log holds."""

import re
import threading
from pathlib import Path
from typing import Annotated

import typer

from extractors.addresses import Address, parsed
from extractors.calibration import CalibrationConfig, Scale
from extractors.live import LiveLimits
from extractors.media import Shape
from extractors.motion import Detector, MotionConfig, read_ignored_area
from extractors.motion.onnx import OnnxDetector
from store import Projector
from vian import options
from vian.calibrating import config_for
from vian.camera_folds import CameraConfig
from vian.commands import extract_calibration
from vian.errors import WrongUsage
from vian.extraction import Extraction, Job, extract_motion
from vian.horizon_extraction import HorizonExtraction, HorizonJob, extract_horizon
from vian.interrupts import stop_on_signals
from vian.options import has_zone, opened, settings_for, time_of
from vian.output import Output, counted
from vian.settings import Settings

app = typer.Typer(help="Run an extractor on a video or on tracks; its events go into the log.", no_args_is_help=True)

Again = Annotated[int, typer.Option("--again", help="Repeat it as process number N.", min=1)]
SIDE_MIN_PX = 32
"""Pictures are not made smaller than this: a person has a few lines there, px."""
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
    detector: Annotated[
        Path | None,
        typer.Option(
            "--detector",
            help="Model file (ONNX) that finds the objects.",
            show_default="what moves",
            callback=options.existing,
        ),
    ] = None,
    classes: Annotated[
        list[int] | None,
        typer.Option("--class", help="Number of a class of the model to follow; again for more.", show_default="all"),
    ] = None,
    is_without_horizon: Annotated[
        bool, typer.Option("--no-horizon", help="Do not look for the horizon meanwhile.")
    ] = False,
    is_without_calibration: Annotated[
        bool, typer.Option("--no-calibration", help="Do not calibrate the camera meanwhile.")
    ] = False,
    camera_height_m: extract_calibration.CameraHeightM = None,
    length: extract_calibration.Length = None,
    person_height_m: extract_calibration.PersonHeightM = None,
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
        Path | None,
        typer.Option(
            "--mask", help="PNG that is white where motion is ignored, black where not.", callback=options.existing
        ),
    ] = None,
    login_file: Annotated[
        Path | None,
        typer.Option("--login-file", help="File with `user:password` for the address.", callback=options.existing),
    ] = None,
    again: Again = 1,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Detect and track what moves in a video or live stream: its tracks, the camera's horizon and calibration."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    config, model = detection(detector, classes)
    camera = _camera(
        is_without_horizon,
        is_without_calibration,
        extract_calibration.scale_of(camera_height_m, length, person_height_m, CalibrationConfig()),
        is_of_blobs=model is None,
    )
    started_at = time_of("--start", start)
    if start is not None and started_at is not None and not has_zone(start):
        output.note(f"--start names no time zone: taken as UTC, {started_at.isoformat()}")
    place = _place(video, login_file)
    shape, ignored = _shape(fps, resize), read_ignored_area(mask) if mask else None
    stopping = stop_on_signals() if isinstance(place, Address) else threading.Event()
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
                config=config,
                detector=model,
                camera=camera,
                shape=shape,
                ignored=ignored,
                live=_live_limits(settings),
                ca_file=_ca_file(settings),
                run=again,
                database_wait_s=settings.database_wait_s,
                on_progress=show,
                on_note=output.note,
                is_stopped=stopping.is_set,
            )
        )
        Projector(log).catch_up()
    report(output, extraction)


def detection(path: Path | None, classes: list[int] | None) -> tuple[MotionConfig, Detector | None]:
    """The configuration and the detector that are asked for.

    Raises:
        WrongUsage: Classes without a model.
        DetectorFailed: The model file cannot be opened.
    """
    if path is None:
        if classes:
            raise WrongUsage("--class needs --detector. Next: name the model file whose classes are meant")
        return MotionConfig(), None
    chosen = tuple(sorted(set(classes))) if classes else None
    model = OnnxDetector(path, chosen)
    return MotionConfig(detector=model.sha256, classes=chosen), model


@app.command(epilog="Example: vian extract horizon --source gate")
def horizon(
    source: Annotated[str, typer.Option("--source", help="Name of the camera whose track points are in the log.")],
    again: Again = 1,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Find the horizon from the track points that a log holds of a source: votes and estimates."""
    settings = settings_for(data_dir, dsn, station=station)
    output = Output(is_json=as_json)
    with opened(settings, data_dir=data_dir) as log:
        job = HorizonJob(
            log=log,
            station=settings.station,
            source=source,
            config=config_for(log, settings.station, source).camera,
            run=again,
            database_wait_s=settings.database_wait_s,
            on_note=output.note,
        )
        extraction = extract_horizon(job)
        Projector(log).catch_up()
    report_horizon(output, extraction)


def report_horizon(output: Output, extraction: HorizonExtraction) -> None:
    """Print where the horizon is."""
    found = extraction.estimate
    values = {
        "process": extraction.process,
        "source": extraction.source,
        "events": extraction.events,
        "slope": found.slope if found else None,
        "offset_px": found.offset_px if found else None,
        "was_done": extraction.was_done,
    }
    text = f"process {extraction.process}: {extraction.events} votes and estimates; "
    if found is None:
        text += "the tracks do not decide where the horizon is"
    else:
        text += f"horizon y = {found.slope:.4f} x {found.offset_px:+.1f} px of {found.width}x{found.height}"
    if extraction.was_done:
        text += " (done in an earlier run; --again 2 repeats it as a new process)"
    output.result(values, text)


app.command(epilog=extract_calibration.EXAMPLE)(extract_calibration.calibration)


def _place(video: str, login_file: Path | None) -> Path | Address:
    """What the command line names, with its login."""
    place = parsed(video)
    if isinstance(place, Path):
        options.existing(place)
    if login_file is None:
        return place
    if not isinstance(place, Address):
        raise WrongUsage(f"--login-file is for an address, got the file {video}. Next: leave it out")
    try:
        login = login_file.read_text(encoding="utf-8")
    except OSError as error:
        raise WrongUsage(
            f"--login-file {login_file} cannot be read: {error.strerror}. Next: chmod u+r {login_file}, or give a file"
        ) from error
    except UnicodeDecodeError as error:
        raise WrongUsage(
            f"--login-file {login_file} is no text. Next: write `user:password` into it, one line of UTF-8"
        ) from error
    return place.with_login(login)


def _camera(is_without_horizon: bool, is_without_calibration: bool, scale: Scale, *, is_of_blobs: bool) -> CameraConfig:
    """What is to be found of the camera."""
    calibration = CalibrationConfig() if is_of_blobs else CalibrationConfig.of_boxes()
    return CameraConfig(
        horizon=None if is_without_horizon else calibration.camera,
        calibration=None if is_without_calibration else calibration,
        scale=scale,
    )


def _shape(fps: float | None, resize: str | None) -> Shape:
    """Which pictures are wanted."""
    if fps is not None and not 0 < fps <= 1000:
        raise WrongUsage(f"--fps must be above 0 and at most 1000, got {fps:g}")
    if resize is None:
        return Shape(fps=fps)
    size = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", resize)
    if size is None:
        raise WrongUsage(f"--resize must be WIDTHxHEIGHT in px, such as 1280x720, got {resize!r}")
    width, height = int(size[1]), int(size[2])
    if min(width, height) < SIDE_MIN_PX:
        raise WrongUsage(f"--resize must leave at least {SIDE_MIN_PX} px of each side, got {resize!r}")
    return Shape(width_max=width, height_max=height, fps=fps)


def _live_limits(settings: Settings) -> LiveLimits:
    return LiveLimits(
        connect_s=settings.live_connect_s,
        stall_s=settings.live_stall_s,
        retry_s_min=settings.live_retry_s_min,
        retry_s_max=max(settings.live_retry_s_min, settings.live_retry_s_max),
        give_up_s=settings.live_give_up_h * 3600,
        queue_frames=settings.live_queue_frames,
    )


def _ca_file(settings: Settings) -> Path | None:
    """The certificates that count for cameras, as an absolute path that can be read."""
    if settings.live_ca_file is None:
        return None
    try:
        settings.live_ca_file.read_bytes()
    except OSError as error:
        raise WrongUsage(
            f"live_ca_file {settings.live_ca_file} cannot be read: {error.strerror}. "
            "Next: name a file of certificates (PEM) in vian.toml or VIAN_LIVE_CA_FILE"
        ) from error
    return settings.live_ca_file.absolute()


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
        f"process {extraction.process}: {counted(extraction.frames, 'frame')}, {counted(extraction.events, 'event')} "
        f"found besides the process's own, {counted(extraction.gaps, 'gap')}"
    )
    if not extraction.events:
        text += ": nothing moved that was large and steady enough"
    if extraction.was_done:
        text += " (done in an earlier run; --again 2 repeats it as a new process)"
    output.result(values, text)
