"""The decoded Parquet beside the sealed files, as DuckDB reads it, which knows nothing of ViAn."""

import json
import re
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path
from typing import Any

import duckdb
import pytest

from events import SHIPPED, Catalogue, StreamName, TrackPoint, batch_of, encode, schema_of
from store import Log, open_log, parquet
from store.parquet import project, waiting
from tests.conftest import MakeLog
from tests.events.plugged import VehicleWeighed
from tests.store.samples import GATE, NOON, ONE_OF_EACH, PRODUCER, append, draft, draft_of, owner, point, query
from tests.store.test_archive_reference import PAGE
from tests.store.test_rebuild import NEW, OLD, beep, louder
from tests.store.tiered import seal_all

MIDNIGHT = NOON + timedelta(hours=12)


@pytest.fixture
def duck() -> Iterator[duckdb.DuckDBPyConnection]:
    with duckdb.connect() as connection:
        connection.execute("set timezone = 'UTC'")
        yield connection


def archived(log: Log, folder: Path) -> list[parquet.Projected]:
    seal_all(log, folder)
    return [project(log, file) for file in waiting(log)]


def test_duckdb_reads_types_days_and_stations_without_vian(
    log: Log, tmp_path: Path, duck: duckdb.DuckDBPyConnection
) -> None:
    append(log, GATE, 3)
    across = [point(number, time=MIDNIGHT + timedelta(seconds=number - 3)) for number in (1, 2, 3, 4)]
    log.append([encode(GATE, batch_of(across), PRODUCER)])
    log.append([draft(StreamName.of("plzen", "roof", "track_point"), 1, 2)])
    archived(log, tmp_path)
    table = f"read_parquet('{tmp_path}/track_point/*/*/*.parquet', hive_partitioning = true)"
    assert duck.sql(f"select station, date::text, count(*) from {table} group by all order by all").fetchall() == [
        ("brno", "2026-01-01", 5),
        ("brno", "2026-01-02", 2),
        ("plzen", "2026-01-01", 2),
    ]
    columns = "source, subject, sequence, position, epoch, frame, confidence, time"
    second_day = duck.sql(f"select {columns} from {table} where date = '2026-01-02' order by all").to_arrow_table()
    assert [tuple(row.values()) for row in second_day.to_pylist()] == [
        ("gate", "1", 6, 2, 1, 3, 0.5, MIDNIGHT),
        ("gate", "1", 7, 2, 1, 4, 0.5, MIDNIGHT + timedelta(seconds=1)),
    ]
    recorded = duck.sql(f"select distinct recorded_at from {table} where station = 'plzen'").to_arrow_table()
    assert recorded.column(0).to_pylist() == [list(log.read_all())[-1].recorded_at]


def test_every_type_comes_out_as_it_went_in(log: Log, tmp_path: Path, duck: duckdb.DuckDBPyConnection) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    archived(log, tmp_path)
    for event in ONE_OF_EACH:
        names = ", ".join(schema_of(type(event)).names)
        table = duck.sql(f"select {names} from '{tmp_path}/{event.type_name}/*/*/*.parquet'").to_arrow_table()
        (row,) = table.to_pylist()
        assert type(event).model_validate(row) == event


def test_schema_units_and_descriptions_stand_in_the_files_metadata(
    log: Log, tmp_path: Path, duck: duckdb.DuckDBPyConnection
) -> None:
    append(log, GATE, 1)
    (made,) = archived(log, tmp_path)
    rows = duck.sql(
        f"select decode(key), decode(value) from parquet_kv_metadata('{tmp_path}/{made.paths[0]}')"
    ).fetchall()
    about = dict(rows)
    assert (about["vian.type"], about["vian.version"]) == ("track_point", str(TrackPoint.version))
    assert about["vian.description"] == TrackPoint.__doc__
    assert "origin top-left" in about["vian.conventions"]
    assert about["vian.sealed_file"] == made.path
    fields = {each["name"]: each for each in json.loads(about["vian.fields"])}
    for each in schema_of(TrackPoint):
        assert fields[each.name]["description"] == each.metadata[b"description"].decode()
    assert "px" in fields["x1"]["description"]
    table = f"read_parquet('{tmp_path}/{made.paths[0]}', hive_partitioning = false)"
    assert duck.sql(f"select * from {table}").columns == [*fields]


