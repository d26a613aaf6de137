"""`vian zones`: zones, lines and calibrations that rules share, each change an event of its source."""

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import typer
from pydantic import TypeAdapter, ValidationError

from events import source_name
from patterns.files.rule import Name
from patterns.scene.geometry import Line, Units, Zone
from store import Log
from vian import options
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.options import opened, settings_for
from vian.output import Output
from vian.settings import station_option
from vian.zoning import (
    GroundPoint,
    Standing,
    calibrate,
    calibrated,
    define,
    filmed,
    frame_size_of,
    parsed_points,
    points_of,
    points_of_file,
    remove,
    standing,
    zones_of_file,
)

app = typer.Typer(help="Draw zones and lines that rules share by name, and calibrate cameras.", no_args_is_help=True)

FIT_SHARE = 0.02
"""Root mean square by which known points may miss each other, of their extent: more is a slip, or no plane."""
ZoneName = Annotated[str, typer.Argument(metavar="NAME", help="Name of the zone or line.")]
Source = Annotated[str, typer.Option("--source", help="The source that it belongs to.")]
Author = Annotated[str | None, typer.Option("--author", help="Who makes the change.")]
Reason = Annotated[str | None, typer.Option("--reason", help="Why.")]


@app.command(name="list", epilog="Example: vian zones list --source cam-07")
def list_zones(
    sources: options.Sources = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """List the zones and lines that stand, with the version and when it was drawn, by whom and why."""
    settings = settings_for(data_dir, dsn, station=station)
    with opened(settings, data_dir=data_dir) as log:
        known = standing(log, settings.station)
    found = [each for (source, _), each in sorted(known.items()) if not sources or source in sources]
    columns = ("source", "name", "kind", "version", "units", "points", "drawn at", "author", "reason")
    Output(is_json=as_json).table("", columns, [_row(each) for each in found])


@app.command(name="define", epilog="Example: vian zones define yard --source cam-07 --zone '0.1,0.5 0.6,0.5 0.6,0.9'")
def define_zone(
    name: ZoneName,
    source: Source,
    zone: Annotated[str | None, typer.Option("--zone", help="Corners of a zone, as 'x,y x,y x,y ...'.")] = None,
    line: Annotated[str | None, typer.Option("--line", help="The two points of a line, as 'x,y x,y'.")] = None,
    units: Annotated[str, typer.Option("--units", help="normalised (shares of the frame), pixels or metres.")] = (
        "normalised"
    ),
    author: Author = None,
    reason: Reason = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Draw a zone or line, or draw it anew as its next version; rules that share it use it from here on."""
    settings = settings_for(data_dir, dsn, station=station)
    shape = _shape(name, source, zone, line, units)
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        events = define(log, settings.station, {name: shape}, utc_now(), author=author, reason=reason)
        doubt = _unfilmed(log, settings.station, source)
    output = Output(is_json=as_json)
    if doubt is not None:
        output.note(doubt)
    if not events:
        output.result({"zone": name, "source": source, "changed": False}, f"{source}/{name} stands so already")
    for event in events:
        values = {"zone": name, "source": source, "changed": True, "version": event.zone_version}
        output.result(values, f"{source}/{name} is defined, version {event.zone_version}")


@app.command(name="remove", epilog="Example: vian zones remove yard --source cam-07 --reason 'sold'")
def remove_zone(
    name: ZoneName,
    source: Source,
    author: Author = None,
    reason: Reason = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Take a zone or line away; rules that share it find nothing in it any more."""
    settings = settings_for(data_dir, dsn, station=station)
    with opened(settings, data_dir=data_dir) as log:
        event = remove(log, settings.station, name, source, utc_now(), author=author, reason=reason)
    values = {"zone": name, "source": source, "version": event.zone_version}
    Output(is_json=as_json).result(values, f"{source}/{name} is removed; its last version was {event.zone_version}")


@app.command(name="import", epilog="Example: vian zones import zones.yaml --reason 'survey of June'")
def import_zones(
    file: Annotated[
        Path, typer.Argument(help="A YAML file with `zones:` and `lines:` as in rule files.", callback=options.existing)
    ],
    author: Author = None,
    reason: Reason = None,
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Draw all zones and lines of a file; those that stand so already are left as they are."""
    settings = settings_for(data_dir, dsn, station=station)
    shapes = zones_of_file(file)
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        events = define(log, settings.station, shapes, utc_now(), author=author, reason=reason)
    values = {"zones": len(shapes), "changed": len(events)}
    Output(is_json=as_json).result(values, f"{len(shapes)} zones and lines read, {len(events)} new or changed")


@app.command(epilog="Example: vian zones draw --source cam-07 -o zones.png")
def draw(
    source: Source,
    output_file: Annotated[Path, typer.Option("--output", "-o", help="The PNG file to write.")],
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Draw a source's zones and lines over a frame of its newest video, or over nothing if the video is not at hand."""
    settings = settings_for(data_dir, dsn, station=station)
    with opened(settings, data_dir=data_dir) as log:
        shapes, missing = _drawn(log, settings.station, source, output_file)
    output = Output(is_json=as_json)
    if missing:
        output.note(f"drawn without the picture: {missing}")
    output.result({"file": str(output_file), "shapes": shapes}, f"{shapes} zones and lines drawn to {output_file}")


@app.command(name="calibrate", epilog="Example: vian zones calibrate cam-07 points.yaml")
def calibrate_source(
    source: Annotated[str, typer.Argument(help="The source to calibrate.")],
    file: Annotated[
        Path,
        typer.Argument(
            help="A YAML file with `points:`, four or more, each with `px:` x, y and `m:` east, north.",
            callback=options.existing,
        ),
    ],
    data_dir: options.DataDir = None,
    dsn: options.Dsn = None,
    station: options.Station = None,
    as_json: options.Json = False,
) -> None:
    """Calibrate a camera from points of the ground that are known in its picture and in metres."""
    settings = settings_for(data_dir, dsn, station=station)
    source_name(source)
    read = points_of_file(file)
    with opened(settings, data_dir=data_dir, is_made=True) as log:
        size = read.frame or frame_size_of(log, settings.station, source)
        if size is None:
            raise WrongUsage(
                f"the size of {source}'s frames is not known: the log has no video of it; it has of: "
                f"{_told(filmed(log))}. Next: correct the name, or add `frame: [1920, 1080]` to {file}"
            )
        calibration, rms_m = calibrated(read.points, size)
        position = calibrate(log, settings.station, source, calibration, rms_m, utc_now())
        doubt = _unfilmed(log, settings.station, source)
    values = {"source": source, "points": len(read.points), "rms_m": rms_m, "homography": calibration.matrix}
    met = "four always fit: a fifth shows how well" if len(read.points) == 4 else f"met within {rms_m:.3f} m (rms)"
    output = Output(is_json=as_json)
    if doubt is not None:
        output.note(doubt)
    if rms_m > FIT_SHARE * _extent(read.points):
        output.note(
            f"warning: the points miss each other by {rms_m:.3f} m: one of them is wrong, or the ground is no plane. "
            f"Next: correct {file} and calibrate again; the newest counts"
        )
    output.result(values | {"position": position}, f"{source} is calibrated from {len(read.points)} points; {met}")
    output.note(
        "It is of the view of the newest footage: it holds from there on and, where none was valid before, back to the "
        "camera's last move. "
        f'All of the view: vian query "SELECT * FROM track_ground" --source {source} --calibration {position}'
    )


def _extent(points: Sequence[GroundPoint]) -> float:
    """Diagonal of the rectangle that holds the points on the ground, m."""
    east, north = zip(*(point.m for point in points), strict=True)
    return math.hypot(max(east) - min(east), max(north) - min(north))


def _unfilmed(log: Log, station: str, source: str) -> str | None:
    """What is to be said where the log has videos, and none of this source; None: nothing."""
    known = filmed(log)
    if not known or (station, source) in known:
        return None
    return f"warning: the log has no video of {source} of station {station} yet; it has of: {_told(known)}"


def _told(known: Collection[tuple[str, str]]) -> str:
    """The sources, each with the option that its station needs."""
    return ", ".join(f"{source}{station_option(station)}" for station, source in sorted(known)) or "none"


def _row(each: Standing) -> tuple[Any, ...]:
    event = each.event
    points = " ".join(f"{x:g},{y:g}" for x, y in points_of(each.shape))
    return (
        each.source, each.name, event.kind, event.zone_version, event.units, points, event.time, event.author,
        event.reason,
    )  # fmt: skip


def _shape(name: str, source: str, zone: str | None, line: str | None, units: str) -> Zone | Line:
    source_name(source)
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError as error:
        raise WrongUsage(f"NAME is 1 to 64 of A-Z a-z 0-9 . _ -, got {name!r}") from error
    if (zone is None) == (line is None):
        raise WrongUsage(f"give either --zone or --line, got {'neither' if zone is None else 'both'}")
    if units not in get_args(Units):
        raise WrongUsage(f"--units must be normalised, pixels or metres, got {units!r}")
    option, text = ("--zone", zone) if zone is not None else ("--line", line)
    points = parsed_points(option, str(text))
    try:
        if zone is not None:
            return Zone.model_validate({"source": source, "units": units, "polygon": points})
        return Line.model_validate({"source": source, "units": units, "points": points})
    except ValidationError as error:
        said = str(error.errors()[0]["msg"]).removeprefix("Value error, ")
        raise WrongUsage(f"{option} of {name}: {said}") from error


def _drawn(log: Log, station: str, source: str, file: Path) -> tuple[int, str]:
    """Draw the source's zones and lines; how many, and what is missing of the picture."""
    from vian.drawings import Drawing, Shape, drawn, write_png  # OpenCV is slow to import
    from vian.footage import footage_of

    known = [each for (of, _), each in sorted(standing(log, station).items()) if of == source]
    footage = footage_of(log, station, source, utc_now(), 0)
    size = footage.size or (1920, 1080)
    shapes, left_out = [], []
    for each in known:
        if each.shape.units == "metres":
            left_out.append(each.name)
            continue
        points = each.shape.scaled(tuple((x, y) for x, y in points_of(each.shape)), size)
        shapes.append(Shape(each.name, [(float(x), float(y)) for x, y in points], isinstance(each.shape, Zone)))
    captions = [f"{source}: {len(shapes)} zones and lines"]
    captions += [f"in metres, not drawn: {', '.join(left_out)}"] if left_out else []
    write_png(drawn(Drawing(size, footage.picture, shapes, captions=captions, has_scale=True)), file)
    return len(shapes), footage.missing
