"""Clauses in queries: every part of the language over a few rows, and what is refused."""

from collections.abc import Sequence
from typing import Any

import pyarrow as pa
import pytest

from patterns import LimitError, Limits, MatchError, RuleError, SkipError
from tests.patterns.recognised import recognised, recognised_in, tuples

FALL = "(1, 90), (2, 80), (3, 70), (4, 70)"
FALLING = "B AS B.value < PREV(B.value)"
NOT_RISING = "B AS B.value <= PREV(B.value)"


def _labels(pattern: str, define: str = FALLING, rows: str = FALL, more: str = "") -> list[Sequence[Any]]:
    """Row, number of its match and variable, of all rows of all matches."""
    clause = (
        f"ORDER BY id MEASURES MATCH_NUMBER() AS number, CLASSIFIER() AS label ALL ROWS PER MATCH {more} "
        f"PATTERN ({pattern}) DEFINE {define}"
    )
    return tuples(recognised(clause, rows), "id", "number", "label")


def _measured(measure: str, define: str = NOT_RISING, rows: str = FALL) -> list[Any]:
    """One measure of all rows of a match A B+; U is A or B."""
    clause = f"ORDER BY id MEASURES {measure} AS m ALL ROWS PER MATCH PATTERN (A B+) SUBSET U = (A, B) DEFINE {define}"
    return recognised(clause, rows).column("m").to_pylist()


@pytest.mark.parametrize(
    "pattern,wanted",
    [
        ("() | B", [(1, 1, None), (2, 2, None), (3, 3, None), (4, 4, None)]),
        ("B | ()", [(1, 1, None), (2, 2, "B"), (3, 3, "B"), (4, 4, None)]),
        ("(B ()*)*", [(1, 1, None), (2, 2, "B"), (3, 2, "B"), (4, 3, None)]),
        ("B*?", [(1, 1, None), (2, 2, None), (3, 3, None), (4, 4, None)]),
        ("B??", [(1, 1, None), (2, 2, None), (3, 3, None), (4, 4, None)]),
        ("B{,}", [(1, 1, None), (2, 2, "B"), (3, 2, "B"), (4, 3, None)]),
        ("B{,1}", [(1, 1, None), (2, 2, "B"), (3, 3, "B"), (4, 4, None)]),
        ("B{2}", [(2, 1, "B"), (3, 1, "B")]),
        ("^ B?", [(1, 1, None)]),
        ("^A", [(1, 1, "A")]),
        ("A ^ B", []),
        ("B A $", [(3, 1, "B"), (4, 1, "A")]),
        ("$ B", []),
        ("(^* | B)", [(1, 1, None), (2, 2, None), (3, 3, None), (4, 4, None)]),
        ("(^+ | B)", [(1, 1, None), (2, 2, "B"), (3, 3, "B")]),
        ("($+ | B)", [(2, 1, "B"), (3, 2, "B")]),
        ("A {- B+ -} C", [(1, 1, "A"), (4, 1, "C")]),
        ("A {- {- B -} B -} C", [(1, 1, "A"), (4, 1, "C")]),
        ("{- A B -}", []),
        ("{- A -}{1,1} B", [(2, 1, "B")]),
        ("PERMUTE(A, B)", [(1, 1, "A"), (2, 1, "B"), (3, 2, "B"), (4, 2, "A")]),
        ("PERMUTE(C, A B, D)", [(1, 1, "C"), (2, 1, "A"), (3, 1, "B"), (4, 1, "D")]),
        ("PERMUTE(B B, A)", [(1, 1, "A"), (2, 1, "B"), (3, 1, "B")]),
        ('a "b"', [(1, 1, "A"), (2, 1, "b"), (3, 2, "A"), (4, 2, "b")]),
    ],
)  # fmt: skip
def test_patterns(pattern: str, wanted: list[Any] | None) -> None:
    define = FALLING if "B" in pattern else "A AS true"
    assert _labels(pattern, define) == wanted


def test_of_eight_parts_in_any_order_the_first_by_their_numbers_is_preferred() -> None:
    rows = ", ".join(f"({number}, {number % 8})" for number in range(8))
    parts = "ABCDEFGH"
    define = ", ".join(f"{part} AS value = {7 - number}" for number, part in enumerate(parts))
    assert [label for _, _, label in _labels(f"PERMUTE({', '.join(parts)})", define, rows)] == list(reversed(parts))