WEIGHED: dict[str, Any] = {
    "plate": "1AB 2345", "face": b"\0", "is_heavy": True, "is_sure": None, "raw": None, "mass": 1.5, "left_at": None,
    "class_of": "car", "notes": None, "axles": (), "spares": None,
}  # fmt: skip


def test_a_type_that_is_unknown_here_leaves_the_sealed_file_complete_and_is_told(
    make_log: MakeLog, tmp_path: Path
) -> None:
    log = make_log()
    append(log, GATE, 2)
    log.append([draft_of(VehicleWeighed(time=NOON, **WEIGHED))])
    before = list(log.read_all())
    (made,) = archived(log, tmp_path)
    assert (made.events, made.segments_skipped) == (2, 1)
    assert "position 2: no event type 'vehicle_weighed'" in str(made.note)
    assert list(log.read_all()) == before
    assert query(log, "select count(*) from segments") == [(0,)]
    # One that knows the type makes the rest.
    with Log(log.dsn, Catalogue([*SHIPPED, VehicleWeighed])) as knowing:
        (file,) = knowing.archive.files()
        assert waiting(knowing) == []
        again = project(knowing, file)
    assert (again.events, again.segments_skipped, again.note, len(again.paths)) == (3, 0, None, 2)
    assert query(log, "select events, segments_skipped from archive_projections") == [(3, 0)]


def test_files_of_two_versions_are_read_together_as_the_page_says(
    make_log: MakeLog, tmp_path: Path, duck: duckdb.DuckDBPyConnection
) -> None:
    log = make_log(OLD)
    beep(log, "low")
    archived(log, tmp_path)
    with open_log(dsn=log.dsn, catalogue=NEW) as newer:
        louder(newer, "high")
        archived(newer, tmp_path)
        assert sorted(path.name.split(".")[1] for path in tmp_path.glob("beep/**/*.parquet")) == ["v1", "v2"]
        (call,) = re.findall(r"from (read_parquet\('archive/track_point.*\))", PAGE)
        table = call.replace("archive/track_point", f"{tmp_path}/beep")
        assert duck.sql(f"select tone, loudness_db is null from {table} order by all").fetchall() == [
            ("high", False),
            ("low", True),
        ]


def test_many_files_are_written_few_at_a_time(log: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "FILES_OPEN_MAX", 2)
    monkeypatch.setattr(parquet, "ROWS_KEPT_MAX", 3)
    for _ in range(2):
        for station in ("a", "b", "c", "d", "e"):
            append(log, StreamName.of(station, "gate", "track_point"), 2)
    seal_all(log, tmp_path, file_bytes=100_000)
    (made,) = [project(log, file) for file in waiting(log)]
    assert (made.events, len(made.paths)) == (20, 5)
    assert len(list(tmp_path.glob("track_point/**/*.parquet"))) == 5
    assert list(tmp_path.glob("**/*.part")) == []
    with duckdb.connect() as duck:
        counts = duck.sql(f"select station, count(*) from '{tmp_path}/track_point/*/*/*.parquet' group by 1").fetchall()
    assert sorted(counts) == [(station, 4) for station in "abcde"]


def test_writing_it_anew_replaces_what_was_there(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 2)
    (made,) = archived(log, tmp_path)
    (file,) = log.archive.files()
    stale = tmp_path / "track_point" / "stale.parquet"
    stale.write_bytes(b"old")
    with owner(log) as connection:
        connection.execute("update archive_projections set paths = paths || array['track_point/stale.parquet']")
    (tmp_path / made.paths[0]).unlink()
    assert project(log, file) == made
    assert not stale.exists()
    assert (tmp_path / made.paths[0]).exists()
