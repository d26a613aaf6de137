"""Backup and restore: what comes back is what was there, byte for byte, in a new epoch."""

import hashlib
import json
import random
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psycopg
import pytest

from events import Catalogue, CheckpointSigned, Segment
from store import (
    BackupDamaged,
    BackupUnusable,
    ChainBroken,
    Log,
    LogUnavailable,
    Projector,
    Subscription,
    back_up,
    backup,
    backup_files,
    epochs,
    maintenance,
    note_restored,
    restore,
    verify,
    verify_restored,
)
from store.projector import BEHIND, NAME
from tests.conftest import MakeLog, Server, Servers
from tests.store.samples import GATE, ONE_OF_EACH, YARD, append, draft, draft_of, on_both, owner, query

Target = Callable[[], str]


@pytest.fixture
def target(server: Server) -> Iterator[Target]:
    """Makes an empty, migrated database that nobody is connected to; its address."""
    names: list[str] = []

    def make() -> str:
        names.append(server.create_database())
        return server.dsn(names[-1])

    yield make
    for name in names:
        server.drop_database(name)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return tmp_path / "backup"


def reopened(dsn: str) -> Log:
    return Log(dsn, Catalogue.shipped())


def fill(log: Log) -> None:
    """Events of every type, of two stations and an older epoch, with checkpoints, rows and a rule's output."""
    append(log, GATE, 3, 1, 2)
    # A checkpoint is sound only if a key signed it: tests/store/test_signing.py has real ones.
    events = [event for event in ONE_OF_EACH if not isinstance(event, CheckpointSigned)]
    log.append([draft_of(event, station=station) for station in ("brno", "plzen") for event in events])
    log.append([draft(YARD, 1, 2)], epochs=[0])
    projector = Projector(log)
    projector.catch_up()
    projector.close()
    with log.transaction() as transaction:
        transaction.checkpoint("rule/dwell/1")
        transaction.save_checkpoint("rule/dwell/1", log.head(), b"\0open state")


def everything(log: Log) -> tuple[Any, ...]:
    checkpoints = {name: each for name, each in log.checkpoints().items() if name != "projector"}
    return list(log.read_all()), log.heads(), checkpoints


@on_both
def test_what_is_restored_is_what_was_there_in_a_new_epoch(log: Log, folder: Path, target: Target) -> None:
    fill(log)
    dsn = target()
    made = back_up(log, folder)
    restored = restore(dsn, folder)
    with reopened(dsn) as other:
        assert everything(other) == everything(log)
        assert (other.epoch, restored.epoch) == (log.epoch + 1, log.epoch + 1)
        assert (restored.position, restored.events) == (log.head(), verify(log).events)
        assert made.segments_new == log.head()
        assert verify_restored(other, folder).is_sound
        done = maintenance.newest(other)
        assert {name: (each.place, each.position) for name, each in done.items()} == {
            name: (folder, log.head()) for name in ("restore_began", "restored", "verified")
        }
        assert abs((done["verified"].at - datetime.now(UTC)).total_seconds()) < 60


def test_a_log_moves_from_one_major_version_of_postgresql_to_another(
    servers: Servers, folder: Path, target: Target
) -> None:
    old = servers.get("15")
    name = old.create_database()
    dsn = target()
    with reopened(old.dsn(name)) as log:
        fill(log)
        back_up(log, folder)
        restore(dsn, folder)
        with reopened(dsn) as other:
            assert everything(other) == everything(log)
            assert query(other, "show server_version_num")[0][0] > query(log, "show server_version_num")[0][0]
            assert verify(other).is_sound
    old.drop_database(name)


@on_both
def test_both_histories_stay_when_the_restored_log_goes_on(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 3)
    back_up(log, folder)
    append(log, GATE, 2)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        append(other, GATE, 4)
        assert [(head.epoch, head.sequence) for head in other.streams()] == [(1, 3), (2, 4)]
        assert [segment.position for segment in other.read_all()] == [1, 2]
        assert verify(other).is_sound
        assert query(other, "select position from log_head") == [(2,)]


def test_rows_are_made_again_and_subscribers_go_on_where_they_stood(log: Log, folder: Path, target: Target) -> None:
    fill(log)
    append(log, YARD, 1)
    back_up(log, folder)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        assert query(other, "select count(*) from events") == [(0,)]
        projector = Projector(other)
        projector.catch_up()
        projector.close()
        again = Projector(log)
        again.catch_up()
        again.close()
        rows = "select id, position, recorded_at from events order by 1, 2"
        assert query(other, rows) == query(log, rows)
        with Subscription(other, "rule/dwell/1") as subscription:
            assert subscription.state == b"\0open state"
            assert [segment.position for segment in subscription.poll().segments] == [log.head()]


