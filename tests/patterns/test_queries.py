"""What `patterns.query` does around its clauses that no case of text can say; the rest is in `cases/*.sql`."""

import pyarrow as pa
import pytest

import patterns
from patterns import LimitError, Limits, MatchError, QueryError, query
from patterns.language.lexemes import lexemes
from patterns.language.text import Passage
from patterns.querying.queries import take_apart

LETTERS = pa.table({"id": [1, 2, 3], "x": ["a", "a", "b"]})
PAIR = "MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(id) AS last PATTERN (A B))"


def test_a_table_may_have_a_schema_or_a_name_in_any_case() -> None:
    tables = {"raw.Letters": LETTERS, "Other": LETTERS}
    for name in ("raw.letters", 'RAW."Letters"', "other", "OTHER"):
        assert query(f"SELECT last FROM {name} {PAIR}", tables).to_pylist() == [{"last": 2}]


def test_the_name_of_a_result_is_none_that_the_user_has() -> None:
    tables = {"__match_1": LETTERS}
    assert query(f"SELECT a.last FROM __match_1 {PAIR} AS a, __match_1 AS b", tables).num_rows == 3


def test_an_answer_may_have_two_columns_of_one_name() -> None:
    assert query(f"SELECT last, last FROM t {PAIR}", {"t": LETTERS}).column_names == ["last", "last"]


def test_columns_of_an_input_that_share_a_name_are_told_apart() -> None:
    clause = "MATCH_RECOGNIZE (MEASURES id_1 AS b, X_1 AS c PATTERN (A))"
    answer = query(f"SELECT * FROM (t JOIN t AS u ON t.id = u.id) {clause}", {"t": LETTERS})
    assert answer.to_pylist()[2] == {"b": 3, "c": "b"}


def test_columns_of_a_table_that_share_a_name_are_told_apart() -> None:
    twins = pa.Table.from_arrays([pa.array([1]), pa.array(["a"])], names=["id", "id"])
    sql = "SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES A.id_1 AS x PATTERN (A))"
    assert query(sql, {"t": twins}).to_pylist() == [{"x": "a"}]


def test_a_table_that_duckdb_cannot_read_is_named() -> None:
    halves = pa.table({"id": pa.array([1.0]).cast(pa.float16())})
    with pytest.raises(MatchError, match="the table 't' is none that DuckDB reads"):
        query(f"SELECT * FROM t {PAIR}", {"t": halves})


LEVELS = "(SELECT id, CAST(x AS ENUM('low', 'mid', 'high')) AS level FROM t)"
RISING = pa.table({"id": [1, 2, 3], "x": ["low", "mid", "high"]})


@pytest.mark.parametrize(
    "condition",
    ["B.level > A.level", "B.level > PREV(level)", "MAX(level) = B.level", "greatest(A.level, B.level) = B.level"],
)
def test_an_enum_is_ordered_as_its_type_says(condition: str) -> None:
    measures = "MEASURES LAST(id) AS last, MAX(level) AS top"
    clause = f"MATCH_RECOGNIZE (ORDER BY id {measures} PATTERN (A B+) DEFINE B AS {condition})"
    answer = query(f"SELECT * FROM {LEVELS} {clause}", {"t": RISING})
    assert answer.to_pylist() == [{"last": 3, "top": "high"}]


def test_an_enum_is_one_in_the_next_clause_and_around_it() -> None:
    clause = "MATCH_RECOGNIZE (ORDER BY id MEASURES LAST(id) AS id, LAST(level) AS level PATTERN (A))"
    again = "MATCH_RECOGNIZE (ORDER BY level DESC ALL ROWS PER MATCH PATTERN (A B+) DEFINE B AS B.level < A.level)"
    answer = query(f"SELECT id, typeof(level) AS kind FROM {LEVELS} {clause} {again} ORDER BY level", {"t": RISING})
    assert answer.to_pylist() == [{"id": at, "kind": "ENUM('low', 'mid', 'high')"} for at in (1, 2, 3)]


BIG = pa.table({"id": [1, 2], "i": pa.array([2**24, 2**24 + 1], pa.int32()), "f": pa.array([2.0**24, 1], pa.float32()),
                "big": [2**53, 2**53 + 1], "d": [2.0**53, 1], "least": [-(2**63), -1]})  # fmt: skip


