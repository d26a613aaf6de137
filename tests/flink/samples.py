"""Seeded rows for any rule, and seeded rules of the part of the language that Flink has."""

from collections.abc import Iterator
from datetime import timedelta
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa

from patterns import FrameSize, Rule, bind
from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Call, Column, Const, Expr, Kind, OneOf, walk
from patterns.scene.ground import Calibration
from patterns.scene.site import Site
from tests.patterns.samples import BEGINNING, letter_rule

FRAME: FrameSize = (1000, 1000)
_STEPS_US = [0, 0, 1, 333, 999, 1_000, 40_000, 40_000, 33_333, 500_000, 1_000_000, 1_000_000, 3_000_000, 11_000_000]


def site_of(rule: Rule) -> Site:
    """A site in which each source that the rule has a normalised place in has a frame size, and metres if it asks."""
    shapes = (*rule.zones.values(), *rule.lines.values())
    sources = {shape.source for shape in shapes if shape.units == "normalised"}
    calibration = Calibration(((0.1, 0.0, 0.0), (0.0, -0.1, 100.0), (0.0, 0.0, 1.0)), FRAME)
    is_asking = any(word in rule.match for word in ("ground_", "speed_kmh", "distance_m"))
    return Site.of(dict.fromkeys(sources, FRAME), calibrations=dict.fromkeys(sources, calibration) if is_asking else {})


def random_rows(rule: Rule, schemas: dict[str, pa.Schema], site: Site, seed: int, count: int) -> pa.Table:
    """Rows that tie, leave gaps, come from several sources and have NULLs, sorted by time."""
    random = Random(seed)
    bound = bind(rule, schemas, site=site)
    kinds = {name: kind for arm in bound.inputs for name, kind in arm.reads.items()}
    kinds |= {"time": Kind.TIME, "sequence": Kind.INT, "source": Kind.STRING, "station": Kind.STRING,
              "type": Kind.STRING}  # fmt: skip
    pools = _pools(bound, kinds, random)
    own = {shape.source for shape in (*rule.zones.values(), *rule.lines.values())} | {name for name, _ in site.versions}
    is_calibrated = any(isinstance(each[-1].said, Calibration) for each in site.versions.values())
    # A source of which nothing is known may be asked for its zones, but not for its ground.
    sources = [*sorted(own), *sorted(_named_sources(bound)), *([] if is_calibrated else ["another", "an-other"])]
    columns: dict[str, list[Any]] = {name: [] for name in kinds}
    us = 0
    sequences: dict[tuple[str, str], int] = {}
    for _ in range(count):
        us += random.choice(_STEPS_US)
        source = random.choice(sources if random.random() < 0.3 else sources[:1])
        event_type = random.choice(sorted(bound.types))
        sequence = sequences[source, event_type] = sequences.get((source, event_type), 0) + 1
        given = {"time": BEGINNING + timedelta(microseconds=us), "sequence": sequence, "source": source,
                 "station": "here", "type": event_type}  # fmt: skip
        for name, values in columns.items():
            values.append(given[name] if name in given else random.choice(pools[name]))
    return pa.table({name: pa.array(values, _arrow_type(kinds[name])) for name, values in columns.items()})


def _named_sources(bound: BoundRule) -> set[str]:
    """Texts that the rule compares `source` with."""
    return {
        str(part.operands[1].value)
        for expr in _expressions(bound) for part in walk(expr)
        if isinstance(part, Call) and part.op == "=" and part.operands[0] == Column("source", Kind.STRING)
        and isinstance(part.operands[1], Const)
    }  # fmt: skip


