"""The demo's report: one self-contained HTML page that opens offline.

For each camera: tracks over a frame, the horizon that they showed, the rules' zones and lines, a timeline of
situations, and for each situation a picture with the object's box. Everything is read from the log; only the
pictures come from the video.
"""

import base64
import colorsys
import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import jinja2
import numpy as np
import numpy.typing as npt

from extractors.media import Frame
from extractors.video import frames
from patterns.files.rule import Rule
from store import Log
from vian.demo.cameras import CameraFound
from vian.errors import WorldFailed
from vian.querying import query

Image = npt.NDArray[np.uint8]
Pixels = npt.NDArray[np.float64]
"""Corners (n, 2) in pixels."""

THUMBNAILS_MAX = 48
"""Situations that get a picture; more are listed without one."""
BRIEF_SECONDS = 3.0
"""Tracks shorter than this are drawn faintly."""
BEYOND_MAX = 1.0
"""How far above the frame a horizon is drawn at most, frame heights."""
_THUMBNAIL_HEIGHT_PX = 220
_JPEG_QUALITY = 82
_GOLDEN_ANGLE = 0.381966
_TIME = re.compile(r"\b\d{4}-\d\d-\d\dT(\d\d:\d\d:\d\d(?:\.\d)?)\d*Z")


@dataclass(frozen=True, slots=True)
class Track:
    """One track as the report draws it."""

    track_id: int
    points: str
    """SVG polyline in pixels"""
    colour: str
    x_start: float
    y_start: float
    left_percent: float
    width_percent: float
    seconds: float

    @property
    def is_brief(self) -> bool:
        """Whether it is too short to say much: flicker more often than somebody."""
        return self.seconds < BRIEF_SECONDS


@dataclass(frozen=True, slots=True)
class Shape:
    """A place that rules name, in pixels."""

    points: str
    is_zone: bool
    x: float
    """of its highest corner"""
    y: float


@dataclass(frozen=True, slots=True)
class Situation:
    """One situation as the report shows it."""

    situation: str
    rule: str
    version: int
    severity: str
    title: str
    headline: str
    """the title, its times without date and microseconds"""
    began_at: datetime
    ended_at: datetime
    seconds_in: float
    """when it ended, s from the video's start"""
    left_percent: float
    width_percent: float
    track: str
    frame: int | None
    evidence: str
    """its events: pattern variable and sequences"""
    picture: str | None
    """data URI"""


@dataclass(frozen=True, slots=True)
class View:
    """One camera that the report shows."""

    video: Path
    attribution: str | None
    camera: CameraFound
    rules: Sequence[Rule]


@dataclass(frozen=True, slots=True)
class Drawn:
    """The horizon as the report draws it, in pixels."""

    line: str
    """SVG polyline"""
    band: str
    """SVG polygon: its 95 % interval"""
    true: str | None
    """SVG polyline, of a rendered scene"""
    top: float
    """where the drawing begins, at most 0: a horizon may lie above the frame"""


@dataclass(frozen=True, slots=True)
class Facts:
    """What the report tells beside its pictures."""

    summary: Sequence[tuple[str, str]]
    station: str
    answer_sql: str
    answer: Sequence[Sequence[Any]]
    answer_columns: Sequence[str]


@dataclass(frozen=True, slots=True)
class _Deciding:
    """The track point that decided a situation."""

    frame: int
    box_xyxy: tuple[float, float, float, float]


def write_report(log: Log, views: Sequence[View], facts: Facts, file: Path) -> None:
    """Write the report of these cameras to the file.

    Raises:
        WorldFailed: The file cannot be written.
    """
    page = _template().render(
        facts=facts, brief=f"{BRIEF_SECONDS:g}", scenes=[_scene(log, facts.station, view) for view in views]
    )
    try:
        file.write_text(page, encoding="utf-8")
    except OSError as error:
        raise WorldFailed(
            f"the report cannot be written to {file}: {error.strerror}; all else is done. "
            "Next: the same command with another --report FILE"
        ) from error


