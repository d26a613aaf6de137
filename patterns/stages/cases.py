"""Running the tests that a stage's own file holds: rows in, derived events out.

Rows may leave out the envelope, as in a rule's tests, and `confidence` (1) and `vx` and `vy` (0).
"""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import pyarrow as pa

from events import events_of, schema_of
from events.catalogue import SHIPPED
from patterns.binding.expressions import Kind
from patterns.errors import PatternError, RuleError
from patterns.stages.running import derive, reads
from patterns.stages.settings import Stage
from patterns.tools.cases import TestResult, agrees, shown
from patterns.tools.given import check_columns, column_type, given_rows

_ENVELOPE = {
    "time": Kind.TIME, "sequence": Kind.INT, "station": Kind.STRING, "source": Kind.STRING, "type": Kind.STRING,
}  # fmt: skip
_SEEN = {"confidence": 1.0, "vx": 0.0, "vy": 0.0}


def run_stage_tests(stage: Stage) -> list[TestResult]:
    """The results of the stage's tests, in their order.

    Raises:
        RuleError: A test's rows cannot be read.
    """
    return [_result(stage, index) for index in range(len(stage.tests))]


def stage_rows(stage: Stage, index: int) -> pa.Table:
    """The rows of the stage's test of this index.

    Raises:
        RuleError: The CSV file is not there, or a value is not of its column's type.
    """
    folder = stage.path.parent if stage.path is not None else Path()
    rows = given_rows(stage.tests[index].given, folder, partial(stage.passage, "tests", index, "given"))
    kinds = _ENVELOPE | reads(stage)
    fields = next((schema_of(each).names for each in SHIPPED if each.type_name == stage.reads), None)
    if fields is not None:
        check_columns(rows, {*kinds, *fields, "subject"})
    sources = {zone.source for zone in stage.occupancy.zones.values()} if stage.occupancy else set()
    plain: dict[str, Any] = {
        "station": "test",
        "source": sources.pop() if len(sources) == 1 else "test",
        "type": stage.reads,
    }
    plain |= {name: value for name, value in _SEEN.items() if name in kinds}
    columns: dict[str, list[Any]] = {name: [] for name in kinds}
    for row in rows:
        defaults = {"sequence": row.number, **plain}
        for name, kind in kinds.items():
            value = row.typed(name, kind)
            columns[name].append(defaults.get(name) if value is None else value)
    return pa.table({name: pa.array(values, column_type(kinds[name])) for name, values in columns.items()})


def _result(stage: Stage, index: int) -> TestResult:
    case = stage.tests[index]
    name = case.name or (case.given if isinstance(case.given, str) else f"test {index + 1}")
    try:
        found = [
            {"source": each.source} | dict(event)
            for each in derive(stage, stage_rows(stage, index), dict(case.frames))
            for event in events_of(each.batch)
        ]
        difference = _difference(case.expect, found)
    except RuleError:
        raise
    except PatternError as error:
        difference = f"! {error}"
    place = stage.passage("tests", index).place(0)
    return TestResult(stage.stage, name, passed=not difference, difference=difference, place=place)


def _difference(wanted: tuple[Mapping[str, Any], ...], found: list[dict[str, Any]]) -> str:
    """Wanted and found side by side, in order, as in a rule's tests; empty if nothing differs."""
    lines = []
    is_equal = len(wanted) == len(found)
    for index in range(max(len(wanted), len(found))):
        want = wanted[index] if index < len(wanted) else None
        have = found[index] if index < len(found) else None
        if want is not None and have is not None and agrees(want, have):
            lines.append(f"  {shown(want)}")
            continue
        is_equal = False
        lines += [f"- {shown(want)}"] if want is not None else []
        lines += [f"+ {shown({name: have.get(name) for name in want or have})}"] if have is not None else []
    return "" if is_equal else "\n".join(lines)
