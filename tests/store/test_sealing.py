"""Sealing: what moves and when, what stays, and that nothing leaves before its copy was read back."""

import os
import signal
from datetime import UTC, datetime, timedelta
from multiprocessing.connection import Connection
from pathlib import Path

import psycopg
import pyarrow.parquet as pq
import pytest

from events import Catalogue
from store import ArchiveUnavailable, ChainBroken, Log, LogUnavailable, StoreError, sealing, verify
from store.parquet import project, waiting
from store.sealing import Sealer, archiver, outlook
from tests.conftest import MakeLog
from tests.contracts.writers import started
from tests.store.samples import GATE, YARD, append, draft, on_both, owner, query

LATER = datetime.now(UTC) + timedelta(days=1)
SMALL = 1
"""A size of file that one segment fills."""
STEPS = ("planned", "writing", "written", "read back", "removed", "projected")


@pytest.fixture
def filled(log: Log) -> Log:
    """Positions 1 to 6: two streams in turn, of 2 and 3 events a segment."""
    for _ in range(3):
        append(log, GATE, 2)
        append(log, YARD, 3)
    return log


def seal(log: Log, folder: Path, before: datetime = LATER, file_bytes: int = SMALL) -> list[tuple[int, int]]:
    """Seal, and say which positions each file took."""
    sealer = Sealer(log, str(folder), file_bytes=file_bytes)
    return [(each.first_position, each.last_position) for each in sealer.seal(before)]


def in_postgresql(log: Log) -> list[int]:
    return [position for (position,) in query(log, "select position from segments order by 1")]


def sealed_files(folder: Path) -> list[Path]:
    return sorted((folder / "_sealed").glob("*"))


@on_both
def test_what_is_sealed_leaves_postgresql_and_lies_in_the_files_to_the_byte(filled: Log, tmp_path: Path) -> None:
    before = list(filled.read_all())
    assert seal(filled, tmp_path, file_bytes=1_500) == [(1, 3), (4, 6)]
    assert in_postgresql(filled) == []
    tables = [pq.read_table(path) for path in sealed_files(tmp_path)]
    assert [payload for table in tables for payload in table.column("payload").to_pylist()] == [
        segment.payload for segment in before
    ]
    assert query(filled, "select first_position, last_position, segments, events, bytes from sealed_files") == [
        (1, 3, 3, 7, sealed_files(tmp_path)[0].stat().st_size),
        (4, 6, 3, 8, sealed_files(tmp_path)[1].stat().st_size),
    ]
    assert filled.head() == 6


@on_both
def test_only_what_was_taken_before_the_time_is_sealed(filled: Log, tmp_path: Path) -> None:
    between = list(filled.read_all())[4].recorded_at
    assert (outlook(filled, between).last_position, outlook(filled, between).events) == (4, 10)
    assert seal(filled, tmp_path, between) == [(1, 1), (2, 2), (3, 3), (4, 4)]
    assert in_postgresql(filled) == [5, 6]
    assert seal(filled, tmp_path, between) == []
    assert outlook(filled, between).segments == 0
    assert seal(filled, tmp_path, LATER, 10_000) == [(5, 6)]


def test_what_comes_after_goes_on_where_the_files_end(filled: Log, tmp_path: Path) -> None:
    seal(filled, tmp_path, file_bytes=10_000)
    append(filled, GATE, 4)
    assert [(head.sequence, str(head.stream)) for head in filled.streams()] == [(10, str(GATE)), (9, str(YARD))]
    assert [segment.position for segment in filled.read_all()] == list(range(1, 8))
    assert seal(filled, tmp_path) == [(7, 7)]
    assert verify(filled).is_sound