def _scene(log: Log, station: str, view: View) -> dict[str, Any]:
    """What the template shows of one camera."""
    place = f"station = '{station}' and source = '{view.camera.source}'"
    added = query(log, f"select * from video_added where {place} order by sequence desc limit 1").to_pylist()[0]
    size = (added["width"], added["height"])
    start: datetime = added["started_at"]
    points = query(
        log,
        "select track_id, frame, time, x, y, x1, y1, x2, y2, sequence "
        f"from track_point where {place} order by sequence",
    ).to_pylist()
    found = query(log, f"select * from situation_detected where {place} order by ended_at, sequence").to_pylist()
    span_s = max([(row["time"] - start).total_seconds() for row in points], default=1.0) or 1.0
    by_sequence = {point["sequence"]: point for point in points}
    deciding = [_deciding(row, by_sequence) for row in found]
    quiet = _quiet_frame({point["frame"] for point in points})
    wanted = {d.frame for d in deciding[:THUMBNAILS_MAX] if d} | {quiet}
    pictures = {frame.index: frame.image for frame in _frames(view.video, wanted)}
    return {
        "view": view,
        "size": size,
        "unit": 11 * max(size[0] / 1140, size[1] / 720),  # 11 px where the picture is shown in at most 1140 x 720
        "span_s": span_s,
        "background": _data_uri(pictures.get(quiet)),
        "quiet": quiet,
        "horizon": _horizon(view.camera, size),
        "tracks": _tracks(points, start, span_s),
        "shapes": _shapes(view.rules, size),
        "ticks": _ticks(span_s),
        "rules": view.rules,
        "situations": [
            _situation(row, point, start, span_s, pictures if number < THUMBNAILS_MAX else {})
            for number, (row, point) in enumerate(zip(found, deciding, strict=True))
        ],
    }


def _horizon(camera: CameraFound, size: tuple[int, int]) -> Drawn | None:
    """The horizon, its interval, and the true one; None where the tracks did not decide it."""
    line = camera.horizon
    if line is None:
        return None
    width, height = size
    x = np.linspace(0, width, 9)
    reach = line.reach_at(x)
    band = np.concatenate([np.stack([x, line.at(x) - reach], 1), np.stack([x, line.at(x) + reach], 1)[::-1]])
    top = float(np.clip((line.at(x) - reach).min() - 0.03 * height, -BEYOND_MAX * height, 0))
    true = None if camera.true_horizon is None else _svg_points(np.stack([x, camera.true_horizon.at(x)], 1))
    return Drawn(_svg_points(np.stack([x, line.at(x)], 1)), _svg_points(band), true, top)


def _tracks(points: Sequence[dict[str, Any]], start: datetime, span_s: float) -> list[Track]:
    by_track: dict[int, list[dict[str, Any]]] = {}
    for point in points:
        by_track.setdefault(point["track_id"], []).append(point)
    tracks = []
    for number, (track_id, own) in enumerate(by_track.items()):
        began, ended = ((own[i]["time"] - start).total_seconds() for i in (0, -1))
        tracks.append(
            Track(
                track_id=track_id,
                points=" ".join(f"{point['x']:.1f},{point['y']:.1f}" for point in own),
                colour=_colour(number),
                x_start=own[0]["x"],
                y_start=own[0]["y"],
                left_percent=100 * began / span_s,
                width_percent=max(0.3, 100 * (ended - began) / span_s),
                seconds=ended - began,
            )
        )
    return tracks


def _shapes(rules: Sequence[Rule], size: tuple[int, int]) -> dict[Shape, list[str]]:
    """Each place once, with all its names and the rules that give them."""
    named = []
    for rule in rules:
        zones = [(name, zone.scaled(zone.polygon, size), True) for name, zone in rule.zones.items()]
        lines = [(name, line.points_px(size), False) for name, line in rule.lines.items()]
        named += [(f"{name} ({rule.rule})", _shape(pixels, is_zone)) for name, pixels, is_zone in [*zones, *lines]]
    return {place: sorted({name for name, other in named if other == place}) for _, place in named}


def _shape(pixels: Pixels, is_zone: bool) -> Shape:
    x, y = min(pixels, key=lambda corner: float(corner[1]))
    return Shape(_svg_points(pixels), is_zone, float(x), float(y))


