"""Rows and rules that the tests of `patterns` share."""

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import Any

import pyarrow as pa
from hypothesis import strategies as st

from patterns import BoundRule, Match, Rule, RuleError, bind, parse_rule
from tests.patterns.reference import Tree

BEGINNING = datetime(2026, 1, 1, 10, tzinfo=UTC)
"""Time of row 0."""

_F = pa.float32()
SCHEMAS = {
    "letter": pa.schema(
        [
            ("time", pa.timestamp("us", "UTC")),
            ("key", pa.int64()),
            ("letter", pa.string()),
            ("n", pa.int64()),
            ("v", pa.float64()),
            ("flag", pa.bool_()),
            ("gap", pa.duration("us")),
            ("blob", pa.binary()),
        ]
    ),
    "track_point": pa.schema(
        [
            ("time", pa.timestamp("us", "UTC")),
            ("track_id", pa.int64()),
            ("frame", pa.int64()),
            *[(name, _F) for name in ("x", "y", "x1", "y1", "x2", "y2", "vx", "vy", "confidence")],
        ]
    ),
}


def letters(text: str, key: int = 0, numbers: Sequence[int | None] | None = None, step_s: float = 1.0) -> pa.Table:
    """One row a letter, `step_s` seconds apart; `n` is the row's number unless given."""
    records = [
        {"us": round(index * step_s * 1e6), "key": key, "letter": letter, "n": numbers[index] if numbers else index}
        for index, letter in enumerate(text)
    ]
    return letter_rows(records)


def letter_rows(records: Sequence[Mapping[str, Any]]) -> pa.Table:
    """Rows of the type `letter`; `us` is the time after the beginning, the rest has defaults."""
    count = len(records)

    def column(name: str, default: Any = None) -> list[Any]:
        return [record.get(name, default) for record in records]

    times = [BEGINNING + timedelta(microseconds=record["us"]) for record in records]
    sequences = [record.get("sequence", index) for index, record in enumerate(records)]
    return pa.table(
        {
            "time": pa.array(times, pa.timestamp("us", "UTC")),
            "sequence": pa.array(sequences, pa.int64()),
            "source": pa.array(column("source", "cam-01"), pa.string()),
            "station": pa.array(["here"] * count, pa.string()),
            "subject": pa.array([None] * count, pa.string()),
            "type": pa.array(column("type", "letter"), pa.string()),
            "key": pa.array(column("key", 0), pa.int64()),
            "letter": pa.array(column("letter"), pa.string()),
            "n": pa.array(column("n"), pa.int64()),
            "v": pa.array(column("v"), pa.float64()),
            "flag": pa.array(column("flag"), pa.bool_()),
            "gap": pa.array(column("gap"), pa.duration("us")),
            "blob": pa.array([None] * count, pa.binary()),
        }
    )


def letter_rule(
    pattern: str,
    define: str = "",
    measures: str = "",
    skip: str = "PAST LAST ROW",
    within: str = "",
    partition: str = "key",
    more: str = "",
    subset: str = "",
    source: str = "letter",
) -> Rule:
    """A rule over the type `letter`; a variable that DEFINE leaves out takes rows of its own letter."""
    clauses = [
        f"PARTITION BY {partition}" if partition else "",
        "ORDER BY time, sequence",
        f"MEASURES {measures}" if measures else "",
        "ONE ROW PER MATCH",
        f"AFTER MATCH SKIP {skip}",
        f"PATTERN ({pattern})",
        f"WITHIN {within}" if within else "",
        f"SUBSET {subset}" if subset else "",
        f"DEFINE {define}" if define else "",
    ]
    body = "\n    ".join(clause for clause in clauses if clause)
    return parse_rule(
        f"rule: sample\nversion: 1\ntitle: sample\nseverity: info\n{more}\n"
        f"match: |\n  SELECT * FROM {source} MATCH_RECOGNIZE (\n    {body})\n"
    )


def bound_unless_empty(rule: Rule) -> BoundRule | None:
    """The rule, bound; None if it is refused because its pattern can only match no row at all."""
    try:
        return bind(rule, SCHEMAS)
    except RuleError as error:
        if "can only match no row" not in error.message:
            raise
        return None


def define_letters(names: str) -> str:
    """A DEFINE in which each of these variables takes the rows of its letter."""
    return ", ".join(f"{name} AS letter = '{name.lower()}'" for name in names)


def classified(match: Match) -> dict[str, list[int]]:
    """For each variable the sequences of its rows; only where sequences are without gaps."""
    return {
        variable: [
            sequence for each in ranges for sequence in range(each.first_sequence, each.last_sequence + 1)
        ]
        for variable, ranges in match.lineage.items()
    }  # fmt: skip


def spans(matches: Sequence[Match]) -> list[tuple[int, int]]:
    """For each match the sequences of its first and last row."""
    return [(match.first.sequence, match.last.sequence) for match in matches]


@cache
def trees(variables: str, leaves: int = 5) -> st.SearchStrategy[Tree]:
    """Random patterns over these variables."""
    quantifiers = st.sampled_from([(0, None), (1, None), (0, 1), (2, 2), (1, 2), (2, None), (0, 2), (1, 3)])

    def grown(inner: st.SearchStrategy[Tree]) -> st.SearchStrategy[Tree]:
        several = st.lists(inner, min_size=2, max_size=3).map(tuple)
        return st.one_of(
            several.map(lambda parts: ("cat", parts)),
            several.map(lambda parts: ("alt", parts)),
            st.tuples(inner, quantifiers, st.booleans()).map(lambda t: ("rep", t[0], t[1][0], t[1][1], t[2])),
        )

    return st.recursive(st.sampled_from(variables).map(lambda name: ("var", name)), grown, max_leaves=leaves)


@st.composite
def partitions(draw: st.DrawFn) -> list[list[dict[str, Any]]]:
    """Rows of one or two partitions, with times that tie and numbers that are NULL."""
    result = []
    for key in range(draw(st.integers(1, 2))):
        rows = draw(
            st.lists(
                st.tuples(st.integers(0, 2), st.sampled_from("abc"), st.one_of(st.none(), st.integers(0, 3))),
                max_size=7,
            )
        )
        us = 0
        records = []
        for index, (step, letter, n) in enumerate(rows):
            us += step
            records.append({"us": us, "key": key, "letter": letter, "n": n, "sequence": key * 1000 + index})
        result.append(records)
    return result