@pytest.mark.parametrize(
    "measure,wanted",
    [
        ("value", [90, 80, 70, 70]),
        ("FINAL LAST(value)", [70, 70, 70, 70]),
        ("FIRST(B.value)", [None, 80, 80, 80]),
        ("FINAL FIRST(B.value)", [80, 80, 80, 80]),
        ("LAST(U.value, 1)", [None, 90, 80, 70]),
        ("FIRST(value, 2)", [None, None, 70, 70]),
        ("LAST(value + 10 * id)", [100, 100, 100, 110]),
        ("PREV(value)", [None, 90, 80, 70]),
        ("PREV(value, 0)", [90, 80, 70, 70]),
        ("NEXT(A.value)", [80, 80, 80, 80]),
        ("PREV(LAST(B.value), 2)", [None, None, 90, 80]),
        ("NEXT(FIRST(B.value, 1), 1)", [None, None, 70, 70]),
        ("NEXT(FINAL LAST(B.value))", [None] * 4),
        ("NEXT(CLASSIFIER())", ["B", "B", "B", None]),
        ("CLASSIFIER(B)", [None, "B", "B", "B"]),
        ("LAST(CLASSIFIER() || value)", ["A90", "B80", "B70", "B70"]),
        ("LAST(value + MATCH_NUMBER(), 1)", [None, 91, 81, 71]),
        ("count(*)", [1, 2, 3, 4]),
        ("count(B.*)", [0, 1, 2, 3]),
        ("FINAL count(U.value)", [4, 4, 4, 4]),
        ("count(DISTINCT value)", [1, 2, 3, 3]),
        ("sum(B.value)", [None, 80, 150, 220]),
        ("avg(value)", [90, 85, 80, 77.5]),
        ("max_by(id, value)", [1, 1, 1, 1]),
        ("sum(value) FILTER (WHERE value < 85)", [None, 80, 150, 220]),
        ("array_agg(value ORDER BY value)", [[90], [80, 90], [70, 80, 90], [70, 70, 80, 90]]),
        ("string_agg(CLASSIFIER(), '-')", ["A", "A-B", "A-B-B", "A-B-B-B"]),
        ("bool_and(CLASSIFIER() = 'A')", [True, False, False, False]),
        ("count(A.value) + B.value", [None, 81, 71, 71]),
        ("value / 4", [22, 20, 17, 17]),
        ("CASE WHEN count(*) > 2 THEN 'late' ELSE lower(CLASSIFIER()) END", ["a", "b", "late", "late"]),
        ("greatest(FIRST(value), 85) - LAST(value)", [0, 10, 20, 20]),
    ],
)  # fmt: skip
def test_measures(measure: str, wanted: list[Any]) -> None:
    assert _measured(measure) == wanted


@pytest.mark.parametrize(
    "define,rows",
    [
        ("B AS value < A.value - 15", []),
        ("B AS abs(value - A.value) < 15", [1, 2]),
        ("B AS value * 1.0 BETWEEN 75 AND FIRST(A.value)", [1, 2]),
        ("B AS value NOT IN (A.value, 70)", [1, 2]),
        ("B AS LAST(B.value, 1) IS NULL OR B.value < LAST(B.value, 1)", [1, 2, 3]),
        ("B AS sum(B.value) < 200", [1, 2, 3]),
        ("B AS avg(value) > 80", [1, 2]),
        ("B AS min(U.value) = max(B.value)", [1, 2]),
        ("B AS count(DISTINCT value) < 3", [1, 2]),
        ("B AS len(array_agg(B.value)) < 3", [1, 2, 3]),
        ("B AS max_by(CLASSIFIER(), id) = 'B' AND count(*) < 4", [1, 2, 3]),
        ("B AS PREV(CLASSIFIER()) = 'A'", [1, 2]),
        ("B AS PREV(CLASSIFIER(A)) IS NULL AND NEXT(FIRST(CLASSIFIER())) = 'B'", [1, 2, 3, 4]),
        ("B AS CLASSIFIER() = 'B' AND CLASSIFIER(U) = 'B' AND lower(FIRST(CLASSIFIER())) = 'a'", [1, 2, 3, 4]),
        ("B AS NEXT(value) < 80", [1, 2, 3]),
        ("B AS PREV(FIRST(B.value, 1), 1) IS NULL OR PREV(FIRST(B.value, 1), 1) = 80", [1, 2, 3, 4]),
        ("B AS LAST(value * MATCH_NUMBER()) = 80", [1, 2]),
        ("B AS value < 85 AND NULL", []),
        ("B AS CASE WHEN A.value > 85 THEN value > 75 END", [1, 2]),
        ("B AS (value::DECIMAL(9, 2) < A.value * 0.95) IS NOT FALSE", [1, 2, 3, 4]),
    ],
)  # fmt: skip
def test_conditions(define: str, rows: list[int]) -> None:
    clause = f"ORDER BY id ALL ROWS PER MATCH PATTERN (^ A B+) SUBSET U = (A, B) DEFINE {define}"
    assert recognised(clause, FALL).column("id").to_pylist() == rows