def _svg_points(pixels: Pixels) -> str:
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pixels)


def _situation(
    row: dict[str, Any], point: _Deciding | None, start: datetime, span_s: float, pictures: dict[int, Image]
) -> Situation:
    began, ended = ((row[name] - start).total_seconds() for name in ("began_at", "ended_at"))
    picture = pictures.get(point.frame) if point else None
    return Situation(
        situation=row["situation"],
        rule=row["rule"],
        version=row["rule_version"],
        severity=row["severity"],
        title=row["title"],
        headline=_TIME.sub(r"\1", row["title"]),
        began_at=row["began_at"],
        ended_at=row["ended_at"],
        seconds_in=ended,
        left_percent=100 * began / span_s,
        width_percent=max(0.6, 100 * (ended - began) / span_s),
        track=str(json.loads(row["partition"]).get("track_id", "")),
        frame=point.frame if point else None,
        evidence="; ".join(
            f"{r['variable']} {r['stream']} {r['first_sequence']}..{r['last_sequence']}" for r in row["lineage"]
        ),
        picture=_data_uri(_thumbnail(picture, point)) if picture is not None and point else None,
    )


def _deciding(row: dict[str, Any], points: dict[int, dict[str, Any]]) -> _Deciding | None:
    """The last track point of the situation's lineage; None where it rests on other events."""
    last = [r["last_sequence"] for r in row["lineage"] if r["stream"].endswith("/track_point")]
    point = points.get(max(last)) if last else None
    return _Deciding(point["frame"], (point["x1"], point["y1"], point["x2"], point["y2"])) if point else None


def _quiet_frame(tracked: set[int]) -> int:
    """A frame for the background: in the middle of the longest time without tracks, else the first."""
    ends = [-1, *sorted(tracked)]
    before, after = max(pairwise(ends), key=lambda pair: pair[1] - pair[0], default=(0, 0))
    return (before + after) // 2 if after - before > 1 else 0


def _frames(video: Path, wanted: set[int]) -> Iterable[Frame]:
    last = max(wanted)
    for item in frames(video):
        if isinstance(item, Frame):
            if item.index in wanted:
                yield item
            if item.index >= last:
                return


def _thumbnail(image: Image, point: _Deciding) -> Image:
    """The picture around the box, which is drawn in."""
    height, width = image.shape[:2]
    x1, y1, x2, y2 = point.box_xyxy
    side = min(max(16.0, x2 - x1, y2 - y1) * 1.6, height)
    left = int(np.clip((x1 + x2 - 4 * side / 3) / 2, 0, max(0, width - 4 * side / 3)))
    top = int(np.clip((y1 + y2 - side) / 2, 0, max(0, height - side)))
    cut = image[top : top + int(side), left : left + int(4 * side / 3)]
    scale = _THUMBNAIL_HEIGHT_PX / cut.shape[0]
    drawn = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    corners = [(round((x - left) * scale), round((y - top) * scale)) for x, y in ((x1, y1), (x2, y2))]
    cv2.rectangle(drawn, corners[0], corners[1], (40, 190, 255), 2)
    return np.asarray(drawn, np.uint8)


def _data_uri(image: Image | None) -> str | None:
    if image is None:
        return None
    is_encoded, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    assert is_encoded, "OpenCV encodes any 8-bit image as JPEG"
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def _colour(number: int) -> str:
    red, green, blue = colorsys.hls_to_rgb(number * _GOLDEN_ANGLE % 1.0, 0.58, 0.85)
    return f"#{round(red * 255):02x}{round(green * 255):02x}{round(blue * 255):02x}"


def _ticks(span_s: float) -> list[tuple[float, str]]:
    """Marks of the time axis: place in percent and label, about eight of them."""
    steps = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600)
    step = next((s for s in steps if span_s / s <= 9), steps[-1])
    return [(100 * at / span_s, f"{at // 60}:{at % 60:02d}") for at in range(0, int(span_s) + 1, step)]


def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("vian.demo", "templates"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    return environment.get_template("report.html.j2")