def test_a_type_whose_rows_were_being_made_anew_at_the_backup_has_all_of_them_after_the_restore(
    log: Log, folder: Path, target: Target
) -> None:
    append(log, GATE, 1, 2)
    with log.transaction() as transaction:
        transaction.save_checkpoint(f"{BEHIND}track_point", 1)
        transaction.save_checkpoint(NAME, 2)
    back_up(log, folder)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        projector = Projector(other)
        projector.catch_up()
        projector.close()
        assert query(other, "select frame from track_point order by 1") == [(1,), (2,), (3,)]


def test_times_of_recording_go_on_behind_those_of_the_backup(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 1)
    with owner(log) as connection:
        connection.execute("update log_head set recorded_at = recorded_at + interval '1 day'")
    append(log, GATE, 1)
    back_up(log, folder)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        append(other, GATE, 1)
        *_, before, after = other.read_all()
        assert after.recorded_at == before.recorded_at


def test_a_second_backup_adds_what_is_new(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 3, 3)
    first = back_up(log, folder)
    kept = {path.name: path.stat().st_mtime_ns for path in folder.glob("segments*")}
    append(log, YARD, 2)
    second = back_up(log, folder)
    third = back_up(log, folder)
    assert (first.segments_new, second.segments_new, third.segments_new) == (2, 1, 0)
    assert {path.name: path.stat().st_mtime_ns for path in folder.glob("segments*")}.items() >= kept.items()
    assert {path.name for path in folder.iterdir()} == {
        "manifest.json",
        "checkpoints-000000000003.arrow",
        "segments-000000000001-000000000002.arrow",
        "segments-000000000003-000000000003.arrow",
    }
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        assert everything(other) == everything(log)


def test_a_restored_log_is_backed_up_into_the_same_folder_as_long_as_it_is_one_history(
    log: Log, folder: Path, target: Target
) -> None:
    append(log, GATE, 3)
    back_up(log, folder)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        append(other, GATE, 1)
        assert back_up(other, folder).segments_new == 1
    append(log, YARD, 1)
    with pytest.raises(
        BackupUnusable, match=r"another history: up to position 2, this log holds another segment there"
    ):
        back_up(log, folder)


@pytest.mark.parametrize("at", range(1, 8))
def test_a_backup_that_is_killed_goes_on_and_the_one_before_stays_good(
    log: Log, folder: Path, target: Target, monkeypatch: pytest.MonkeyPatch, at: int
) -> None:
    monkeypatch.setattr(backup_files, "FILE_SEGMENTS", 2)
    append(log, GATE, 1, 1)
    back_up(log, folder)
    append(log, GATE, 1, 1, 1, 1, 1)
    left = [at]

    def kill_at(_: Any, *rest: Any) -> Any:
        left[0] -= 1
        if not left[0]:
            raise KeyboardInterrupt
        return rename(_, *rest)

    rename = Path.replace
    with monkeypatch.context() as patched:
        patched.setattr(Path, "replace", kill_at)
        with pytest.raises(KeyboardInterrupt):
            back_up(log, folder)
    earlier = target()
    assert restore(earlier, folder).position == 2
    done = back_up(log, folder)
    assert done.manifest.position == 7
    assert sorted(folder.glob("*.part")) == []
    later = target()
    restore(later, folder)
    with reopened(later) as other:
        assert everything(other) == everything(log)


def test_a_first_backup_that_is_killed_is_no_backup_yet_and_says_so(
    log: Log, folder: Path, target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backup_files, "FILE_SEGMENTS", 1)
    append(log, GATE, 1, 1, 1)

    def stop(segment: Segment) -> None:
        if segment.position == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        back_up(log, folder, stop)
    with pytest.raises(BackupUnusable, match=r"never finished.*Next: vian backup to it again"):
        restore(target(), folder)
    assert back_up(log, folder).manifest.position == 3


@on_both
def test_a_restore_that_is_killed_leaves_an_empty_log_says_so_and_can_be_repeated(
    log: Log, folder: Path, target: Target
) -> None:
    fill(log)
    back_up(log, folder)
    dsn = target()

    def stop(segment: Segment) -> None:
        if segment.position == 5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        restore(dsn, folder, stop)
    with reopened(dsn) as other:
        assert (other.heads(), other.checkpoints(), other.epoch) == ((0, []), {}, 1)
        assert set(maintenance.newest(other)) == {"restore_began"}
    restore(dsn, folder)
    with reopened(dsn) as other:
        assert everything(other) == everything(log)


