"""Drawings: what lies where, against exact places on a blank frame."""

import numpy as np
import pytest

from patterns.files.loading import parse_rule
from patterns.scene.geometry import Zone
from patterns.scene.ground import Calibration
from patterns.scene.site import CALIBRATION, Site, Version
from vian.drawings import Dot, Drawing, Image, Mark, Shape, drawn
from vian.tracing import place_of, shapes_of

BLANK, YELLOW, RED = (60, 60, 60), (60, 215, 250), (40, 40, 235)


def is_near(picture: Image, colour: tuple[int, int, int], x: int, y: int, far: int = 4) -> bool:
    """Whether the colour is within so many pixels of the place."""
    here = picture[max(y - far, 0) : y + far + 1, max(x - far, 0) : x + far + 1].astype(int)
    return bool((np.abs(here - colour).max(axis=2) < 40).any())


def test_a_small_frame_is_enlarged_and_everything_lies_at_its_place() -> None:
    zone = Shape("yard", [(20, 20), (80, 20), (80, 80), (20, 80)], is_zone=True)
    picture = drawn(Drawing((100, 100), shapes=[zone], marks=[Mark((50, 90), "here")], captions=["one line"]))
    assert picture.shape == (960 + 20 + 8, 960, 3)
    for x, y in zone.points:
        assert is_near(picture, YELLOW, round(9.6 * x), round(9.6 * y))
    assert is_near(picture, RED, 480, 864)
    assert not is_near(picture, RED, 480, 480, far=100)
    assert tuple(picture[400, 400]) == BLANK


def test_each_variable_has_its_colour_and_stands_in_the_legend() -> None:
    dots = [Dot("first", (200, 100)), Dot("second", (600, 300), (580, 200, 620, 300))]
    picture = drawn(Drawing((960, 540), dots=dots))
    colours = [tuple(int(value) for value in picture[y, x]) for x, y in ((200, 100), (600, 300))]
    assert colours[0] != colours[1]
    strip = picture[540:]
    assert all(is_near(strip, colour, 200, 14, far=200) for colour in colours)  # type: ignore[arg-type]
    assert is_near(picture, colours[1], 580, 250), "the box is drawn"  # type: ignore[arg-type]


def test_texts_at_one_place_lie_below_each_other() -> None:
    one, two = (drawn(Drawing((960, 540), marks=[Mark((100, 100), "same")] * count)) for count in (1, 2))
    changed = np.flatnonzero((one != two)[:, 116:].any(axis=(1, 2)))
    assert changed.min() > 92, "the first text stands as it stood alone"
    assert changed.max() < 92 + 30, "and the second is a line below"


def test_the_frame_shines_through_and_far_away_points_do_no_harm() -> None:
    frame = np.full((540, 960, 3), 200, np.uint8)
    picture = drawn(Drawing((960, 540), frame, dots=[Dot("a", (1e9, -1e9))], captions=["čas 10 s"]))
    assert (picture[:540] == 200).mean() > 0.99


@pytest.mark.parametrize(
    "row, place",
    [
        ({"x": 3.0, "y": 4.0, "x1": 0, "y1": 0, "x2": 2, "y2": 2}, (3.0, 4.0)),
        ({"x1": 0.0, "y1": 0.0, "x2": 4.0, "y2": 2.0}, (2.0, 1.0)),
        ({"x": None, "y": 4.0}, None),
        ({"frames": 3}, None),
    ],
)
def test_a_row_is_where_its_point_is_or_the_middle_of_its_box(row: dict[str, float], place: object) -> None:
    assert place_of(row) == place


def test_a_zone_in_metres_is_drawn_where_the_calibration_puts_it() -> None:
    rule = parse_rule("""
rule: near
version: 1
title: near
severity: info
zones: {yard: {source: gate, units: metres, polygon: [[0, 0], [2, 0], [2, 1]]}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source ORDER BY time, sequence
    PATTERN (a) DEFINE a AS in_zone(a.x, a.y, 'yard'))
""")
    site = Site.of({"gate": (200, 100)})
    assert shapes_of(rule, site, "gate", (200, 100)) == []
    # 100 px to the metre, origin in the middle of the lower edge of a frame of 400 x 200, north up.
    calibration = Calibration(((0.01, 0, -2), (0, -0.01, 2), (0, 0, 1)), (400, 200))
    site.versions["gate", CALIBRATION] = [Version(calibration)]
    (shape,) = shapes_of(rule, site, "gate", (200, 100))
    assert np.asarray(shape.points) == pytest.approx(np.array([(100, 100), (200, 100), (200, 50)]))
    assert isinstance(rule.zones["yard"], Zone)
