"""What Python computes of a query's conditions, it computes as DuckDB does: the same expressions, by both."""

import operator
from itertools import product
from typing import Any

import pyarrow as pa
import pytest

from patterns.language.parser import parse_clause
from patterns.language.text import Passage
from patterns.querying.duck import Duck
from patterns.querying.plain import NotAlike, operands, plain
from patterns.querying.values import Span, compared, values_of

VALUES = {
    "INTEGER": ("0", "1", "-7", "3", "46340", "NULL"),
    "BIGINT": ("0", "2", "-5", "33554433", "NULL"),
    "DOUBLE": ("0", "-0.0", "0.1", "-2.5", "1e300", "7", "'nan'", "'inf'", "NULL"),
    "FLOAT": ("0", "0.1", "-2.7", "16777217", "3e38", "NULL"),
    "DECIMAL(9,2)": ("0", "0.10", "-3.25", "1234567.89", "NULL"),
    "DECIMAL(3,1)": ("0.1", "-2.5", "10.0", "NULL"),
    "VARCHAR": ("''", "'a'", "'é z'", "NULL"),
    "DATE": ("'2026-01-01'", "'1969-12-31'", "'2024-02-29'", "NULL"),
    "TIMESTAMP": ("'2026-01-01 10:00:00.9'", "'2026-03-01 09:59:59.999999'", "'1969-12-31 23:59:59.5'", "NULL"),
    "TIMESTAMPTZ": ("'2026-01-01 10:00:00.9+00'", "'2026-03-29 01:30:00+00'", "'2025-12-31 23:59:59+00'", "NULL"),
    "INTERVAL": ("'1 day'", "'24 hours'", "'30 days'", "'1 month'", "'-90 seconds'", "NULL"),
}
NUMBERS = ("INTEGER", "DOUBLE", "FLOAT", "DECIMAL(9,2)")
TIMES = ("TIMESTAMP", "TIMESTAMPTZ")
CASES = [
    *((f"a {sign} b", one, two) for sign, one, two in product("-*", NUMBERS, ("BIGINT", "DOUBLE", "DECIMAL(3,1)"))),
    *((f"a {sign} b", "FLOAT", two) for sign, two in product("+/", ("INTEGER", "FLOAT", "DECIMAL(3,1)"))),
    *(("a / b", one, two) for one, two in product(("INTEGER", "DOUBLE", "DECIMAL(9,2)"), ("INTEGER", "DOUBLE"))),
    *((text, one, "INTEGER") for text, one in product(("-a", "abs(a)"), NUMBERS)),
    *((text, "DOUBLE", "INTEGER") for text in ("pow(a, b)", "a ** b", "a % b", "floor(a)", "ceil(a)", "sqrt(abs(a))")),
    *((text, "INTEGER", "BIGINT") for text in ("a % b", "a // b", "b / a", "sqrt(b * b)", "a::DOUBLE")),
    *((text, "DOUBLE", "DECIMAL(3,1)") for text in ("greatest(a, b)", "least(a, b)", "coalesce(a, b)", "b::DOUBLE")),
    *((text, one, one) for text, one in product(("greatest(a, b)", "least(b, a)", "ifnull(a, b)"),
                                                ("INTEGER", "VARCHAR", "DATE", "TIMESTAMP"))),
    ("a || b", "VARCHAR", "VARCHAR"),
    ("a - b", "DATE", "DATE"),
    *(("a - b", one, one) for one in TIMES),
    *((f"a {sign} b", one, "INTERVAL") for sign, one in product("+-", TIMES)),
    *((f"date_diff('{unit}', a, b)", one, one)
      for unit, one in product(("second", "minutes", "hour", "day", "millisecond"), TIMES)),
    ("epoch(a)", "INTERVAL", "INTERVAL"),
    ("extract(epoch FROM a)", "INTERVAL", "INTERVAL"),
]  # fmt: skip


@pytest.fixture(scope="module")
def duck() -> Duck:
    return Duck(questions_most=0)


def table_of(duck: Duck, one: str, two: str) -> pa.Table:
    rows = ", ".join(f"({first}, {second})" for first, second in product(VALUES[one], VALUES[two]))
    return duck.table(f"SELECT CAST(a AS {one}) AS a, CAST(b AS {two}) AS b FROM (VALUES {rows}) AS t(a, b)")


def parsed(text: str) -> Any:
    clause, _ = parse_clause(Passage.alone(f"MATCH_RECOGNIZE (MEASURES {text} AS m PATTERN (A))"), 0)
    return clause.measures[0].value.node


def is_same(left: Any, right: Any) -> bool:
    if isinstance(left, Span) and isinstance(right, Span):
        return left.length_us == right.length_us
    return type(left) is type(right) and (left == right or (left != left and right != right))


@pytest.mark.parametrize(("text", "one", "two"), CASES, ids=lambda part: str(part))
def test_python_computes_as_duckdb_does(duck: Duck, text: str, one: str, two: str) -> None:
    table = table_of(duck, one, two)
    node = parsed(text)
    parts = operands(node)
    assert parts, "Python knows the form"
    types = {"a": one, "b": two}
    *kinds, given = duck.types([part.sql("duckdb") for part in [*parts, node]], types)
    known = plain(node, kinds, given)
    assert known, "Python knows the types"
    wanted = values_of(duck.columns(table, [text])[0])
    below = list(
        zip(*(values_of(each) for each in duck.columns(table, [part.sql("duckdb") for part in parts])), strict=True)
    )
    found = 0
    for values, want in zip(below, wanted, strict=True):
        if None in values and not known.takes_null:
            assert want is None
            continue
        try:
            got = known.operator(*values)
        except (ArithmeticError, ValueError, NotAlike):
            continue  # DuckDB is asked
        found += 1
        assert is_same(got, want), (text, values, got, want)
    assert found, "something was computed"


@pytest.mark.parametrize("kind", ["INTEGER", "DOUBLE", "FLOAT", "DECIMAL(9,2)", "VARCHAR", "DATE", *TIMES, "INTERVAL"])
def test_python_compares_as_duckdb_does(duck: Duck, kind: str) -> None:
    signs = {"=": operator.eq, "<>": operator.ne, "<": operator.lt, "<=": operator.le, ">": operator.gt,
             ">=": operator.ge}  # fmt: skip
    table = table_of(duck, kind, kind)
    pairs = list(zip(values_of(table.column("a")), values_of(table.column("b")), strict=True))
    answers = duck.columns(table, [f"a {sign} b" for sign in signs])
    for compare, answer in zip(signs.values(), answers, strict=True):
        for (left, right), want in zip(pairs, answer.to_pylist(), strict=True):
            if left is not None and right is not None:
                assert compared(compare, left, right) in (want, None)
