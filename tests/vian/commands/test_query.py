"""`vian query`: formats, files, and what is said of mistakes."""

import csv
import json
from pathlib import Path

import psycopg
import pyarrow as pa
import pyarrow.parquet
import pytest

from store import Log
from tests.vian.conftest import Run
from tests.vian.samples import YARD, append, points

ODD = """
select 'a' as x, 2 as x, interval 90 second as span, timestamptz 'infinity' as never, 'nan'::double as nan,
       [1, 2] as list, null as nothing, sum(frame) as total, max(time) as latest, '[/x]' as "m[/x]"
from track_point
"""


@pytest.fixture
def filled(log: Log) -> Log:
    append(log, points(10))
    return log


def test_an_answer_is_a_table(filled: Log, run: Run) -> None:
    ran = run("query", "select type, count(*) as n from events group by all", "--dsn", filled.dsn)
    assert "track_point" in ran.out
    assert "10" in ran.out
    assert ran.err == ""


def test_match_recognize_answers_too(filled: Log, run: Run) -> None:
    sql = "from track_point match_recognize (order by frame measures count(*) as n pattern (a+) define a as frame > 3)"
    assert run("query", sql, "--dsn", filled.dsn, "--format", "csv").out == '"n"\n6\n'


def test_json_is_one_object_a_row_whatever_the_values(filled: Log, run: Run) -> None:
    ran = run("query", ODD, "--dsn", filled.dsn, "--json")
    (row,) = [json.loads(line, parse_constant=pytest.fail) for line in ran.out.splitlines()]
    assert row == {
        "x": "a",
        "x_1": 2,
        "span": "00:01:30",
        "never": "infinity",
        "nan": "nan",
        "list": [1, 2],
        "nothing": None,
        "total": 45,
        "latest": "2026-01-01T10:00:09+00:00",
        "m[/x]": "[/x]",
    }


@pytest.mark.parametrize("format_", ["table", "csv", "json"])
def test_odd_values_are_printed_in_each_format(filled: Log, run: Run, format_: str) -> None:
    ran = run("query", ODD, "--dsn", filled.dsn, "--format", format_)
    assert ran.code == 0
    for text in ("00:01:30", "infinity", "45", "x_1", "[/x]"):
        assert text in ran.out


def test_csv_quotes_as_it_must(filled: Log, run: Run) -> None:
    ran = run("query", """select 'a,"b"' as x, [1, null] as y, null as z""", "--dsn", filled.dsn, "--format", "csv")
    assert list(csv.reader(ran.out.splitlines())) == [["x", "y", "z"], ['a,"b"', "[1, null]", ""]]


@pytest.mark.parametrize("format_", ["csv", "json", "parquet", "arrow"])
def test_an_answer_goes_into_a_file(filled: Log, run: Run, format_: str) -> None:
    file = Path(f"answer.{format_}")
    ran = run("query", ODD, "--dsn", filled.dsn, "--format", format_, "-o", file)
    assert (ran.code, ran.out) == (0, "")
    if format_ == "parquet":
        assert pa.parquet.read_table(file).column("total").to_pylist() == [45]
    elif format_ == "arrow":
        assert pa.ipc.open_file(file).read_all().column("span").to_pylist() == ["00:01:30"]
    else:
        assert "00:01:30" in file.read_text()


@pytest.mark.parametrize("format_", ["parquet", "arrow"])
def test_a_binary_format_needs_a_file(filled: Log, run: Run, format_: str) -> None:
    ran = run("query", "select 1", "--dsn", filled.dsn, "--format", format_)
    assert ran.code == 2
    assert f"--format {format_} is binary and needs a file. Next: add --output FILE" in ran.words


def test_a_file_that_cannot_be_written_is_told(filled: Log, run: Run) -> None:
    ran = run("query", "select 1", "--dsn", filled.dsn, "--format", "csv", "-o", "gone/x.csv")
    assert ran.code == 1
    assert "the answer cannot be written to gone/x.csv: " in ran.words


