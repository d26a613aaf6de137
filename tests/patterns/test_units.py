"""Units in conditions: what does not go together is named at its place, and nothing else is."""

import pytest

from events import load_catalogue
from patterns import check, parse_rule
from patterns.processor import schemas
from patterns.scene.quantities import parse_quantity

SCHEMAS = schemas(load_catalogue())
HEAD = """\
rule: sample
version: 1
title: sample
severity: info
params: {far: 5 m, near: 20 px, fast: 50 km/h, slow: 8 px/s, many: 3}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY source, track_id ORDER BY time
"""


def mixed(define: str) -> list[tuple[str, str]]:
    text = HEAD + f"    PATTERN (A B) WITHIN INTERVAL '1' SECOND DEFINE A AS TRUE, B AS {define})\n"
    found = [each for each in check(parse_rule(text), SCHEMAS) if each.code == "unit"]
    assert all(each.severity == "error" for each in found)
    return [
        (each.message.split(" do ")[0], text.split("\n")[each.place.line - 1][each.place.column - 1 :].split(" ")[0])
        for each in found
    ]


@pytest.mark.parametrize(
    "define,wanted",
    [
        ("vx > :fast", [("px/s and m/s", "vx")]),
        ("ABS(B.vx) > :near", [("px/s and px", "B.vx")]),
        ("x - A.x > :far", [("px and m", "x")]),
        ("SQRT(vx * vx + vy * vy) < :fast", [("px/s and m/s", "vx")]),
        ("vx * vx + vy * vy < :slow", [("px/s² and px/s", "vx")]),
        ("ground_speed(x, y, vx, vy) > :slow", [("m/s and px/s", "x")]),
        ("speed_kmh > :fast", [("km/h and m/s", "speed_kmh")]),
        ("distance_m(A, B) < :near", [("m and px", "distance_m(A,")]),
        ("ground_x(x, y) BETWEEN 3 AND :near", [("m and px", "x")]),
        ("PREV(x) = y2 AND vx = x", [("px/s and px", "vx")]),
        ("LEAST(vx, vy) > LAST(A.x)", [("px/s and px", "vx")]),
    ],
)
def test_what_does_not_go_together_is_named(define: str, wanted: list[tuple[str, str]]) -> None:
    assert [units for units, _ in mixed(define)] == [units for units, _ in wanted]


@pytest.mark.parametrize(
    "define",
    [
        "vx > :slow AND ground_speed(x, y, vx, vy) > :fast",
        "x > 5 AND x > :many AND ABS(x - A.x) <= :near",
        "vx * vx + vy * vy <= :slow * :slow",
        "SQRT(vx * vx + vy * vy) >= :slow",
        "ground_speed(x, y, vx, vy) * 3.6 > :many",
        "speed_kmh > 50 AND B.speed_kmh > LAST(A.speed_kmh) AND distance_m(A, B) < :far",
        "x / vx > :many AND confidence > 0.5 AND track_id = :many",
    ],
)
def test_what_goes_together_is_let_alone(define: str) -> None:
    assert mixed(define) == []


def test_a_quantity_is_what_it_means() -> None:
    assert parse_quantity("36 km/h") == parse_quantity("10 m/s")
    assert parse_quantity("5 m") != parse_quantity("5 px")
    assert (parse_quantity("30 cm").value, parse_quantity("30 cm").base_unit) == (0.3, "m")
    assert str(parse_quantity("1.50 km")) == "1.50 km"
    assert len({parse_quantity("1 km"), parse_quantity("1000 m")}) == 1
    with pytest.raises(ValueError, match="a speed or length is a number and one of mm, cm, m, km, m/s, km/h, px, px/s"):
        parse_quantity("5 ft")