@pytest.mark.parametrize(
    ("condition", "holds"),
    [
        ("B.i = A.f", True), ("B.i > A.f", False), ("B.big = A.d", True), ("B.big <> A.d", False),
        ("SUM(big) = 2 * A.d", True), ("B.big + 0::HUGEINT = A.d", True), ("B.big = A.f * A.f * 32", True),
        ("coalesce(B.big, A.least * B.i) = B.big", True), ("B.i * 2 > A.f * 2", False), ("B.d < 1.5 AND A.d > 3", True),
    ],
)  # fmt: skip
def test_a_whole_number_is_rounded_before_it_is_compared_with_a_binary_fraction(condition: str, holds: bool) -> None:
    clause = f"MATCH_RECOGNIZE (ORDER BY id MEASURES B.id AS b PATTERN (A B) DEFINE B AS {condition})"
    row = condition.replace("SUM(big)", "(A.big::HUGEINT + B.big)")
    (told,) = query(f"SELECT {row} AS told FROM t AS A, t AS B WHERE A.id = 1 AND B.id = 2", {"t": BIG}).to_pylist()
    assert (query(f"SELECT * FROM t {clause}", {"t": BIG}).num_rows == 1, told["told"]) == (holds, holds)


@pytest.mark.parametrize(
    "condition", ["B.i * A.i > 0", "B.big * A.big > 0", "B.i * 128 + A.i > 0", "A.least // B.least > 0",
                  "A.least % B.least = 0", "abs(A.least) > B.i"],
)  # fmt: skip
def test_a_whole_number_beyond_its_type_is_an_error_as_duckdb_has_it(condition: str) -> None:
    clause = f"MATCH_RECOGNIZE (ORDER BY id MEASURES B.id AS b PATTERN (A B) DEFINE B AS {condition})"
    with pytest.raises(MatchError, match="Overflow"):
        query(f"SELECT * FROM t {clause}", {"t": BIG})


def test_limits_are_the_callers() -> None:
    with pytest.raises(patterns.RuleError, match="positions"):
        query(f"SELECT * FROM t {PAIR}", {"t": LETTERS}, Limits(positions=1))


def test_a_search_without_end_is_a_limit_error() -> None:
    rows = pa.table({"id": list(range(40))})
    sql = """SELECT * FROM t MATCH_RECOGNIZE (ORDER BY id MEASURES COUNT(*) AS n PATTERN ((A | B)* C)
             DEFINE A AS array_agg(A.id) IS NOT NULL, C AS FALSE)"""
    with pytest.raises(LimitError):
        query(sql, {"t": rows}, Limits(threads=100))


def test_python_variables_and_the_network_are_no_tables() -> None:
    hidden = LETTERS
    with pytest.raises(QueryError, match="hidden does not exist"):
        query(f"SELECT * FROM hidden {PAIR}", {})
    with pytest.raises(QueryError, match="httpfs"):
        query(f"SELECT * FROM 'http://127.0.0.1:1/x.parquet' {PAIR}", {})
    assert hidden is LETTERS


def test_a_query_is_taken_apart_from_the_inside_out() -> None:
    plan = take_apart(f"WITH a AS (SELECT 1) SELECT * FROM (SELECT * FROM t {PAIR}) {PAIR} AS m JOIN a ON TRUE")
    assert [(step.name, step.source.sql) for step in plan.steps] == [
        ("__match_1", "WITH a AS (SELECT 1) SELECT * FROM t"),
        ("__match_2", 'WITH a AS (SELECT 1) SELECT * FROM (SELECT * FROM "__match_1")'),
    ]
    assert plan.rest.sql == 'WITH a AS (SELECT 1) SELECT * FROM "__match_2" AS m JOIN a ON TRUE'


def test_words_are_split_as_duckdb_splits_them() -> None:
    wanted = ["a1", ".", '"b ""c"', "'it''s'", r"E'it\'s'", "$$ 'x $$", "$q$ $$ $q$", "<", "=", "é"]
    text = " /* /* */ x */ ".join([*wanted[:-1], "-- y\n" + wanted[-1]])
    assert [word.text for word in lexemes(Passage.alone(text))] == wanted