def test_a_query_is_pruned_by_time_and_source(filled: Log, run: Run) -> None:
    sql = "select count(*) as n from track_point"
    append(filled, points(1), YARD)
    ran = run(
        "query", sql, "--dsn", filled.dsn, "--json", "--since", "2026-01-01T10:00:02Z", "--until", "2026-01-01T10:00:05"
    )
    assert json.loads(ran.out) == {"n": 3}
    assert json.loads(run("query", sql, "--dsn", filled.dsn, "--json", "--source", "yard").out) == {"n": 1}


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["select 1; select 2"], "a query is one statement, got 2. Next: ask one after the other"),
        (["selct 1"], "the query is not right: Parser Error: syntax error"),
        (["select * from nowhere"], "Tables: events, streams, track_ground, activity_interval"),
        (["select 1", "--since", "yesterday"], "--since must be a time such as"),
        (["select * from track_point match_recognize (patern (a))"], "<query>:1:44: wanted one of the clauses"),
    ],
)
def test_a_mistake_is_wrong_usage(filled: Log, run: Run, arguments: list[str], said: str) -> None:
    ran = run("query", *arguments, "--dsn", filled.dsn)
    assert (ran.code, ran.out) == (2, "")
    assert ran.err.startswith("error: ")
    assert said in ran.words


def test_an_unknown_source_is_told_with_the_known_ones(filled: Log, run: Run) -> None:
    ran = run("query", "select * from events", "--dsn", filled.dsn, "--source", "nobody", "--json")
    assert (ran.code, ran.out) == (2, "")
    assert "no source 'nobody' in this log; known: gate" in ran.words


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM events",
        "truncate events",
        "insert into events values (1)",
        "update track_point set x = 1",
        "drop table events",
        "alter table events add column x int",
    ],
)
def test_a_query_that_would_write_is_told_that_the_log_is_append_only(filled: Log, run: Run, sql: str) -> None:
    ran = run("query", sql, "--dsn", filled.dsn)
    assert (ran.code, ran.out) == (2, "")
    assert "the log is append-only, and query only reads: wanted SELECT, got " in ran.words
    assert "Did you mean" not in ran.err


@pytest.mark.parametrize("sql", ["", " ", ";", "/* nothing */"])
def test_an_empty_query_is_told_with_an_example(filled: Log, run: Run, sql: str) -> None:
    ran = run("query", sql, "--dsn", filled.dsn)
    assert (ran.code, ran.out) == (2, "")
    assert ran.words == ('error: the query is empty. Next: vian query "SELECT type, count(*) FROM events GROUP BY ALL"')


def test_tables_of_ours_are_named_and_duckdbs_own_not_guessed(filled: Log, run: Run) -> None:
    ran = run("query", "select * from track_points", "--dsn", filled.dsn)
    assert "Tables: events, streams, track_ground, activity_interval" in ran.words
    assert "Did you mean" not in ran.err
    assert 'Did you mean "floor"' in run("query", "select floo(1.5)", "--dsn", filled.dsn).err


def test_a_single_wide_row_is_shown_a_value_a_line(filled: Log, run: Run) -> None:
    columns = ", ".join(f"{number} as column_{number}" for number in range(40))
    ran = run("query", f"select {columns}", "--dsn", filled.dsn)
    assert "\ncolumn_39: 39\n" in ran.out


def test_bytes_that_do_not_decode_lead_to_verify(log: Log, run: Run) -> None:
    append(log, points(3))
    with psycopg.connect(log.dsn, autocommit=True) as owner:
        owner.execute("alter table segments disable trigger user")
        owner.execute("update segments set payload = 'no payload'")
    ran = run("query", "select * from track_point", "--dsn", log.dsn)
    assert ran.code == 1
    assert "brno/gate/track_point from sequence 1: " in ran.words
    assert "Next: vian verify" in ran.words
