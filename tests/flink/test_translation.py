"""What a rule becomes in Flink SQL, part by part, and what is refused; no Flink needed."""

import re

import duckdb
import numpy as np
import pyarrow as pa
import pytest
import shapely

from events import load_catalogue
from patterns import Line, Rule, RuleError, Zone, bind, load_rules, parse_rule
from patterns.binding.expressions import Expr
from patterns.flink import Options, translate
from patterns.flink.exclusive import exclude_each_other
from patterns.flink.geometry import crosses_line, in_polygon, of_sources
from patterns.flink.names import interval, number, quoted, text
from patterns.processor import schemas
from patterns.scene.geometry import DIRECTIONS, Direction
from patterns.scene.geometry import crosses_line as ours_crosses_line
from patterns.scene.ground import Calibration
from patterns.scene.site import Site
from tests.flink.equality import ROOT
from tests.flink.samples import site_of
from tests.patterns.samples import SCHEMAS, letter_rule

# Constants and names.


@pytest.mark.parametrize(
    "microseconds,written",
    [
        (10_000_000, "INTERVAL '10' SECOND"),
        (120_000_000, "INTERVAL '2' MINUTE"),
        (86_400_000_000, "INTERVAL '1' DAY"),
        (2_001_000, "INTERVAL '0 00:00:02.001' DAY(1) TO SECOND(3)"),
        (100 * 86_400_000_000 + 1_000, "INTERVAL '100 00:00:00.001' DAY(3) TO SECOND(3)"),
        (0, "INTERVAL '0 00:00:00.000' DAY(1) TO SECOND(3)"),
        (1000 * 86_400_000_000, None),
        (1, None),
        (-1_000, None),
    ],
)
def test_an_interval_has_milliseconds_or_is_none(microseconds: int, written: str | None) -> None:
    assert interval(microseconds) == written


@pytest.mark.parametrize("value", [0.1, -1.5, 1e300, 5e-324, 123456789.125, 0.0])
def test_a_number_is_read_back_as_it_was(value: float) -> None:
    written = number(value)
    assert "E" in written, "without an exponent it would be a DECIMAL"
    assert float(written) == value


def test_names_and_texts_keep_what_is_in_them() -> None:
    assert quoted("a`b c") == "`a``b c`"
    assert text("it's") == "'it''s'"


# Geometry, evaluated by another engine's doubles.


def _asked(condition: str, **columns: np.ndarray) -> np.ndarray:
    with duckdb.connect() as connection:
        connection.register("asked", pa.table({name: pa.array(values) for name, values in columns.items()}))
        return np.asarray(connection.sql(f"SELECT {condition} AS answer FROM asked").fetchnumpy()["answer"])


POLYGONS = [
    [[0.10, 0.55], [0.62, 0.50], [0.66, 0.95], [0.08, 0.97]],
    [[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]],
    [[0.25, 0.5], [0.5, 0.25], [0.75, 0.5], [0.5, 0.75]],
    [[0.3, 0.3], [0.7, 0.3], [0.9, 0.7], [0.5, 0.5], [0.1, 0.8]],
]


@pytest.mark.parametrize("polygon", POLYGONS)
def test_a_zone_as_arithmetic_holds_the_points_that_it_holds_here_border_and_corners_too(
    polygon: list[tuple[float, float]],
) -> None:
    zone = Zone(source="cam-01", polygon=tuple((x, y) for x, y in polygon))
    corners = zone.scaled(zone.polygon, (1000, 1000))
    x, y = (each.ravel() for each in np.meshgrid(np.arange(0.0, 1001, 12.5), np.arange(0.0, 1001, 12.5)))
    middles = (corners + np.roll(corners, -1, axis=0)) / 2
    x, y = np.append(x, [*corners[:, 0], *middles[:, 0]]), np.append(y, [*corners[:, 1], *middles[:, 1]])
    ours = shapely.intersects_xy(zone.polygon_px((1000, 1000)), x, y)
    assert np.array_equal(_asked(in_polygon(corners, "x", "y"), x=x, y=y), ours)


@pytest.mark.parametrize("direction", DIRECTIONS)
def test_a_line_as_arithmetic_is_crossed_by_the_same_steps(direction: Direction) -> None:
    line = Line(source="cam-01", points=((0.5, 0.9), (0.4, 0.3)), units="normalised")
    points = line.points_px((1000, 1000))
    random = np.random.default_rng(7)
    steps = random.integers(300, 1000, (4, 5_000)).astype(np.float64)
    steps[0, :500], steps[1, :500] = points[0]  # from an end
    steps[:2, 500:900] = ((points[0] + points[1]) / 2)[:, None]  # from the middle
    steps[2:, 900:1000] = steps[:2, 900:1000]  # standing still
    names = ("x0", "y0", "x1", "y1")
    found = _asked(crosses_line(points, names, direction), **dict(zip(names, steps, strict=True)))
    assert np.array_equal(found, ours_crosses_line(points, tuple(steps), direction))