def test_an_equal_variable_looks_back_at_each_way_of_matching() -> None:
    define = "X AS value = PREV(LAST(A.value), 3) + FIRST(A.value) + PREV(LAST(B.value), 2)"
    rows = ", ".join(f"({number}, {number})" for number in range(1, 7))
    assert [label for _, _, label in _labels("(A | B)* X", define, rows)] == list("BAAABX")


@pytest.mark.parametrize(
    "rows,wanted",
    [
        ("ONE ROW PER MATCH", [(1, 0, None, None), (2, 2, "B", 150), (3, 0, None, None)]),
        ("ALL ROWS PER MATCH OMIT EMPTY MATCHES", [(2, 1, "B", 80), (2, 2, "B", 150)]),
        ("ALL ROWS PER MATCH", [(1, 0, None, None), (2, 1, "B", 80), (2, 2, "B", 150), (3, 0, None, None)]),
    ],
)  # fmt: skip
def test_empty_matches_are_numbered_and_hold_nothing(rows: str, wanted: list[Any]) -> None:
    clause = (
        "ORDER BY id MEASURES MATCH_NUMBER() AS number, count(*) AS rows, CLASSIFIER() AS label, sum(value) AS total "
        f"{rows} PATTERN (B*) DEFINE {FALLING}"
    )
    assert tuples(recognised(clause, FALL), "number", "rows", "label", "total") == wanted


def test_unmatched_rows_have_no_measures_and_a_row_of_an_earlier_match_is_none() -> None:
    rows = "(1, 100), (2, 100), (3, 90), (4, 80), (5, 70), (6, 100)"
    clause = (
        "ORDER BY id MEASURES MATCH_NUMBER() AS number, CLASSIFIER() AS label, count(*) AS rows, 'x' AS x "
        f"ALL ROWS PER MATCH WITH UNMATCHED ROWS AFTER MATCH SKIP TO NEXT ROW PATTERN (A B{{2}}) DEFINE {FALLING}"
    )
    assert tuples(recognised(clause, rows)) == [
        (1, None, None, None, None, 100),
        (2, 1, "A", 1, "x", 100), (3, 1, "B", 2, "x", 90), (4, 1, "B", 3, "x", 80),
        (3, 2, "A", 1, "x", 90), (4, 2, "B", 2, "x", 80), (5, 2, "B", 3, "x", 70),
        (6, None, None, None, None, 100),
    ]  # fmt: skip


@pytest.mark.parametrize(
    "skip,starts",
    [
        ("PAST LAST ROW", [1]),
        ("TO NEXT ROW", [1, 2, 4]),
        ("TO FIRST C", [1, 4]),
        ("TO LAST B", [1, 4]),
        ("TO U", [1, 4]),
    ],
)
def test_where_the_search_goes_on(skip: str, starts: list[int]) -> None:
    clause = (
        f"ORDER BY id MEASURES FIRST(id) AS start AFTER MATCH SKIP {skip} PATTERN (A B+ C+ D?) SUBSET U = (C, D) "
        f"DEFINE {FALLING}, C AS C.value > PREV(C.value), D AS false"
    )
    rows = "(1, 90), (2, 80), (3, 70), (4, 80), (5, 70), (6, 80)"
    assert recognised(clause, rows).column("start").to_pylist() == starts


