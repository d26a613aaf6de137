"""Running the tests that a rule's own file holds.

A test gives rows, as a CSV file beside the rule or inline, and the situations
wanted of them. Rows may leave out the envelope: `sequence` counts from 1,
`station` is `test`, `source` is the only source that the rule's zones and lines
name, or `test`, and columns that are not given are NULL.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import pyarrow as pa

from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Kind
from patterns.binding.inputs import ENVELOPE, situation_key
from patterns.binding.metres import metres_of
from patterns.durations import parse_duration
from patterns.engine.running import match
from patterns.engine.situations import Match
from patterns.errors import FrameSizeUnknown, PatternError, Place, RuleError
from patterns.files.rule import Case, Rule
from patterns.language.text import Passage
from patterns.scene.ground import Calibration
from patterns.scene.site import Shape, Site
from patterns.tools.given import check_columns, column_type, given_rows, time_of

_FLOAT_TOLERANCE = 1e-9


@dataclass(frozen=True, slots=True)
class TestResult:
    """How one test went.

    Attributes:
        rule: The rule's name.
        name: The test's name.
        passed: Whether exactly the wanted situations were found.
        difference: Wanted and found side by side, one line each; empty if it passed.
        place: Where in the rule's file the test stands.
    """

    __test__ = False

    rule: str
    name: str
    passed: bool
    difference: str
    place: Place


def run_tests(rule: Rule, schemas: Mapping[str, pa.Schema]) -> list[TestResult]:
    """The results of the rule's tests, in their order.

    Raises:
        RuleError: The rule cannot be bound, or a test's rows cannot be read.
    """
    return [_result(rule, schemas, index, case) for index, case in enumerate(rule.tests)]


def _result(rule: Rule, schemas: Mapping[str, pa.Schema], index: int, case: Case) -> TestResult:
    bound = bind(rule, schemas, site=case_site(case))
    name = case.name or (case.given if isinstance(case.given, str) else f"test {index + 1}")
    try:
        rows = case_rows(bound, schemas, index)
        found = match(bound, rows)
    except RuleError:
        raise
    except FrameSizeUnknown as error:
        difference = (
            f"! {error.shape!r} is in normalised coordinates of source {error.source!r}, whose frame size the test "
            f"does not give. Next: add it to the test's `frames:`, as in `frames: {{{error.source}: [1920, 1080]}}`"
        )
    except PatternError as error:
        difference = f"! {error}"
    else:
        difference = compared(case.expect, found)
        difference += _uncalibrated(bound, case, rows) if difference else ""
    place = rule.passage("tests", index).place(0)
    return TestResult(rule.rule, name, passed=not difference, difference=difference, place=place)


def _uncalibrated(bound: BoundRule, case: Case, rows: pa.Table) -> str:
    """Of which sources the test gives no calibration, though the rule asks for metres: why it may find nothing."""
    shared = (*case.zones.items(), *case.lines.items())
    missing = [
        source
        for source in sorted({*rows.column("source").to_pylist()} - set(case.calibrations))
        if metres_of(bound).asks(source, [n for n, each in shared if each.units == "metres" and each.source == source])
    ]
    told = (
        f"\n! the rule asks for metres of source {source!r}, whose calibration the test does not give. Next: add it to "
        f"the test's `calibrations:`, as in `calibrations: {{{source}: [[0.1, 0, 0], [0, -0.1, 100], [0, 0, 1]]}}`"
        for source in missing
    )
    return "".join(told)


def case_site(case: Case) -> Site:
    """What the test says of the cameras."""
    shapes: dict[str, list[Shape]] = {name: [zone] for name, zone in case.zones.items()}
    shapes |= {name: [line] for name, line in case.lines.items()}
    calibrations = {
        source: Calibration(matrix, case.frames.get(source, (1, 1))) for source, matrix in case.calibrations.items()
    }
    return Site.of(case.frames, shapes, calibrations)


def case_rows(bound: BoundRule, schemas: Mapping[str, pa.Schema], index: int) -> pa.Table:
    """The rows of the rule's test of this index.

    Raises:
        RuleError: The CSV file is not there, or a row has a column that no event type of the rule has, a value of
            another type than its column, or no time.
    """
    rule = bound.rule
    case = rule.tests[index]
    rows = given_rows(case.given, rule.folder, partial(rule.passage, "tests", index, "given"))
    kinds = _kinds(bound, rule.passage("tests", index, "given"))
    check_columns(rows, {*kinds, *_readable(bound, schemas)})
    shapes = (*rule.zones.values(), *rule.lines.values(), *case.zones.values(), *case.lines.values())
    sources = {shape.source for shape in shapes} | set(case.calibrations)
    source = sources.pop() if len(sources) == 1 else "test"
    columns: dict[str, list[Any]] = {name: [] for name in kinds}
    only_type = next(iter(bound.types)) if len(bound.types) == 1 else None
    for row in rows:
        if only_type is None and row.values.get("type") is None:
            raise row.error(f"the rule reads several types, so a row says its `type`: {', '.join(sorted(bound.types))}")
        defaults = {"sequence": row.number, "station": "test", "source": source, "type": only_type}
        for name, kind in kinds.items():
            value = row.typed(name, kind)
            columns[name].append(defaults.get(name) if value is None else value)
    arrays = {name: pa.array(values, column_type(kinds[name])) for name, values in columns.items()}
    return pa.table(arrays)


def _readable(bound: BoundRule, schemas: Mapping[str, pa.Schema]) -> set[str]:
    """The columns of all that the rule reads, whether it asks for them or not."""
    names = set(ENVELOPE)
    for each in bound.inputs:
        known = schemas.get(each.type if each.situation_of is None else situation_key(each.situation_of))
        names.update(known.names if known is not None else ())
    return names


def _kinds(bound: BoundRule, passage: Passage) -> dict[str, Kind]:
    """The columns of a test's rows: the envelope's, and those that any arm of FROM reads."""
    kinds = {"time": Kind.TIME, "sequence": Kind.INT, "station": Kind.STRING, "source": Kind.STRING,
             "type": Kind.STRING}  # fmt: skip
    kinds |= {"rule": Kind.STRING} if any(each.situation_of for each in bound.inputs) else {}
    for name, kind in (pair for each in bound.inputs for pair in each.reads.items()):
        known = kinds.setdefault(name, kind)
        if {known, kind} == {Kind.INT, Kind.FLOAT}:
            kinds[name] = Kind.FLOAT
        elif known is not kind:
            message = f"column {name} is a {known.value} in one type and a {kind.value} in another"
            raise passage.error(message, 0)
    return kinds


def compared(wanted: Sequence[Mapping[str, Any]], found: Sequence[Match]) -> str:
    """The difference, one line a situation: `  ` as wanted, `- ` wanted but not found, `+ ` found but not wanted.

    Wanted and found are paired in order, value below value, and a line `? ` points at those that differ; empty if
    nothing differs. Where nothing at all was wanted or found, a line says that.
    """
    lines = []
    is_equal = len(wanted) == len(found)
    for index in range(max(len(wanted), len(found))):
        want = wanted[index] if index < len(wanted) else None
        have = _said(found[index]) if index < len(found) else None
        if want is not None and have is not None and agrees(want, have):
            lines.append(f"  {shown(want)}")
            continue
        is_equal = False
        if want is not None and have is not None and len(want) > 1:
            lines += _side_by_side(want, have)
            continue
        if want is not None:
            lines.append(f"- {shown(want)}")
        if have is not None:
            names = want or found[index].measures or found[index].partition
            lines.append(f"+ {shown({name: have.get(name, '(no such value)') for name in names})}")
    if wanted and not found:
        lines.append("+ (no situation)")
    if found and not wanted:
        lines.insert(0, "- (no situation)")
    return "" if is_equal else "\n".join(lines)


def _side_by_side(want: Mapping[str, Any], have: Mapping[str, Any]) -> list[str]:
    """Wanted, found, and carets under the values that differ."""
    cells = [(shown({name: value}), shown({name: have.get(name, "(no such value)")}), agrees({name: value}, have))
             for name, value in want.items()]  # fmt: skip
    widths = [max(len(wanted), len(found)) + 2 for wanted, found, _ in cells]
    rows = [
        ("- ", [f"{wanted}, " for wanted, _, _ in cells]),
        ("+ ", [f"{found}, " for _, found, _ in cells]),
        ("? ", ["" if is_same else "^" * len(found) for _, found, is_same in cells]),
    ]
    return [
        sign + "".join(text.ljust(width) for text, width in zip(texts, widths, strict=True)).rstrip(", ")
        for sign, texts in rows
    ]


def _said(found: Match) -> dict[str, Any]:
    return {"title": found.title, **found.partition, **found.measures}


def agrees(want: Mapping[str, Any], have: Mapping[str, Any]) -> bool:
    """Whether all that is wanted is so; what is not named is not compared."""
    return all(name in have and _is_same(value, have[name]) for name, value in want.items())


def _is_same(want: Any, have: Any) -> bool:
    if isinstance(have, timedelta) and isinstance(want, str):
        return parse_duration(want) == have
    if isinstance(have, datetime):
        return isinstance(want, datetime | str) and time_of(want) == have
    if isinstance(have, float) and isinstance(want, int | float):
        return abs(have - want) <= _FLOAT_TOLERANCE * max(1.0, abs(want))
    return bool(want == have)


def shown(values: Mapping[str, Any]) -> str:
    """The values on one line, as a test's file writes them."""
    return ", ".join(f"{name}: {_plain(value)}" for name, value in values.items()) or "(a situation)"


def _plain(value: Any) -> str:
    if isinstance(value, datetime):
        return time_of(value).isoformat().replace("+00:00", "Z")
    return f"{value.total_seconds():g} s" if isinstance(value, timedelta) else str(value)
