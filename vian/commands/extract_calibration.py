"""`vian extract calibration`: a camera's calibration from the track points in the log."""

import math
from typing import Annotated

import typer

from extractors.calibration import CalibrationConfig, CameraHeight, KnownLength, PersonHeight, Scale
from store import Projector
from vian import options
from vian.calibrating import Calibrating, calibrate_from_tracks, config_for
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output, counted
from vian.settings import station_option

EXAMPLE = "Example: vian extract calibration --source gate --camera-height-m 6.5"
LENGTH_MIN_PX = 10.0
"""Nearer points of a known length say nothing: the hand is off by a pixel, px."""
LENGTHS_M = (0.01, 10_000.0)
"""Shortest and longest known length or height of a camera, m: a model on a table, a mountain."""
PEOPLE_M = (0.1, 10.0)
"""Lowest and highest mean height of who passes, m: the fit starts from people, and finds nobody far from them."""
HEIGHT_DEVIATION_SHARE = 0.02
"""Standard deviation of a height that somebody gives: measured with a tape or read off a plan."""


CameraHeightM = Annotated[
    float | None, typer.Option("--camera-height-m", help="Height of the camera above the ground, m, known within 2 %.")
]
Length = Annotated[
    str | None,
    typer.Option("--length", help="Two points of the ground, px, and their distance, m: X1,Y1,X2,Y2,METRES."),
]
PersonHeightM = Annotated[
    float | None,
    typer.Option("--person-height-m", help="Mean height of the people who pass, m.", show_default="1.70"),
]


def calibration(
    source: Annotated[str, typer.Option("--source", help="Name of the camera.")],
    camera_height_m: CameraHeightM = None,
    length: Length = None,
    person_height_m: PersonHeightM = None,
    is_replacing: Annotated[
        bool, typer.Option("--replace", help="Let it replace a calibration by hand, which stands otherwise.")
    ] = False,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Calibrate a camera from the upright people among its tracks; or say what is missing, which is no error."""
    scale = scale_of(camera_height_m, length, person_height_m, CalibrationConfig())
    settings = settings_for(data_dir, dsn, station=station)
    with opened(settings, data_dir=data_dir) as log:
        config = config_for(log, settings.station, source)
        done = calibrate_from_tracks(log, settings.station, source, config, scale, is_replacing=is_replacing)
        Projector(log).catch_up()
    _report(Output(is_json=as_json), source, done, station_option(settings.station))


def scale_of(
    camera_height_m: float | None, length: str | None, person_height_m: float | None, config: CalibrationConfig
) -> Scale:
    """Where metres come from, as the options say.

    Raises:
        WrongUsage: There are several, or one is not right.
    """
    if sum(each is not None for each in (camera_height_m, length, person_height_m)) > 1:
        raise WrongUsage("give one of --camera-height-m, --length and --person-height-m: metres come from one of them")
    if camera_height_m is not None:
        _check_between("--camera-height-m", camera_height_m, LENGTHS_M)
    if person_height_m is not None:
        _check_between("--person-height-m", person_height_m, PEOPLE_M)
    if camera_height_m is not None:
        return CameraHeight(camera_height_m, HEIGHT_DEVIATION_SHARE * camera_height_m)
    if length is not None:
        return _length(length)
    return PersonHeight(person_height_m or config.person_height_m, config.person_spread_m)


def _length(text: str) -> KnownLength:
    try:
        x1, y1, x2, y2, metres = (float(part) for part in text.split(","))
    except ValueError as error:
        raise WrongUsage(f"--length must be X1,Y1,X2,Y2,METRES such as 310,420,655,431,7.3, got {text!r}") from error
    if not all(math.isfinite(value) for value in (x1, y1, x2, y2)) or (x1, y1) == (x2, y2):
        raise WrongUsage(f"--length must be of two points apart, got {text!r}")
    _check_between("--length", metres, LENGTHS_M)
    if math.hypot(x2 - x1, y2 - y1) < LENGTH_MIN_PX:
        raise WrongUsage(
            f"--length must be of points at least {LENGTH_MIN_PX:g} px apart, where a pixel is a tenth, got {text!r}"
        )
    return KnownLength((x1, y1), (x2, y2), metres)


def _check_between(option: str, metres: float, limits: tuple[float, float]) -> None:
    low, high = limits
    if not low <= metres <= high:  # not a number is not between either
        raise WrongUsage(f"{option} must be from {low:g} to {high:g} m, got {metres:g}")


def _report(output: Output, source: str, done: Calibrating, station: str) -> None:
    event = done.newest
    values = {"source": source, "tracks": done.tracks, "points": done.points, "appended": done.appended}
    values |= {"reason": done.reason}
    if event is None:
        output.result(
            values | {"calibrated": False},
            f"{source} is not calibrated: no camera follows from {counted(done.tracks, 'track')} of "
            f"{counted(done.points, 'point')}: {done.reason}. Next: let more people pass and run this again, or "
            f"vian zones calibrate {source} POINTS.yaml{station} with points that you know",
        )
        return
    names = ("focal_px", "pitch_rad", "roll_rad", "height_m", "rms_m", "scale", "covariance")
    values |= {"calibrated": True} | {name: getattr(event, name) for name in names}
    output.result(
        values,
        f"{source} is calibrated from {counted(done.tracks, 'track')}: focal length {event.focal_px:.0f} px, "
        f"pitch {math.degrees(event.pitch_rad or 0):.1f}°, roll {math.degrees(event.roll_rad or 0):.1f}°, "
        f"height {event.height_m:.2f} m ({done.appended} events appended)",
    )