@pytest.mark.parametrize(
    "skip,message",
    [
        ("TO A", "AFTER MATCH SKIP TO LAST A: A is the first row of the match from id 1 to id 2, so the search"),
        ("TO FIRST D", "AFTER MATCH SKIP TO FIRST D: D is not in the match from id 1 to id 2. Next: skip to"),
    ],
)
def test_a_skip_to_nowhere_is_an_error(skip: str, message: str) -> None:
    clause = f"ORDER BY id MEASURES 1 AS m AFTER MATCH SKIP {skip} PATTERN (A B D?) DEFINE D AS false"
    with pytest.raises(SkipError, match=message):
        recognised(clause, FALL)


def test_the_number_of_the_match_can_decide_about_its_rows() -> None:
    define = "A AS max(value + MATCH_NUMBER()) > 5"
    rows = "(1, 1), (2, 2), (3, 3), (4, 4), (5, 5)"
    assert [label for _, _, label in _labels("(A | B)*", define, rows)] == list("BBBBA")
    clause = "ORDER BY id MEASURES MATCH_NUMBER() AS m PATTERN (A) DEFINE A AS MATCH_NUMBER() < 3"
    assert recognised(clause, rows).column("m").to_pylist() == [1, 2]


def test_a_search_start_by_start_ends_with_its_limit_named() -> None:
    rows = ", ".join(f"({at}, {at % 3})" for at in range(300))
    short = "ORDER BY id MEASURES MATCH_NUMBER() AS m PATTERN (A B) DEFINE A AS value = 0 AND MATCH_NUMBER() < 300"
    assert recognised(short, rows, limits=Limits(steps=1)).num_rows == 100, "what looks at few rows a start may go on"
    ahead = "ORDER BY id MEASURES 1 AS m PATTERN (A+ B) DEFINE A AS MATCH_NUMBER() < 3, B AS value > 5"
    wanted = r"3,\d+ steps so far over 300 rows, and the limit `steps` is 3,000. Next: ask for the number in MEASURES"
    with pytest.raises(LimitError, match=wanted):
        recognised(ahead, rows, limits=Limits(steps=1))
    with pytest.raises(LimitError, match="the limit `steps` is 20,000"):
        recognised(ahead, rows, limits=Limits(steps=20_000))


def test_columns_and_their_order() -> None:
    rows = "('o', 'p', 90)"
    clause = "PARTITION BY part ORDER BY id{} MEASURES CLASSIFIER() AS label {} PATTERN (A)"
    columns = "id, part, value"
    assert recognised(clause.format("", ""), rows, columns).column_names == ["part", "label"]
    everything = recognised(clause.format(", id DESC", "ALL ROWS PER MATCH"), rows, columns)
    assert everything.column_names == ["part", "id", "id_1", "label", "value"]


def test_types_are_those_that_duckdb_gives() -> None:
    clause = (
        "ORDER BY d MEASURES A.d AS d, A.n AS n, A.n / 2 AS h, avg(n) AS a, count(*) AS c, CLASSIFIER() AS l, "
        "A.s.x AS x, array_agg(n) AS r, A.n * 1.5 AS p PATTERN (A+)"
    )
    found = recognised(clause, "(DATE '2026-01-01', 7, {'x': 1.5}), (DATE '2026-01-02', 8, {'x': 2.5})", "d, n, s")
    assert [str(each) for each in found.schema.types] == [
        "date32[day]", "int32", "int32", "double", "int64", "string", "decimal128(2, 1)", "list<l: int32>",
        "decimal128(12, 1)",
    ]  # fmt: skip


def test_order_by_several_columns_and_ties_keep_the_order_in_which_rows_came() -> None:
    rows = "(1, NULL), (2, 5), (3, 7), (4, 5), (5, NULL)"
    clause = "ORDER BY value {} MEASURES id AS id PATTERN (A)"

    def sorted_by(terms: str) -> list[int]:
        return recognised(clause.format(terms), rows).column("id").to_pylist()

    assert sorted_by("") == [2, 4, 3, 1, 5]
    assert sorted_by("DESC") == [3, 2, 4, 1, 5]
    assert sorted_by("DESC NULLS FIRST, id DESC") == [5, 1, 3, 4, 2]