def test_a_file_has_many_row_groups_so_that_memory_is_bounded(
    filled: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = list(filled.read_all())
    monkeypatch.setattr(sealing, "GROUP_SEGMENTS_MAX", 2)
    assert seal(filled, tmp_path, file_bytes=10_000) == [(1, 6)]
    (path,) = sealed_files(tmp_path)
    assert [pq.ParquetFile(path).metadata.row_group(n).num_rows for n in range(3)] == [2, 2, 2]
    assert list(filled.read_all()) == before


# A kill between any two steps.


def seal_and_die(dsn: str, folder: str, step: str, ready: Connection) -> None:
    """Seal all in one file and project it, and die of SIGKILL behind the step."""

    def die(done: str) -> None:
        if done == step:
            os.kill(os.getpid(), signal.SIGKILL)

    with Log(dsn, Catalogue.shipped()) as log:
        ready.send(step)
        list(Sealer(log, folder, file_bytes=1_500, on_step=die).seal(LATER))
        for file in waiting(log):
            project(log, file)
        die("projected")


@pytest.mark.parametrize("step", STEPS)
def test_a_kill_behind_any_step_loses_nothing_and_the_next_run_goes_on(filled: Log, tmp_path: Path, step: str) -> None:
    before = list(filled.read_all())
    with started(seal_and_die, filled.dsn, str(tmp_path), step) as process:
        process.wait_until_ready()
        assert process.wait_until_dead() == -signal.SIGKILL
    assert list(filled.read_all()) == before
    assert verify(filled).is_sound
    is_half_done = step in ("planned", "writing", "written", "read back")
    sealer = Sealer(filled, str(tmp_path), file_bytes=1_500)
    assert (sealer.resume() is not None) == is_half_done
    list(sealer.seal(LATER))
    for file in waiting(filled):
        project(filled, file)
    assert list(filled.read_all()) == before
    assert in_postgresql(filled) == []
    indexed = {path for (path,) in query(filled, "select path from sealed_files")}
    assert {f"_sealed/{path.name}" for path in sealed_files(tmp_path)} == indexed
    decoded = list(tmp_path.glob("track_point/*/*/*"))
    assert sum(pq.read_metadata(path).num_rows for path in decoded) == 15


def test_a_half_written_file_keeps_a_second_sealing_from_beginning(filled: Log, tmp_path: Path) -> None:
    with archiver(filled) as connection:
        connection.execute("select plan_sealing(%s, '_sealed/x.parquet', 3)", (str(tmp_path),))
    with pytest.raises(StoreError, match=r"the sealing of _sealed/x\.parquet has not ended"):
        seal(filled, tmp_path)
    assert Sealer(filled, str(tmp_path)).resume() == "_sealed/x.parquet"
    assert seal(filled, tmp_path, file_bytes=10_000) == [(1, 6)]


# Nothing leaves before its copy was read back and verified.


@pytest.mark.parametrize("offset", [100, -100])
def test_a_copy_that_reads_back_otherwise_leaves_everything_where_it_is(
    filled: Log, tmp_path: Path, offset: int
) -> None:
    def spoil(step: str) -> None:
        if step == "written":
            (path,) = sealed_files(tmp_path)
            data = bytearray(path.read_bytes())
            data[offset] ^= 1
            path.write_bytes(data)

    sealer = Sealer(filled, str(tmp_path), on_step=spoil)
    with pytest.raises(ArchiveUnavailable, match=r"_sealed/\S+ was written with \d+ bytes .* Nothing left the log"):
        list(sealer.seal(LATER))
    assert in_postgresql(filled) == [1, 2, 3, 4, 5, 6]
    assert Sealer(filled, str(tmp_path)).resume() is not None
    assert seal(filled, tmp_path, file_bytes=10_000) == [(1, 6)]


def test_a_copy_that_vanished_leaves_everything_where_it_is(filled: Log, tmp_path: Path) -> None:
    def lose(step: str) -> None:
        if step == "written":
            sealed_files(tmp_path)[0].unlink()

    with pytest.raises(ArchiveUnavailable, match="does not verify when it is read back"):
        list(Sealer(filled, str(tmp_path), on_step=lose).seal(LATER))
    assert in_postgresql(filled) == [1, 2, 3, 4, 5, 6]


@pytest.mark.parametrize(
    "change, said",
    [
        ("payload = set_byte(payload, 9, get_byte(payload, 9) # 1)", "the payload's hash is"),
        ("schema_version = 2", "its header was changed"),
        ("first_sequence = 5", "nothing before it ends at sequence 4"),
    ],
)
def test_a_segment_that_does_not_verify_is_not_sealed(filled: Log, tmp_path: Path, change: str, said: str) -> None:
    with owner(filled) as connection:
        connection.execute("alter table segments disable trigger user")
        if "first_sequence" in change:
            connection.execute("update segments set first_sequence = 9 where position = 5")
        connection.execute(f"update segments set {change} where position = 3")
        connection.execute("alter table segments enable trigger user")
    with pytest.raises(ChainBroken, match=said) as caught:
        seal(filled, tmp_path)
    assert caught.value.position == 3
    assert in_postgresql(filled) == [3, 4, 5, 6]


@pytest.mark.parametrize("lost, left", [(1, [2, 3, 4, 5, 6]), (4, [1, 2, 3, 5, 6])])
def test_a_log_with_a_hole_is_not_sealed_over_it(filled: Log, tmp_path: Path, lost: int, left: list[int]) -> None:
    with owner(filled) as connection:
        connection.execute("alter table segments disable trigger user")
        connection.execute("delete from segments where position = %s", (lost,))
        connection.execute("alter table segments enable trigger user")
    with pytest.raises(ChainBroken, match=r"are missing\. Next: vian verify"):
        seal(filled, tmp_path, file_bytes=10_000)
    assert in_postgresql(filled) == left


@on_both
def test_the_database_removes_nothing_but_what_was_read_back(filled: Log, tmp_path: Path) -> None:
    ends = {(head.stream, head.epoch): (head.sequence, head.chain_hash) for head in filled.streams()}
    names = [*ends]
    right = [
        "_sealed/x.parquet",
        bytes(32),
        9,
        [name.station for name, _ in names],
        [epoch for _, epoch in names],
        [name.source for name, _ in names],
        [name.type for name, _ in names],
        [ends[name][0] for name in names],
        [ends[name][1] for name in names],
        [],
    ]
    call = (
        "select seal_segments(%s, %b::bytea, %s, %s::text[], %s::int[], %s::text[], %s::text[], %s::bigint[], "
        "%b::bytea[], %s::bigint[])"
    )

    def refused(last: int, said: str, **changed: object) -> None:
        with archiver(filled) as connection:
            connection.execute("select plan_sealing(%s, '_sealed/x.parquet', %s)", (str(tmp_path), last))
        given = list(right)
        for place, value in changed.items():
            given[int(place[1:])] = value
        with pytest.raises(StoreError, match=said), archiver(filled) as connection:
            connection.execute(call, given)
        with archiver(filled) as connection:
            connection.execute("select forget_sealing('_sealed/x.parquet')")

    refused(6, "no sealing of _sealed/y.parquet is planned", _0="_sealed/y.parquet")
    refused(6, "is not what the log holds", _8=[ends[names[0]][1], bytes(32)])
    refused(6, "is not what the log holds", _7=[6, 8])
    refused(6, "is not what the log holds", **{f"_{n}": right[n][:1] for n in range(3, 9)})  # type: ignore[index]
    refused(5, "is not what the log holds")
    for last, said in ((0, "positions 1 to 0 cannot be sealed"), (7, "positions 1 to 7 cannot be sealed")):
        with pytest.raises(StoreError, match=said), archiver(filled) as connection:
            connection.execute("select plan_sealing(%s, '_sealed/x.parquet', %s)", (str(tmp_path), last))
    assert in_postgresql(filled) == [1, 2, 3, 4, 5, 6]
    assert query(filled, "select count(*) from sealed_files") == [(0,)]


# Who may.


@on_both
def test_the_writer_cannot_seal_and_nobody_changes_the_index(filled: Log, tmp_path: Path) -> None:
    seal(filled, tmp_path, file_bytes=10_000)
    append(filled, GATE, 1)
    for statement in (
        "select plan_sealing('x', 'y', 7)",
        "select forget_sealing('y')",
        "select relocate_archive('y')",
        "select seal_segments('y', '', 1, null, null, null, null, null, null, null)",
        "delete from sealed_files",
        "update archive_head set sealed_position = 0",
        "insert into sealed_ranges select * from sealed_ranges",
    ):
        with filled.connection() as connection, pytest.raises(psycopg.errors.InsufficientPrivilege):
            connection.execute(statement)
    for statement in ("delete from segments", "update archive_head set is_removing = true", "delete from sealed_files"):
        with pytest.raises(LogUnavailable, match="permission denied"), archiver(filled) as archiving:
            archiving.execute(statement)
    for statement in (
        "delete from segments",
        "delete from segments where position <= 6",
        "truncate segments",
        "update segments set payload = ''",
        "update sealed_files set path = ''",
        "delete from sealed_ranges",
        "truncate sealed_files cascade",
    ):
        with owner(filled) as connection, pytest.raises(psycopg.Error, match="the log is append-only") as caught:
            connection.execute(statement)
        assert caught.value.sqlstate == "VA004"


def test_a_role_that_may_not_seal_is_told_what_to_grant(filled: Log, tmp_path: Path) -> None:
    with owner(filled) as connection:
        connection.execute("drop role if exists plain")
        connection.execute("create role plain login in role vian_writer")
    try:
        with (
            Log(filled.dsn.replace("postgres:", "plain:").replace("postgres@", "plain@"), filled.catalogue) as log,
            pytest.raises(LogUnavailable, match="grant vian_archiver to this role"),
        ):
            seal(log, tmp_path)
    finally:
        with owner(filled) as connection:
            connection.execute("drop role plain")


def test_the_archive_of_a_log_is_at_one_place(filled: Log, tmp_path: Path) -> None:
    seal(filled, tmp_path / "one", file_bytes=1_500)
    append(filled, GATE, 1)
    with pytest.raises(ArchiveUnavailable, match=r"are at \S+/one, got \S+/two\. Next: leave out --to"):
        seal(filled, tmp_path / "two")
    assert not (tmp_path / "two").exists()


def test_two_logs_do_not_share_a_place(make_log: MakeLog, tmp_path: Path) -> None:
    one, other = make_log(), make_log()
    for log in (one, other):
        append(log, GATE, 2)
    seal(one, tmp_path)
    with pytest.raises(ArchiveUnavailable, match=r"/_sealed holds files of another log.*Next: vian archive --to a new"):
        seal(other, tmp_path)
    assert len(sealed_files(tmp_path)) == 1
    assert in_postgresql(other) == [1]
    assert seal(other, tmp_path / "own") == [(1, 1)]
    append(one, GATE, 2)
    assert seal(one, tmp_path) == [(2, 2)]


# Re-sent.


@on_both
def test_a_resent_segment_that_is_sealed_is_acknowledged_or_refused_as_if_it_had_stayed(
    filled: Log, tmp_path: Path
) -> None:
    sent, other = draft(GATE, 3, 4), draft(GATE, 8, 9)
    first = filled.append([sent], [2])
    seal(filled, tmp_path)
    assert filled.append([sent], [2]) == first
    (again, fresh) = filled.append([sent, draft(YARD, 10, 10)], [2, 9])
    assert (again, fresh.position, fresh.was_there) == (first[0], 7, False)
    chain_hash = first[0].chain_hash
    assert filled.append([sent], [2], chain_hashes=[chain_hash]) == first
    with pytest.raises(ChainBroken, match="differs from the one that was sent"):
        filled.append([sent], [2], chain_hashes=[bytes(32)])
    for expected, bytes_sent in ((2, other), (3, sent), (1, sent), (0, draft(GATE, 1, 1))):
        with pytest.raises(StoreError, match=f"already holds other bytes after sequence {expected}") as caught:
            filled.append([draft(YARD, 11, 11), bytes_sent], [10, expected])
        assert caught.value.actual == 6  # type: ignore[attr-defined]
    assert filled.head() == 7


def test_a_refused_resending_cannot_be_committed_by_mistake(filled: Log, tmp_path: Path) -> None:
    seal(filled, tmp_path)
    with filled.transaction() as transaction:
        with pytest.raises(StoreError, match="already holds other bytes"):
            transaction.append([draft(YARD, 10, 10), draft(GATE, 8, 9)], [9, 2])
        with pytest.raises(psycopg.errors.InFailedSqlTransaction):
            transaction.save_checkpoint("me", 3)
    assert filled.head() == 6
