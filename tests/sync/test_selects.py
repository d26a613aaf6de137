import pytest

from sync.central.selects import LENGTH_MAX, permitted
from sync.errors import SelectRefused

ENVELOPE = ("id", "station", "source", "type", "subject", "time", "sequence", "position", "recorded_at", "epoch")
TABLES = {
    "events": ENVELOPE,
    "streams": ("station", "epoch", "source", "type", "sequence", "chain_hash"),
    "plate_read": (*ENVELOPE, "plate", "confidence", "country"),
    "track_point": (*ENVELOPE, "x", "y", "vx"),
    "situation_detected": (*ENVELOPE, "rule", "severity", "measures", "lineage"),
}
ALLOWED = """
select * from plate_read;
select p.* from plate_read as p where p.plate like '1A%' and not (p.country is null or confidence between 0.1 and 0.9);
select station, count(*) as count, max(time)
from events group by station having count(*) > 1 order by 2 desc nulls last;
select date_trunc('hour', time) as hour, count(distinct subject) filter (where x > 1) from track_point group by hour;
with newest as (select *, row_number() over (partition by source order by time desc) as n from plate_read)
select plate from newest where n = 1;
select measures ->> 'speed', lineage -> 0 ->> 'stream', jsonb_array_length(lineage)
from situation_detected where measures @> '{"a": 1}';
select a.plate, b.time from plate_read a join lateral
(select time from plate_read b where b.plate = a.plate and b.time < a.time order by time desc limit 1) as b on true;
select plate from plate_read where time >= now() - interval '7 days' and time < timestamptz '2026-01-01 00:00+00';
select source from plate_read union select source from track_point except select source from events order by 1;
select extract(epoch from time)::bigint, cast(x as numeric(10, 2)), round(y::numeric, 1) from track_point;
select case when x > 1 then 'right' else 'left' end as side, coalesce(subject, '') from track_point;
select percentile_cont(0.5) within group (order by x) from track_point;
select lag(time) over w from plate_read window w as (partition by plate order by time);
select (select max(time) from events e where e.station = p.station) from plate_read p;
select plate from plate_read where plate in (select subject from events) and exists (select 1 from streams);
select Station, "plate" from PLATE_READ
""".strip().split(";\n")
REFUSED = {
    "": "one SELECT, got nothing",
    "select 1; select 2": "got 2 statements",
    "delete from plate_read": "one SELECT, got delete",
    "copy plate_read to stdout": "one SELECT, got copy",
    "create temp table t as select 1": "one SELECT, got create",
    "reset role": "one SELECT, got reset",
    "set role postgres": "one SELECT, got set",
    "explain select 1": "one SELECT, got explain",
    "select 1; reset role": "got 2 statements",
    "values (1)": "one SELECT, got values",
    "with gone as (delete from plate_read returning *) select * from gone": "that is not for questions: DELETE",
    "with recursive n(i) as (select 1 union all select i + 1 from n) select i from n": "WITH RECURSIVE",
    "select * into other from plate_read": "that is not for questions: INTO other",
    "select * from plate_read for update": "that is not for questions: FOR UPDATE",
    "select * from plate_read tablesample system (1)": "that is not for questions: TABLESAMPLE",
    "select set_config('role', 'postgres', true)": "the function set_config is not for questions",
    "select pg_catalog.set_config('role', 'postgres', true)": "that is not for questions: pg_catalog.set_config",
    "select pg_sleep(60)": "the function pg_sleep is not for questions",
    "select query_to_xml('select 1', true, true, '')": "the function query_to_xml is not for questions",
    "select current_setting('data_directory')": "the function current_setting is not for questions",
    "select lo_import('/etc/passwd')": "the function lo_import is not for questions",
    "select dblink('x', 'y')": "the function dblink is not for questions",
    "select field_stations()": "the function field_stations is not for questions",
    "select * from generate_series(1, 1000000000)": "not for questions",
    "select repeat('x', 1000000000)": "the function repeat is not for questions",
    "select plate || plate from plate_read": "that is not for questions: plate || plate",
    "select string_agg(plate, '') from plate_read": "is not for questions",
    "select array_agg(plate) from plate_read": "the function array_agg is not for questions",
    "select (plate, plate) from plate_read": "a row is no value",
    "select p from plate_read p": "p is a table's name, and a row is no value",
    "select p.to_jsonb from plate_read p": "no table there has a column to_jsonb",
    "select p.text from plate_read p": "no table there has a column text",
    "select (p).plate from plate_read p": "that is not for questions",
    "select count(p.*) from plate_read p": r"\* stands for columns in the list of SELECT",
    "select xmin from plate_read": "no table there has a column xmin",
    "select plat from plate_read": "no table there has a column plat, or more than one has \\(line 1, column 8\\)",
    "select rolname from pg_roles": "there is no table pg_roles for questions",
    "select * from pg_catalog.pg_class": "there is no table pg_catalog.pg_class for questions",
    "select * from information_schema.tables": "there is no table information_schema.tables",
    "select * from public.plate_read": "there is no table public.plate_read for questions",
    "select * from plate_read_20260101": "there is no table plate_read_20260101",
    "select * from segments": "there is no table segments",
    "select * from field_callers": "there is no table field_callers",
    "select * from field_plate_read": "there is no table field_plate_read",
    'select * from "Plate_Read"': 'there is no table "Plate_Read"',
    "with events as (select 1 as a) select a from events": "events is a table; give what WITH names another name",
    "select 'pg_class'::regclass": "not for questions: REGCLASS",
    "select 'x'::char(1000000)": "a question casts to .* got CHAR",
    "select null::text[]": "a question casts to .* got TEXT",
    "select 1 operator(pg_catalog.+) 2": "not for questions",
    "select $1": "not for questions",
    "select $tag$text$tag$": "not for questions",
    "select '\0'": "a question is Unicode text without U",
    "select x from track_point where x >": "line 1, column 3",
    "select x,\n  plate fro plate_read": "line 2, column",
    f"select {'(' * 4_000}1{')' * 4_000}": "nests too deeply",
    f"select {'+'.join('1' * 4_000)}": "nests too deeply",
    f"select '{'a' * LENGTH_MAX}'": f"at most {LENGTH_MAX} characters",
}


@pytest.mark.parametrize("sql", ALLOWED)
def test_a_select_over_the_tables_of_events_may_be_asked(sql: str) -> None:
    text = permitted(sql, TABLES)
    assert '"field_' in text


@pytest.mark.parametrize("sql", REFUSED)
def test_what_is_not_listed_is_refused_with_its_place(sql: str) -> None:
    with pytest.raises(SelectRefused, match=REFUSED[sql]):
        permitted(sql, TABLES)


def test_what_runs_is_written_anew_over_the_views() -> None:
    assert permitted("select /* hint */ 'it''s \\' -- all\nfrom Plate_Read", TABLES) == (
        "SELECT 'it''s \\' FROM \"field_plate_read\" AS \"plate_read\""
    )


def test_a_name_that_with_gives_stands_for_no_table_of_the_database_anywhere() -> None:
    text = permitted("select * from (with pg_roles as (select 1 as a) select a from pg_roles) as r, pg_roles", TABLES)
    assert "asked_pg_roles" in text
    assert " pg_roles" not in text.replace('"asked_pg_roles" AS "pg_roles"', "")