def test_null_is_a_partition_and_no_rows_give_no_rows() -> None:
    clause = "PARTITION BY p MEASURES count(*) AS n, MATCH_NUMBER() AS m PATTERN (A+)"
    assert tuples(recognised(clause, "(NULL, 1), (1, 2), (NULL, 3)", "p, q")) == [(1, 1, 1), (None, 2, 1)]
    empty = pa.table({"p": pa.array([], pa.int64())})
    assert recognised_in(clause, empty).num_rows == 0
    assert recognised_in(clause, empty).column_names == ["p", "n", "m"]


def test_within_counts_on_the_time_and_excludes_its_end() -> None:
    rows = ", ".join(f"(TIMESTAMP '2026-01-0{day}')" for day in (1, 2, 3, 6))
    clause = "ORDER BY ts MEASURES count(*) AS n PATTERN (A B*) WITHIN INTERVAL '2' DAY"
    assert recognised(clause, rows, "ts").column("n").to_pylist() == [2, 1, 1]


def test_parameters_are_values() -> None:
    clause = "ORDER BY id MEASURES :shown AS m PATTERN (A) DEFINE A AS value > $most"
    assert recognised(clause, FALL, params={"most": 85, "shown": "it's"}).column("m").to_pylist() == ["it's"]


@pytest.mark.parametrize(
    "measure,place,message",
    [
        ("LAST(1)", 39, "LAST needs a column or CLASSIFIER() in it"),
        ("LAST(A.value + B.value)", 54, "LAST must read columns of one variable"),
        ("LAST(PREV(value))", 44, "PREV must not stand inside LAST"),
        ("PREV(FIRST(value) + 1)", 44, "FIRST must not stand inside PREV, unless by itself"),
        ("PREV(NEXT(value))", 44, "NEXT must not stand inside PREV"),
        ("sum(LAST(value))", 43, "LAST must not stand inside the aggregate function SUM"),
        ("sum(avg(value))", 43, "AVG must not stand inside the aggregate function SUM"),
        ("max_by(A.value, value)", 55, "MAX_BY must read columns of one variable"),
        ("FINAL CLASSIFIER()", 39, "FINAL stands before FIRST, LAST or an aggregate function only"),
        ("LAST(value, id)", 39, "LAST goes by a whole number of 0 to 100000 rows"),
        ("LAST(value, -1)", 39, "LAST goes by a whole number of 0 to 100000 rows"),
        ("PREV()", 39, "PREV takes a value and, if wanted, a number of rows"),
        ("CLASSIFIER(X)", 50, "unknown pattern variable 'X'; there are: A, B, U"),
        ("CLASSIFIER(1)", 39, "CLASSIFIER takes one pattern variable or nothing"),
        ("MATCH_NUMBER(1)", 39, "MATCH_NUMBER takes nothing in its parentheses"),
        ("X.value", 39, "unknown pattern variable 'X'"),
        ("count(X.*)", 45, "unknown pattern variable 'X'"),
        ("sum(A.*)", 43, "A.* stands in COUNT only"),
        ("A.price", 39, "unknown column 'price'; there are: id, value"),
        ("nofunc(value)", 39, "Catalog Error: Scalar Function with name nofunc does not exist"),
        ("random()", 39, "RANDOM has another value at each call"),
        ("now()", 39, "NOW has another value at each call"),
        ("(SELECT 1)", 47, "a sub-query must not stand here"),
        ("sum(value) OVER ()", 39, "a window function must not stand here"),
        (":p", 39, "unknown parameter 'p'; there are: none"),
    ],
)  # fmt: skip
def test_what_a_measure_must_not_say(measure: str, place: int, message: str) -> None:
    with pytest.raises(RuleError) as caught:
        _measured(measure)
    assert caught.value.message.startswith(f"MEASURES: {message}")
    assert (caught.value.line, caught.value.column) == (1, place)