def test_a_log_that_holds_anything_is_not_restored_over(log: Log, folder: Path, make_log: MakeLog) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    other = make_log()
    append(other, YARD, 2)
    other.close()
    with pytest.raises(BackupUnusable, match=r"into an empty log only, this one holds 1 segments of 1 streams"):
        restore(other.dsn, folder)
    with reopened(other.dsn) as unchanged:
        assert [(head.stream, head.sequence) for head in unchanged.streams()] == [(YARD, 2)]
        assert maintenance.newest(unchanged) == {}


def test_a_log_that_somebody_uses_is_not_restored_into(
    log: Log, folder: Path, target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(epochs, "_GONE_SECONDS", 0.0)
    append(log, GATE, 1)
    back_up(log, folder)
    dsn = target()
    with reopened(dsn) as other:
        with pytest.raises(BackupUnusable, match=r"in use: 1 other connections. Next: stop vian serve"):
            restore(dsn, folder)
        assert other.head() == 0


@on_both
def test_an_owner_who_is_no_superuser_sees_that_somebody_uses_the_log(
    log: Log, folder: Path, target: Target, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(epochs, "_GONE_SECONDS", 0.0)
    append(log, GATE, 1)
    back_up(log, folder)
    dsn = target()
    server.execute("create role plain login")
    try:
        with reopened(dsn), pytest.raises(BackupUnusable, match="in use: 1 other connections"):
            restore(psycopg.conninfo.make_conninfo(dsn, user="plain"), folder)
    finally:
        server.execute("drop role plain")


def test_who_opens_the_log_during_a_restore_learns_the_new_epoch(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    dsn = target()
    waiting: list[bool] = []

    def look(_: Segment) -> None:
        with psycopg.connect(dsn) as connection:
            connection.execute("set lock_timeout = '50ms'")
            with pytest.raises(psycopg.errors.LockNotAvailable):
                connection.execute("select epoch from log_head")
        waiting.append(True)

    restore(dsn, folder, look)
    assert waiting


def test_each_restore_of_a_backup_begins_an_epoch_of_its_own(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    epochs = []
    for _ in range(3):
        restored = restore(target(), folder)
        note_restored(folder, restored, is_verified=True)
        epochs.append(restored.epoch)
    assert epochs == [2, 3, 4]
    assert [each.epoch for each in backup_files.restores(folder)] == [2, 3, 4]
    with (folder / "restores.jsonl").open("a") as file:
        file.write('{"at": "2026-')
    assert len(backup_files.restores(folder)) == 3


def test_any_changed_byte_of_a_backup_is_found_and_nothing_is_restored(
    log: Log, folder: Path, target: Target, tmp_path: Path
) -> None:
    fill(log)
    back_up(log, folder)
    dsn, choose = target(), random.Random(1)
    for number in range(40):
        damaged = tmp_path / f"copy-{number}"
        shutil.copytree(folder, damaged)
        path = choose.choice(sorted(path for path in damaged.iterdir() if path.suffix == ".arrow"))
        content = bytearray(path.read_bytes())
        content[choose.randrange(len(content))] ^= 1 << choose.randrange(8)
        path.write_bytes(content)
        with pytest.raises(BackupDamaged, match=path.name):
            restore(dsn, damaged)
        shutil.rmtree(damaged)
    with reopened(dsn) as other:
        assert other.heads() == (0, [])


@pytest.mark.parametrize(
    "change, reason",
    [
        ({"payload": b"other"}, "the payload's hash is"),
        ({"payload": b"other", "payload_hash": hashlib.sha256(b"other").digest()}, "the chain hash is"),
        ({"position": 3}, "position 2 is missing"),
    ],
)
def test_a_file_forged_together_with_its_hash_is_found_by_the_chain(
    log: Log, folder: Path, target: Target, change: dict[str, Any], reason: str
) -> None:
    append(log, GATE, 1, 1)
    manifest = back_up(log, folder).manifest
    first, second = log.read_all()
    (folder / manifest.segments[0].name).unlink()
    written = backup_files.write_segments(folder, iter([first, replace(second, **change)]))
    assert written is not None
    backup_files.write_manifest(folder, manifest.model_copy(update={"segments": (written[0],)}))
    with pytest.raises(BackupDamaged, match=reason):
        restore(target(), folder)


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 2}'])
def test_a_manifest_that_is_none_is_named(folder: Path, target: Target, content: str) -> None:
    folder.mkdir()
    (folder / "manifest.json").write_text(content)
    with pytest.raises(BackupDamaged, match=r"manifest.json is no manifest of a backup: .*Next: "):
        restore(target(), folder)


def test_a_folder_without_a_backup_is_named(tmp_path: Path, target: Target) -> None:
    with pytest.raises(BackupUnusable, match=r"holds no backup.*Next: give the folder that vian backup wrote"):
        restore(target(), tmp_path)


def test_a_missing_file_is_named_by_backup_and_restore(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    (folder / "segments-000000000001-000000000001.arrow").unlink()
    with pytest.raises(BackupDamaged, match="lacks segments-000000000001"):
        restore(target(), folder)
    with pytest.raises(BackupUnusable, match=r"lacks segments-000000000001.*Next: back up to a new folder"):
        back_up(log, folder)


def test_a_folder_of_somebody_elses_is_left_alone(log: Log, folder: Path) -> None:
    folder.mkdir()
    (folder / "holiday.jpg").touch()
    with pytest.raises(BackupUnusable, match=r"no backup and not empty: it holds 'holiday.jpg'. Next: give a new"):
        back_up(log, folder)
    assert [path.name for path in folder.iterdir()] == ["holiday.jpg"]


def test_a_folder_that_cannot_be_made_is_named(log: Log, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(BackupUnusable, match=r"cannot be used for a backup: .*Next: give a folder"):
        back_up(log, tmp_path / "file")


def test_an_empty_log_can_be_backed_up_and_restored(log: Log, folder: Path, target: Target) -> None:
    assert back_up(log, folder).manifest.position == 0
    dsn = target()
    assert restore(dsn, folder).epoch == 2
    append(log, GATE, 1)
    assert back_up(log, folder).segments_new == 1


def test_damage_in_the_log_does_not_creep_into_a_backup(log: Log, folder: Path, target: Target) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    append(log, GATE, 1)
    with owner(log) as connection:
        connection.execute("alter table segments disable trigger user")
        connection.execute("update segments set payload = payload || '\\x00' where position = 2")
    with pytest.raises(ChainBroken, match="position 2"):
        back_up(log, folder)
    assert restore(target(), folder).position == 1


def test_a_full_disk_is_told_and_the_backup_before_stays_good(
    log: Log, folder: Path, target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    append(log, GATE, 1)
    with monkeypatch.context() as patched:
        patched.setattr(backup, "SPARE_BYTES", 2**60)
        with pytest.raises(BackupUnusable, match=r"the disk is nearly full.*What was backed up before stays good"):
            back_up(log, folder)
    assert restore(target(), folder).position == 1
    assert back_up(log, folder).manifest.position == 2


def test_a_checkpoint_never_speaks_of_output_that_the_backup_lacks(
    log: Log, folder: Path, target: Target, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(log, GATE, 1)
    read_all = log.read_all

    def work_then_read(*arguments: Any, **named: Any) -> Iterator[Segment]:
        with log.transaction() as transaction:
            transaction.save_checkpoint("rules", 1)
            transaction.append([draft(YARD, 1, 1)])
        return read_all(*arguments, **named)

    with monkeypatch.context() as patched:
        patched.setattr(log, "read_all", work_then_read)
        back_up(log, folder)
    dsn = target()
    restore(dsn, folder)
    with reopened(dsn) as other:
        assert (other.checkpoint("rules").position, other.stream_head(YARD, epoch=1).sequence) == (0, 0)


def test_an_account_that_is_not_the_owner_is_told(log: Log, folder: Path, target: Target, server: Server) -> None:
    append(log, GATE, 1)
    back_up(log, folder)
    dsn = target()
    server.execute("create role restorer login in role vian_writer")
    try:
        with pytest.raises(LogUnavailable, match=r"Next: restore as the role that owns the log's tables"):
            restore(psycopg.conninfo.make_conninfo(dsn, user="restorer"), folder)
    finally:
        server.execute("drop role restorer")


def test_the_manifest_says_what_is_in_the_backup(log: Log, folder: Path) -> None:
    append(log, GATE, 3, 2)
    back_up(log, folder)
    manifest = json.loads((folder / "manifest.json").read_text())
    (head,) = manifest["streams"]
    assert (manifest["format"], manifest["position"], manifest["events"], manifest["epoch"]) == (1, 2, 5, 1)
    assert head == {
        "stream": str(GATE),
        "epoch": 1,
        "sequence": 5,
        "chain_hash": log.stream_head(GATE).chain_hash.hex(),
        "after": 0,
        "after_hash": "00" * 32,
    }
    assert manifest["bases"] == []
    assert (folder / manifest["segments"][0]["name"]).stat().st_size == manifest["segments"][0]["bytes"]