def test_a_place_is_false_for_other_sources_and_unknown_for_points_that_are_none() -> None:
    condition = of_sources("source", [("cam-01", "x > 0")], ["x"], "FALSE")
    rows = "(VALUES ('cam-01', 1.0), ('cam-02', 1.0), ('cam-01', 'NaN'::DOUBLE), ('cam-01', NULL), (NULL, 1.0))"
    found = duckdb.sql(f"SELECT {condition} FROM {rows} AS rows(source, x)").fetchall()
    assert [each for (each,) in found] == [True, False, None, None, False]
    assert of_sources("source", [], ["x"], "FALSE") == "FALSE"


# Conditions that exclude each other.


def _conditions(define: str) -> tuple[list[Expr], list[Expr]]:
    bound = bind(letter_rule("O A B C", define), SCHEMAS)
    found = []
    for name in "BC":
        condition = bound.conditions[bound.variables.index(name)]
        parts = [bound.predicates[at] for at in condition.predicates]
        found.append([*parts, *([condition.guard] if condition.guard is not None else [])])
    return found[0], found[1]


@pytest.mark.parametrize(
    "first,second,excluded",
    [
        ("B.n > 1", "C.n <= 1", True),
        ("B.n > 1", "C.n <= 2", False),
        ("B.n > 1", "NOT C.n > 1", True),
        ("B.letter = 'a'", "C.letter = 'b'", True),
        ("B.letter = 'a'", "C.letter IN ('b', 'c')", True),
        ("B.letter IN ('a', 'b')", "C.letter IN ('b', 'c')", False),
        ("B.flag", "NOT C.flag", True),
        ("B.flag AND B.n = 1", "C.n <> 1", True),
        ("B.flag OR B.n = 1", "C.n = 2", False),
        ("B.n = 3 OR B.n = 1", "C.n = 2", True),
        ("B.n IS NULL", "C.n + 1 > 0", True),
        ("B.n IS NULL", "COALESCE(C.n, 1) = 1", False),
        ("B.n < A.n", "C.n >= A.n", True),
        ("A.n > B.n", "C.n >= A.n", True),
        ("B.time < A.time + INTERVAL '1' SECOND", "C.time >= A.time + INTERVAL '1' SECOND", True),
        ("COUNT(*) < 3", "COUNT(*) >= 3", True),
        ("COUNT(B.*) < 3", "COUNT(B.*) >= 3", False),  # with and without the row at hand
        ("B.n > FIRST(C.n)", "C.n <= FIRST(C.n)", False),
        ("NOT (B.n > 1 OR B.flag)", "C.flag AND C.n = 7", True),
        ("TRUE", "C.n > 1", False),
    ],
)
def test_conditions_that_no_row_can_meet_together(first: str, second: str, excluded: bool) -> None:
    one, other = _conditions(f"B AS {first}, C AS {second}")
    assert exclude_each_other(one, other, {"B", "C"}) is excluded
    assert exclude_each_other(other, one, {"B", "C"}) is excluded


# What is refused.

LETTERS = {name: f"letter = '{name.lower()}'" for name in "ABCDE"}
OVERLAPPING = LETTERS | {"B": "B.n > 1"}


def _rule(pattern: str, conditions: dict[str, str], **more: str) -> Rule:
    """A rule with the conditions of the variables that the pattern names."""
    used = [name for name in conditions if name in pattern]
    return letter_rule(pattern, ", ".join(f"{name} AS {conditions[name]}" for name in used), **more)