@pytest.mark.parametrize(
    "clause,message",
    [
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS FINAL LAST(A.value) > 1", "FINAL has no meaning in DEFINE"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS value", "DEFINE: wanted a condition, got INTEGER"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS value > (SELECT 1)", "a sub-query must not stand here"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS value IN (SELECT 1)", "a sub-query must not stand here"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS EXISTS (SELECT 1)", "a sub-query must not stand here"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS value > random()", "RANDOM has another value at each call"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS sum(max(value)) > 1", "MAX must not stand inside"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE C AS true", "DEFINE: 'C' is not in PATTERN"),
        ("MEASURES 1 AS m PATTERN (A) DEFINE A AS true, a AS true", "DEFINE: 'a' is defined twice"),
        ("MEASURES 1 AS m PATTERN (A) SUBSET U = (A, C)", "SUBSET: 'C' is not in PATTERN"),
        ("MEASURES 1 AS m PATTERN (A) SUBSET A = (A)", "SUBSET: 'A' is a pattern variable or SUBSET already"),
        ("MEASURES 1 AS m AFTER MATCH SKIP TO X PATTERN (A)", "AFTER MATCH SKIP: unknown pattern variable 'X'"),
        ("MEASURES 1 AS m ALL ROWS PER MATCH WITH UNMATCHED ROWS PATTERN (A {- B -})", "PATTERN must not have {- -}"),
        ("MEASURES 1 AS m SEEK PATTERN (A)", "SEEK finds one match anywhere"),
        ("PARTITION BY nope MEASURES 1 AS m PATTERN (A)", "PARTITION BY: unknown column 'nope'"),
        ("ORDER BY nope MEASURES 1 AS m PATTERN (A)", "ORDER BY: unknown column 'nope'"),
        ("ORDER BY id MEASURES 1 AS m PATTERN (A) WITHIN INTERVAL '1' DAY", "WITHIN needs ORDER BY with a time"),
        ("MEASURES 1 AS m PATTERN (A) WITHIN INTERVAL '1' DAY", "WITHIN needs ORDER BY with a time"),
        ("MEASURES 1 AS m PATTERN (A{30000,})", "a quantifier's bound is at most 10000"),
        ("MEASURES 1 AS m PATTERN ((A{200}){200})", "unfolds to 40000 positions; the limit `positions` is 10000"),
    ],
)  # fmt: skip
def test_what_a_clause_must_not_say(clause: str, message: str) -> None:
    with pytest.raises(RuleError) as caught:
        recognised(clause, FALL)
    assert message in caught.value.message
    assert caught.value.excerpt.endswith("^")


def test_an_expression_that_fails_on_a_row_says_so() -> None:
    with pytest.raises(MatchError, match="Could not convert string 'x90' to INT32"):
        recognised("MEASURES 1 AS m PATTERN (A) DEFINE A AS CAST('x' || value AS INTEGER) > 1", FALL)


def test_what_has_no_bound_of_its_own_has_a_limit() -> None:
    rows = ", ".join(f"({number}, {number})" for number in range(12))
    clause = "ORDER BY id MEASURES 1 AS m PATTERN (A+ B) DEFINE B AS {}"
    with pytest.raises(LimitError, match="the limit `listed` is 5"):
        recognised(clause.format("median(A.value) < 0"), rows, limits=Limits(listed=5))
    with pytest.raises(LimitError, match="the limit `questions` is 5"):
        recognised(clause.format("hash(A.value, value) IS NULL"), rows, limits=Limits(questions=5))
    with pytest.raises(LimitError, match="the limit `threads` is 5"):
        recognised(clause.format("false").replace("PATTERN", "AFTER MATCH SKIP TO NEXT ROW PATTERN"), rows,
                   limits=Limits(threads=5))  # fmt: skip


@pytest.mark.parametrize("pattern", ["(A | B)*? C", "((A*)*)* C", "((A+)+)+ C", "A+ B+ C", "(A | B | A B)* C"])
def test_patterns_that_try_everything_are_linear(pattern: str) -> None:
    table = pa.table({"id": range(2_000), "value": [0] * 2_000})
    clause = f"ORDER BY id MEASURES 1 AS m PATTERN ({pattern}) DEFINE C AS value = 1"
    assert recognised_in(clause, table, limits=Limits(threads=50)).num_rows == 0