def _pools(bound: BoundRule, kinds: dict[str, Kind], random: Random) -> dict[str, list[Any]]:
    """For each column the values to choose from: what the rule compares with, and a few beside."""
    constants: dict[Kind, list[Any]] = {kind: [] for kind in Kind}
    for expr in _expressions(bound):
        for part in walk(expr):
            if isinstance(part, Const) and part.value is not None:
                constants[part.kind].append(part.value)
            if isinstance(part, OneOf):
                constants[part.operands[0].kind] += sorted(part.values, key=str)[:5]
    numbers = sorted(set(constants[Kind.FLOAT] + [float(each) for each in constants[Kind.INT]])) or [0.0]
    # Of doubles those that a float32 holds, as the columns of events do.
    places = [round(random.uniform(0, 1000) * 4) / 4 for _ in range(30)] + [100.0, 550.0, 620.0, 500.0]
    pools = {
        Kind.BOOL: [True, False, None],
        Kind.INT: [1, 1, 1, 2, 2, 3, *constants[Kind.INT]],
        Kind.STRING: ["a", "b", "ä'", None, *constants[Kind.STRING], *constants[Kind.STRING]],
        Kind.FLOAT: [*(float(np.float32(each + more)) for each in numbers for more in (0, 0.5)), 1.0, 1.0, 1.0, None],
        Kind.TIME: [BEGINNING, BEGINNING + timedelta(seconds=3), None],
        Kind.DURATION: [timedelta(seconds=1), timedelta(milliseconds=1), None],
    }
    found = {name: pools[kind] for name, kind in kinds.items()}
    found["subject"] = ["one", "two", None]
    for name in ("x", "y", "x1", "x2", "y1", "y2"):
        found[name] = [*places, None]
    return found


def _expressions(bound: BoundRule) -> Iterator[Expr]:
    yield from bound.predicates
    yield from bound.slots
    yield from (each.guard for each in bound.conditions if each.guard is not None)
    yield from (each.where for each in bound.inputs if each.where is not None)


def _arrow_type(kind: Kind) -> pa.DataType:
    return {
        Kind.BOOL: pa.bool_(), Kind.INT: pa.int64(), Kind.FLOAT: pa.float64(), Kind.STRING: pa.string(),
        Kind.TIME: pa.timestamp("us", "UTC"), Kind.DURATION: pa.duration("us"),
    }[kind]  # fmt: skip


_SHARED = (
    "{v}.letter = '{l}'", "{v}.letter = '{l}'", "letter = '{l}'", "NOT {v}.letter = 'a'", "{v}.letter = 'a'",
    "{v}.n > 1", "{v}.n <= 1", "{v}.letter IN ('a', 'c')", "{v}.flag", "NOT {v}.flag",
    "COALESCE({v}.n, 2) = 2", "{v}.v * 2 >= 1.5", "{v}.n IS NULL", "{v}.n / {v}.n = 1", "{v}.n % 2 = 1",
    "CASE WHEN {v}.n = 1 THEN TRUE WHEN {v}.n = 2 THEN FALSE ELSE {v}.flag END",
    "LEAST({v}.n, 2) = {v}.n", "{v}.gap >= INTERVAL '1' SECOND",
)  # fmt: skip
_BACK = (
    "{v}.n > PREV({v}.n)", "{v}.n >= {o}.n", "{v}.time < {o}.time + INTERVAL '0.0004' SECOND",
    "{v}.time - {o}.time >= INTERVAL '0.000333' SECOND", "{v}.n <= FIRST({o}.n) + 1", "COUNT({o}.*) <= 2",
    "COUNT(*) <= 3", "{v}.time >= FIRST({o}.time) + INTERVAL '40' MILLISECOND", "{v}.v + {o}.v > 1",
)  # fmt: skip
_QUANTIFIERS = ("", "", "", "?", "*", "+", "{2}", "{1,2}", "{2,}", "*?", "+?", "{1,3}?", "{2,}?")
_MEASURES = (
    "{v}.n AS m{i}", "FIRST({v}.v) AS m{i}", "COUNT({v}.n) AS m{i}", "COUNT(*) AS m{i}", "{v}.time AS m{i}",
    "LAST({v}.time) - FIRST({v}.time) AS m{i}", "{v}.letter AS m{i}", "{v}.n + 1 AS m{i}", "{v}.flag AS m{i}",
    "CASE WHEN {v}.n > 1 THEN 'many' ELSE 'few' END AS m{i}", "{v}.n / 2 AS m{i}", "{v}.v / 3 AS m{i}",
    "FIRST(n) AS m{i}", "LAST(letter) AS m{i}",
)  # fmt: skip