@pytest.mark.parametrize(
    "pattern,conditions,construct",
    [
        ("A B* C", OVERLAPPING, "greedy variable with an open end"),
        ("A B? C", OVERLAPPING, "greedy variable with an open end"),
        ("A B{1,3} C", OVERLAPPING, "greedy variable with an open end"),
        ("A B*? C D* E", OVERLAPPING, "two variables with open ends"),
        ("A B* A", LETTERS, "variable twice"),
        ("A B+", LETTERS, "greedy last variable"),
        ("A B?", LETTERS, "greedy last variable"),
        ("A B{0,2} C", LETTERS, "range from no row"),
        ("A B?? C", LETTERS, "reluctant optional"),
        ("A B", LETTERS | {"A": "A.n > PREV(A.n)"}, "PREV out of reach"),
        ("A B* C", LETTERS | {"C": "letter = 'c' AND PREV(C.n, 2) > 1"}, "PREV out of reach"),
        ("A B? C", LETTERS | {"C": "letter = 'c' AND LAST(COALESCE(B.n, 1)) = 1"}, "value in place of NULL"),
        ("A", LETTERS | {"A": "A.gap * 1.5 > INTERVAL '1' SECOND"}, "other function"),
    ],
)
def test_what_flink_cannot_say_or_takes_otherwise_is_refused(
    pattern: str, conditions: dict[str, str], construct: str
) -> None:
    with pytest.raises(RuleError, match=f"portable: {construct}: "):
        translate(_rule(pattern, conditions), SCHEMAS)


@pytest.mark.parametrize("pattern", ["A B* C", "A B*? C", "A B+ C", "A B? C", "A{2} B{1,3} C", "A B{2,} C", "A B+?"])
def test_variables_that_exclude_each_other_may_repeat(pattern: str) -> None:
    assert translate(_rule(pattern, LETTERS), SCHEMAS).result == "sample_matches"


def test_one_reluctant_variable_may_fit_what_comes_after_it() -> None:
    assert "`B`*? `C`" in translate(_rule("A B*? C", OVERLAPPING), SCHEMAS).text


def test_a_measure_cannot_bear_a_name_that_the_result_has() -> None:
    with pytest.raises(RuleError, match="measure of a column's name"):
        translate(letter_rule("A", "A AS n > 1", "A.n AS first_time"), SCHEMAS)


def test_emit_is_refused_where_matches_overlap() -> None:
    rule = _rule(
        "A B* C", LETTERS | {"C": "letter = 'a' AND C.n > A.n"}, skip="TO NEXT ROW", more="emit: {cooldown: 1 min}"
    )
    with pytest.raises(RuleError, match="portable: emit of matches that overlap"):
        translate(rule, SCHEMAS)


def test_a_zone_of_unknown_frame_size_points_at_the_zone_and_says_what_to_give() -> None:
    rule = next(each for each in load_rules(ROOT / "patterns" / "rules") if each.rule == "loitering")
    with pytest.raises(RuleError, match="--frame-size cam-01=1920x1080") as error:
        translate(rule, schemas(load_catalogue()))
    assert (error.value.line, error.value.excerpt.strip()[:3]) == (8, "8 |")


# How it is said.


def _define(pattern: str, define: str, measures: str = "", **options: bool) -> str:
    return translate(letter_rule(pattern, define, measures, within="INTERVAL '3' SECOND"), SCHEMAS,
                     options=Options(**options)).text  # fmt: skip


def test_prev_is_the_match_s_own_earlier_row() -> None:
    said = _define("A B C", "C AS C.n > PREV(C.n, 2) AND C.n > PREV(FIRST(B.n))", "PREV(C.n) AS before")
    assert "`C`.`n` > LAST(`n`, 2)" in said
    assert "`C`.`n` > FIRST(`n`, 0)" in said
    assert "LAST(`n`, 1) AS `before`" in said


def test_division_and_roots_are_null_where_they_are_not_defined() -> None:
    said = _define("A B", "A AS A.n / A.n = 1 AND A.v / A.v > 1 AND A.n % 2 = 0 AND SQRT(A.v) > 1")
    assert "`A`.`n` / NULLIF(`A`.`n`, 0)" in said
    assert "`A`.`v` / NULLIF(`A`.`v`, 0E0)" in said
    assert "MOD(`A`.`n`, 2) = 0" in said
    assert "CASE WHEN `A`.`v` < 0 THEN CAST(NULL AS DOUBLE) ELSE SQRT(`A`.`v`) END > 1.0E0" in said


def test_within_is_exact_to_the_microsecond_unless_all_times_are_milliseconds() -> None:
    exact = _define("A B", "A AS n > 1")
    assert "WITHIN INTERVAL '0 00:00:03.001' DAY(1) TO SECOND(3)" in exact
    assert "`B` AS `B`.`time` < `A`.`time` + INTERVAL '3' SECOND" in exact
    simple = _define("A B", "A AS n > 1", whole_milliseconds=True)
    assert "WITHIN INTERVAL '3' SECOND" in simple
    assert "`B` AS" not in simple


