"""Zones and lines against closed forms."""

from typing import Any

import pytest
from pydantic import ValidationError

from patterns import FrameSizeUnknown, Line, RuleRun, Zone, bind, match
from tests.patterns.samples import SCHEMAS, letter_rows, letter_rule

SQUARE = "zones: {square: {source: cam-01, polygon: [[0.1, 0.1], [0.5, 0.1], [0.5, 0.5], [0.1, 0.5]]}}"
PIXELS = "zones: {square: {source: cam-01, units: pixels, polygon: [[10, 10], [50, 10], [50, 50], [10, 50]]}}"
# Looking from the first point to the second is looking up in the image: right is the image's right.
DOOR = "lines: {door: {source: cam-01, units: pixels, points: [[50, 90], [50, 10]]}}"


def _at(*points: tuple[float | None, float | None], source: str = "cam-01") -> Any:
    """Rows at these points: `v` is x; y is made of `gap`-free columns, so it is kept in `n`."""
    return letter_rows(
        [{"us": at, "v": x, "n": None if y is None else round(y), "source": source} for at, (x, y) in enumerate(points)]
    )


@pytest.mark.parametrize(
    "x,y,wanted",
    [
        (30, 30, True), (5, 30, False), (60, 30, False), (30, 60, False),
        (10, 30, True), (50, 50, True), (10, 10, True), (50.001, 50, False),
        (None, 30, None), (30, None, None), (float("nan"), 30, None), (float("inf"), 30, None),
    ],
)  # fmt: skip
@pytest.mark.parametrize("zones", [SQUARE, PIXELS])
def test_in_zone(x: float | None, y: float | None, wanted: bool | None, zones: str) -> None:
    for sql, expected in (("", wanted), ("NOT ", None if wanted is None else not wanted)):
        row_local = letter_rule("A", f"A AS {sql}in_zone(A.v, A.n, 'square')", more=zones)
        guarded = letter_rule("X A", f"A AS {sql}in_zone(X.v, A.n, 'square')", more=zones)
        for rule, rows in ((row_local, _at((x, y))), (guarded, _at((x, y), (x, y)))):
            found = match(bind(rule, SCHEMAS, {"cam-01": (100, 100)}), rows)
            assert len(found) == (expected is True), rule.match


@pytest.mark.parametrize(
    "before,after,direction",
    [
        ((40, 50), (60, 50), "left_to_right"), ((60, 50), (40, 50), "right_to_left"),
        ((40, 50), (45, 50), None), ((60, 50), (70, 50), None), ((40, 5), (60, 5), None), ((40, 95), (60, 95), None),
        ((40, 90), (60, 90), "left_to_right"), ((40, 10), (60, 10), "left_to_right"),
        ((40, 50), (50, 50), "left_to_right"), ((50, 50), (60, 50), None), ((50, 50), (40, 50), "right_to_left"),
        ((50, 20), (50, 80), None), ((40, 50), (40, 50), None), ((40, 80), (60, 20), "left_to_right"),
    ],
)  # fmt: skip
def test_crosses(before: tuple[float, float], after: tuple[float, float], direction: str | None) -> None:
    for asked in ("left_to_right", "right_to_left", "any"):
        row_local = f"crosses(PREV(B.v), PREV(B.n), B.v, B.n, 'door', '{asked}')"
        guarded = f"crosses(A.v, A.n, B.v, B.n, 'door', '{asked}')"
        for condition in (row_local, guarded):
            rule = letter_rule("A B", f"B AS {condition}", more=DOOR)
            found = match(bind(rule, SCHEMAS), _at(before, after))
            assert len(found) == (direction is not None and asked in (direction, "any")), (asked, condition)


def test_a_step_to_an_unknown_point_is_neither_crossing_nor_not() -> None:
    for condition in ("crosses(A.v, A.n, B.v, B.n, 'door', 'any')", "crosses(PREV(v), PREV(n), v, n, 'door', 'any')"):
        for sql in (condition, f"NOT {condition}"):
            rule = letter_rule("A B", f"B AS {sql}", more=DOOR)
            assert match(bind(rule, SCHEMAS), _at((40, 50), (None, 50))) == []


def test_a_zone_of_one_source_is_never_true_for_another() -> None:
    rows = _at((30, 30), source="cam-02")
    for condition, count in (("in_zone(v, n, 'square')", 0), ("NOT in_zone(v, n, 'square')", 1)):
        assert len(match(bind(letter_rule("A", f"A AS {condition}", more=SQUARE), SCHEMAS), rows)) == count
    two = _at((30, 30), (30, 30), source="cam-02")
    guarded = letter_rule("X A", "A AS in_zone(X.v, A.n, 'square')", more=SQUARE)
    assert match(bind(guarded, SCHEMAS), two) == []
    rule = letter_rule("A B", "B AS NOT crosses(A.v, A.n, B.v, B.n, 'door', 'any')", more=DOOR)
    assert len(match(bind(rule, SCHEMAS), _at((40, 50), (60, 50), source="cam-02"))) == 1


def test_the_source_is_that_of_the_row_that_the_point_is_of() -> None:
    rule = letter_rule("X A", "A AS in_zone(X.v, X.n, 'square')", more=SQUARE, partition="")
    rows = letter_rows([{"us": 0, "v": 30, "n": 30, "source": "cam-01"}, {"us": 1, "source": "cam-02"}])
    assert len(match(bind(rule, SCHEMAS, {"cam-01": (100, 100)}), rows)) == 1


def test_a_normalised_zone_needs_its_sources_frame_size_once_a_row_of_it_comes() -> None:
    run = RuleRun(bind(letter_rule("A", "A AS in_zone(v, n, 'square')", more=SQUARE), SCHEMAS))
    run.push(_at((30, 30), (30, 30), source="cam-02"))
    run.source_ended("cam-02")
    run.push(_at((30, 30)))
    with pytest.raises(FrameSizeUnknown, match="frame size is not known: no video_added of it came"):
        run.finish()
    run = RuleRun(bind(letter_rule("A", "A AS in_zone(v, n, 'square')", more=SQUARE), SCHEMAS))
    run.push(_at((30, 30)))
    run.set_frame_size("cam-01", 100, 100)
    assert len(run.finish().matches) == 1
    unknown = bind(letter_rule("X A", "A AS in_zone(X.v, A.n, 'square')", more=SQUARE), SCHEMAS)
    with pytest.raises(FrameSizeUnknown):
        match(unknown, _at((30, 30), (30, 30)))


@pytest.mark.parametrize(
    "polygon,message",
    [
        ([[0, 0], [1, 1]], "a polygon needs 3 points or more, got 2"),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "not cross itself"),
        ([[0, 0], [1, 1], [0.5, 0.5]], "must have an area"),
        ([[0, 0], [2, 0], [1, 1]], "lie in 0 to 1"),
        ([[0, 0], [float("nan"), 0], [1, 1]], "finite"),
    ],
)
def test_zones_that_are_none(polygon: list[list[float]], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Zone.model_validate({"source": "cam-01", "polygon": polygon})


@pytest.mark.parametrize(
    "points,message", [([[0, 0], [0, 0]], "must differ"), ([[0, 0], [0, 3]], "lie in 0 to 1"), ([[0, 0]], "missing")]
)
def test_lines_that_are_none(points: list[list[float]], message: str) -> None:
    with pytest.raises(ValidationError, match=f"(?i){message}"):
        Line.model_validate({"source": "cam-01", "points": points})