def random_rule(seed: int) -> Rule:
    """A rule over the type `letter` with a row of elements as its pattern; Flink may have to refuse it."""
    random = Random(seed)
    variables = "ABCD"[: random.randint(2, 4)]
    parts = [f"{variable}{random.choice(_QUANTIFIERS)}" for variable in variables]
    defines = []
    for at, variable in enumerate(variables):
        chosen = [random.choice(_SHARED).format(v=variable, l="abc"[at % 3])] if random.random() < 0.9 else []
        if at and random.random() < 0.3:
            chosen.append(random.choice(_BACK).format(v=variable, o=random.choice(variables[:at])))
        if chosen:
            defines.append(f"{variable} AS {' AND '.join(chosen)}")
    measures = ", ".join(
        random.choice(_MEASURES).format(v=random.choice(variables), i=index) for index in range(random.randint(0, 3))
    )
    skip = random.choice(["PAST LAST ROW", "PAST LAST ROW", "TO NEXT ROW", f"TO LAST {variables[-1]}"])
    within = random.choice(["", "INTERVAL '3' SECOND", "INTERVAL '40' MILLISECOND", "INTERVAL '0.0005' SECOND"])
    return letter_rule(
        " ".join(parts), ", ".join(defines), measures, skip, within, random.choice(["key", "source, key"])
    )


_TIMED = (
    "A T", "A B* T", "A B*? T", "Z A B* T", "A T B", "A B? T", "A B* T C", "Z? A T",
)  # fmt: skip
_LIMITS = ("INTERVAL '1' MILLISECOND", "INTERVAL '0.000333' SECOND", "INTERVAL '40' MILLISECOND", "INTERVAL '2' SECOND")


def random_timer_rule(seed: int) -> Rule:
    """A rule over the type `letter` that waits for something; Flink may have to refuse it."""
    random = Random(seed)
    conditions = {"A": "letter = 'a'", "B": "letter = 'b'", "C": "letter = 'c'", "Z": "letter = 'c'"}
    pattern = random.choice(_TIMED)
    used = [name for name in conditions if name in pattern]
    if random.random() < 0.5:
        conditions["A"] += " AND A.n > 0"
    defines = [f"{name} AS {conditions[name]}" for name in used]
    more = " AND T.time < A.time + INTERVAL '1' SECOND" if random.random() < 0.2 else ""
    defines.append(f"T AS TIMER(A.time, {random.choice(_LIMITS)}){more}")
    measures = ["T.time AS due", "A.n AS n", "FIRST(time) AS began"]
    measures += ["COUNT(B.n) AS many, COUNT(B.*) AS rows_b, COUNT(B.time) AS times"] if "B*" in pattern else []
    skip = random.choice(["PAST LAST ROW", "PAST LAST ROW", "TO NEXT ROW", "TO LAST A"])
    skip = "PAST LAST ROW" if skip == "TO LAST A" and pattern.startswith("A") else skip
    within = random.choice(["", "INTERVAL '3' SECOND", "INTERVAL '1' SECOND"])
    return letter_rule(
        pattern, ", ".join(defines), ", ".join(measures), skip, within, random.choice(["key", "source, key"])
    )


def random_letters(seed: int, count: int) -> pa.Table:
    """Rows of the type `letter` for random rules: few letters, ties, NULLs."""
    from tests.patterns.samples import letter_rows

    random = Random(seed)
    us = 0
    records = []
    sequences = {"cam-01": 0, "cam-1": 0, "cam-01/b": 0}
    for _ in range(count):
        us += random.choice([0, 0, 1, 333, 667, 1_000, 40_000, 1_000_000])
        source = random.choice(["cam-01", "cam-01", "cam-1"])
        sequences[source] += 1
        records.append({
            "us": us, "key": random.choice([0, 1]), "letter": random.choice("aaabbbc"), "source": source,
            "n": random.choice([None, 0, 1, 1, 2, 3]), "v": random.choice([None, 0.1, 0.5, 0.75, 2.0]),
            "flag": random.choice([None, True, False]), "sequence": sequences[source],
            "gap": random.choice([None, timedelta(seconds=1), timedelta(milliseconds=999)]),
        })  # fmt: skip
    return letter_rows(records)