def test_the_watermark_lies_a_millisecond_below_the_lateness() -> None:
    rule = letter_rule("A", "A AS n > 1", more="time: {lateness: 2 s}")
    assert "- INTERVAL '0 00:00:02.001' DAY(1) TO SECOND(3)\n" in translate(rule, SCHEMAS).text


def test_order_is_total_and_needs_no_stream_for_one_station() -> None:
    assert "ORDER BY `rowtime`, `time`, `stream`, `sequence`" in _define("A", "A AS n > 1")
    rule = letter_rule("A", "A AS n > 1", partition="source, key")
    said = translate(rule, SCHEMAS, options=Options(one_station=True)).text
    assert "ORDER BY `rowtime`, `time`, `sequence`" in said
    assert "station" not in said


def test_a_pattern_without_conditions_gets_the_define_that_flink_wants() -> None:
    assert "DEFINE `A` AS TRUE" in translate(letter_rule("A B", ""), SCHEMAS).text


def test_shared_zones_are_said_as_the_site_has_them_now() -> None:
    rule = letter_rule("A", "A AS in_zone(A.v, A.v, 'yard')", more="shared: [yard]")
    zones = [Zone(source=source, units="pixels", polygon=((0, 0), (size, 0), (0, size)))
             for source, size in (("cam-01", 5), ("cam-02", 7))]  # fmt: skip
    said = translate(rule, SCHEMAS, site=Site.of(shapes={"yard": zones})).text
    assert "WHEN `source` = 'cam-01' THEN" in said
    assert "`v` BETWEEN 0.0E0 AND 7.0E0" in said


def test_every_shipped_rule_has_a_script() -> None:
    known = schemas(load_catalogue())
    for rule in load_rules(ROOT / "patterns" / "rules"):
        assert translate(rule, known, site=site_of(rule)).text.count("CREATE ") >= 3


# Several streams, and time that passes.


def test_arms_are_united_column_by_column() -> None:
    rule = parse_rule("""
rule: both
version: 1
title: both
severity: info
match: |
  SELECT * FROM (
    SELECT key, n, 'high' AS level FROM letter WHERE n > 7
    UNION ALL BY NAME
    SELECT track_id AS key, x AS n FROM track_point
  ) MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time, sequence
    MEASURES B.level AS level
    PATTERN (A B) DEFINE A AS A.type = 'track_point', B AS B.n > 1)
""")
    said = translate(rule, SCHEMAS).text
    assert said.count("CREATE TABLE") == 2
    assert "CAST('high' AS STRING) AS `level`" in said
    assert "CAST(CAST(NULL AS STRING) AS STRING) AS `level`" in said
    assert "CAST(CAST(`n` AS DOUBLE) AS DOUBLE) AS `n`" in said
    assert "WHERE `n` > 7" in said
    assert "'track_point' AS `type`" in said


def test_two_arms_over_one_type_keep_their_order_for_one_event() -> None:
    rule = letter_rule("A B", "A AS n > 1")
    arms = "(SELECT key, n FROM letter UNION ALL BY NAME SELECT key, n FROM letter)"
    said = translate(parse_rule(rule_text(rule).replace("FROM letter", f"FROM {arms}", 1)), SCHEMAS).text
    assert said.count("CREATE TABLE") == 1
    assert "ORDER BY `rowtime`, `time`, `stream`, `sequence`, `arm`" in said


def rule_text(rule: Rule) -> str:
    match = "".join(f"  {line}\n" for line in rule.match.splitlines())
    return f"rule: sample\nversion: 1\ntitle: sample\nseverity: info\nmatch: |\n{match}"


def test_a_timer_is_a_second_source_that_comes_later() -> None:
    rule = letter_rule("A B* T", "A AS letter = 'a', B AS letter = 'b', T AS TIMER(A.time, INTERVAL '2' SECOND)",
                       "COUNT(B.*) AS many")  # fmt: skip
    said = translate(rule, SCHEMAS).text
    assert "CREATE TABLE `letter_in_2000_ms`" in said
    assert "`rowtime` AS CAST(`time` + INTERVAL '2' SECOND AS TIMESTAMP_LTZ(3))" in said
    assert "WHERE (`letter` = 'a')" in said
    assert "PATTERN (`A` `B`* `T`)" in said
    assert "`T` AS `T`.`timer` = 1 AND (`T`.`stream` = `A`.`stream`) AND (`T`.`sequence` = `A`.`sequence`)" in said
    assert "COUNT(CASE WHEN `B`.`timer` = 0 THEN `B`.`sequence` END) AS `many`" in said
    assert "ORDER BY `rowtime`, `time`, `timer`, `stream`, `sequence`" in said


def test_what_stands_between_single_rows_is_passed_over() -> None:
    rule = letter_rule("A T B", "A AS letter = 'a', B AS letter = 'b', T AS TIMER(A.time, INTERVAL '2' SECOND)")
    assert "PATTERN (`A` `passed_1`* `T` `passed_2`* `B`)" in translate(rule, SCHEMAS).text


@pytest.mark.parametrize(
    "pattern,more,construct",
    [
        ("A T", ", T AS TIMER(A.time, INTERVAL '1' SECOND) AND COUNT(*) < 9", "rows beside a TIMER"),
        ("A B+ T", ", B AS letter = 'b', T AS TIMER(A.time, INTERVAL '1' SECOND)", "counted loop beside a TIMER"),
        ("Z? A T", ", Z AS letter = 'z', T AS TIMER(A.time, INTERVAL '1' SECOND)",
         "optional first variable beside a TIMER"),
        ("A+ T", ", T AS TIMER(A.time, INTERVAL '1' SECOND)", "TIMER from or in a loop"),
        ("A T S", ", T AS TIMER(A.time, INTERVAL '1' SECOND), S AS TIMER(A.time, INTERVAL '2' SECOND)",
         "several timers"),
    ],
)  # fmt: skip
def test_what_cannot_be_said_beside_a_timer(pattern: str, more: str, construct: str) -> None:
    with pytest.raises(RuleError, match=f"portable: {construct.replace('?', '.')}: "):
        translate(letter_rule(pattern, f"A AS letter = 'a'{more}"), SCHEMAS)


def test_situations_of_other_rules_are_no_input_in_flink() -> None:
    rule = letter_rule("A", "A AS A.n > 1")
    text_ = rule_text(rule).replace("FROM letter", "FROM situation('lower')", 1)
    known = {**SCHEMAS, "situation('lower')": SCHEMAS["letter"]}
    with pytest.raises(RuleError, match="portable: situations as input: "):
        translate(parse_rule(text_), known)


def test_a_column_of_a_name_that_the_script_has_is_refused() -> None:
    rule = letter_rule("A", "A AS A.n > 1")
    arm = "(SELECT key, n AS stream FROM letter)"
    with pytest.raises(RuleError, match=r"portable: column of a name of the script's: .*'stream'"):
        translate(
            parse_rule(rule_text(rule).replace("FROM letter", f"FROM {arm}", 1).replace("A.n", "A.stream")), SCHEMAS
        )


def test_the_ground_is_arithmetic_with_the_calibration() -> None:
    rule = letter_rule("A", "A AS ground_x(A.v, A.v) > 3 AND ground_speed(A.v, A.v, A.v, A.v) > 1")
    calibration = Calibration(((0.1, 0.0, 1.0), (0.0, -0.1, 100.0), (0.0, 0.001, 1.0)), (1000, 1000))
    site = Site.of({"cam-01": (500, 1000)}, calibrations={"cam-01": calibration})
    said = translate(rule, SCHEMAS, site=site).text
    assert "(`v` * 2.0E0)" in said
    east = re.search(r"WHEN `source` = 'cam-01' THEN CASE WHEN ABS\(`v`\) <= [0-9.E]+ THEN (CASE .*? END) END\n", said)
    assert east is not None
    v = np.array([10.0, 250.0, 900.0])
    ours = calibration.ground(v, v, (500, 1000))[0]
    assert np.array_equal(_asked(east[1].replace("`", ""), v=v), ours)
    with pytest.raises(RuleError, match="the log says no calibration of any source"):
        translate(rule, SCHEMAS)


def test_kmh_and_distances_are_what_they_stand_for() -> None:
    site = Site.of(
        {"cam-01": (1000, 1000)}, calibrations={"cam-01": Calibration(((1, 0, 0), (0, -1, 9), (0, 0, 1)), (1, 1))}
    )
    apart = [f"(ground_{axis}(A.x, A.y) - ground_{axis}(B.x, B.y))" for axis in ("x", "y")]
    meant = f"SQRT({apart[0]} * {apart[0]} + {apart[1]} * {apart[1]})"
    said = []
    for kmh, distance in (
        ("speed_kmh", "distance_m(A, B)"),
        ("ground_speed(x, y, vx, vy) * 3.6", meant),
    ):
        rule = letter_rule(
            "A B", f"A AS {kmh} > 50, B AS {distance} < 2", partition="source, track_id", source="track_point"
        )
        text_ = translate(rule, SCHEMAS, site=site).text
        said.append([line for line in text_.splitlines() if not line.startswith("--")])
    assert said[0] == said[1]
