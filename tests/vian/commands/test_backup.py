"""`vian backup`, `restore` and `upgrade` at the command line."""

import errno
import json
import re
import shutil
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from typing import Any

import psycopg
import pytest
from alembic import command
from alembic.script import ScriptDirectory

from store import Log, backup_files, maintenance, make_key, verify
from store.embedded import EmbeddedServer
from store.schema import configuration, migrate
from tests.conftest import MakeLog, Server
from tests.store.samples import owner, query
from tests.store.test_schema import run as run_migration
from tests.store.tiered import seal_all
from tests.vian.conftest import Run
from tests.vian.samples import append, heads, points, reopened
from vian.version import VERSION

_numbers = count(1)


@pytest.fixture
def data_dir(public_folder: Path) -> Iterator[Path]:
    folder = public_folder / f"restored-{next(_numbers)}"
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def empty(server: Server) -> Iterator[str]:
    """Address of a database without tables."""
    name = server.create_database("template1")
    yield server.dsn(name)
    server.drop_database(name)


def last(out: str) -> dict[str, Any]:
    return dict(json.loads(out.splitlines()[-1]))


def test_a_backup_is_restored_into_a_folder_verified_and_told_to_both_logs(
    log: Log, run: Run, tmp_path: Path, data_dir: Path
) -> None:
    append(log, points(30))
    folder = tmp_path / "b"
    made = run("backup", folder, "--dsn", log.dsn)
    assert (made.code, made.err) == (0, "")
    assert made.out.startswith(f"backup in {folder}: 30 events up to position 1, ")
    assert last(run("backup", folder, "--dsn", log.dsn, "--json").out)["segments_new"] == 0

    done = run("restore", folder, "--verify", "--data-dir", data_dir)
    assert done.code == 0
    assert "restored 30 events up to position 1, backed up at " in done.out
    assert "read back and verified. The log goes on in epoch 2. Next: vian project" in done.out
    assert "restore: this log was restored from" in run("doctor", "--data-dir", data_dir).out
    assert re.search(rf"verified restore: \d+ s ago, of {folder} up", run("doctor", "--dsn", log.dsn).out)
    assert last(run("verify", "--data-dir", data_dir, "--json").out)["events"] == 30

    again = run("restore", folder, "--data-dir", data_dir)
    assert again.code == 1
    assert "is restored into an empty log only, this one holds 1 segments of 1 streams" in again.words


def test_a_backup_is_restored_into_a_database_by_address(log: Log, run: Run, tmp_path: Path, empty: str) -> None:
    append(log, points(3))
    run("backup", tmp_path / "b", "--dsn", log.dsn)
    done = run("restore", tmp_path / "b", "--dsn", empty, "--json")
    assert (done.code, last(done.out)["verified"], last(done.out)["epoch"]) == (0, False, 2)
    with Log(empty, log.catalogue) as other:
        assert heads(other) == heads(log)
        assert verify(other).is_sound


def test_a_restored_log_was_read_back_when_vian_verify_found_it_sound(
    log: Log, run: Run, tmp_path: Path, empty: str
) -> None:
    append(log, points(3))
    run("backup", tmp_path / "b", "--dsn", log.dsn)
    run("restore", tmp_path / "b", "--dsn", empty)
    assert "was not read back. Next: vian verify" in run("doctor", "--dsn", empty).out
    run("verify", "--dsn", empty)
    assert "read back and verified up to position 1" in run("doctor", "--dsn", empty).out
    with Log(empty, log.catalogue) as other:
        verified = maintenance.newest(other)["verified"]
        append(other, points(1))
        run("verify", "--dsn", empty)
        assert maintenance.newest(other)["verified"] == verified, "it is noted once"
    run("verify", "--dsn", log.dsn)
    assert "verified" not in maintenance.newest(log), "it was never restored"


def test_a_restored_log_that_is_not_sound_was_not_read_back(log: Log, run: Run, tmp_path: Path, empty: str) -> None:
    append(log, points(3))
    run("backup", tmp_path / "b", "--dsn", log.dsn)
    run("restore", tmp_path / "b", "--dsn", empty)
    with psycopg.connect(empty) as owner:
        owner.execute("alter table segments disable trigger all")
        owner.execute("update segments set event_count = 2")
    assert run("verify", "--dsn", empty).code == 1
    assert "was not read back. Next: vian verify" in run("doctor", "--dsn", empty).out


def test_an_older_backup_restored_into_the_same_database_is_verified_as_a_log_of_its_own(
    log: Log, run: Run, tmp_path: Path, empty: str
) -> None:
    append(log, points(3))
    run("backup", tmp_path / "b", "--dsn", log.dsn)
    run("restore", tmp_path / "b", "--dsn", empty)
    with Log(empty, log.catalogue) as other:
        append(other, points(1))
    assert run("verify", "--dsn", empty).code == 0
    with psycopg.connect(empty) as owner:
        owner.execute("set session_replication_role = replica")
        owner.execute("truncate segments, streams, checkpoints cascade")
        owner.execute("update log_head set position = 0, epoch = 1")
    again = run("restore", tmp_path / "b", "--dsn", empty)
    assert again.code == 0, again.err
    verified = run("verify", "--dsn", empty)
    assert verified.code == 0, verified.out


def test_public_keys_come_back_with_a_signed_log_and_the_private_one_is_asked_for(
    log: Log, run: Run, tmp_path: Path, empty: str
) -> None:
    old, new, other = (tmp_path / name / "station.key" for name in ("old", "new", "other"))
    append(log, points(3))
    key_id = last(run("init", "--dsn", log.dsn, "--key-file", old, "--json").out)["key_id"]
    make_key(other)
    (old.parent / "public-keys" / "others").mkdir()
    foreign = next((other.parent / "public-keys").iterdir())
    shutil.copy(foreign, old.parent / "public-keys" / "others")
    run("sign", "--dsn", log.dsn, "--key-file", old)
    run("backup", tmp_path / "b", "--dsn", log.dsn, "--key-file", old)
    assert not list((tmp_path / "b").rglob("station.key"))

    done = run("restore", tmp_path / "b", "--dsn", empty, "--key-file", new)
    assert f"Public keys that came with it, to be compared with those you noted: {key_id}. " in done.out
    assert f"copy the old station.key to {new}, and public-keys/ beside it. Next: vian project" in done.out
    assert {path.name for path in new.parent.rglob("*.pem")} == {f"{key_id}.pem", foreign.name}
    assert (new.parent / "public-keys" / "others" / foreign.name).exists()

    # The key is lost: the station goes on with a new one.
    at = ("--dsn", empty, "--key-file", new, "--station", "brno")
    run("init", *at)
    assert run("sign", *at).code == 0
    sound = run("verify", *at)
    assert sound.code == 0, sound.out
    (new.parent / "public-keys" / f"{key_id}.pem").unlink()
    broken = run("verify", "--full", *at)
    assert broken.code == 1
    assert f"Next: if you trust that key, put {key_id}.pem into public-keys/" in broken.out
    shutil.copy(tmp_path / "b" / "public-keys" / f"{key_id}.pem", new.parent / "public-keys")
    assert run("verify", "--full", *at).code == 0


def test_a_public_key_that_is_damaged_does_not_keep_from_a_backup(log: Log, run: Run, tmp_path: Path) -> None:
    append(log, points(3))
    (tmp_path / "public-keys").mkdir()
    (tmp_path / "public-keys" / "ab.pem").write_text("none")
    made = run("backup", tmp_path / "b", "--dsn", log.dsn, "--key-file", tmp_path / "station.key")
    assert made.code == 0
    assert "not every public key was copied: " in made.words
    assert backup_files.read_manifest(tmp_path / "b") is not None


def test_a_folder_without_a_backup_makes_no_log(run: Run, tmp_path: Path, data_dir: Path) -> None:
    ran = run("restore", tmp_path, "--data-dir", data_dir)
    assert ran.code == 1
    assert "holds no backup: there is no manifest.json. Next: give the folder that vian backup wrote" in ran.words
    assert not data_dir.exists()


def test_a_backup_on_a_disk_that_cannot_be_written_is_restored_with_a_warning(
    log: Log, run: Run, tmp_path: Path, empty: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(log, points(3))
    run("backup", tmp_path / "b", "--dsn", log.dsn)

    def refuse(*_: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(backup_files, "note_restore", refuse)
    ran = run("restore", tmp_path / "b", "--verify", "--dsn", empty)
    assert ran.code == 0
    assert "cannot be written (Read-only file system)" in ran.words
    assert "restore it only once, or two logs will claim epoch 2" in ran.words


def checks(out: str) -> dict[str, tuple[str, str]]:
    return {each["check"]: (each["verdict"], each["text"]) for each in map(json.loads, out.splitlines())}


def test_an_upgrade_of_a_log_of_this_version_has_nothing_to_do(log: Log, run: Run) -> None:
    ran = run("upgrade", "--check", "--dsn", log.dsn, "--json")
    assert ran.code == 0
    found = checks(ran.out)
    assert found["version"] == ("ok", f"this is ViAn {VERSION}")
    assert found["schema"][0] == "ok"
    assert "there is nothing to upgrade" in found["schema"][1]


def test_an_upgrade_says_what_it_would_do_and_then_does_it(make_log: MakeLog, run: Run) -> None:
    log = make_log()
    append(log, points(3))
    log.close()
    run_migration(log.dsn, command.downgrade, "0002")
    ran = run("upgrade", "--check", "--dsn", log.dsn, "--json")
    assert ran.code == 0
    lines = [json.loads(line) for line in ran.out.splitlines()]
    would = [each["text"].split(":")[0] for each in lines if each["check"] == "would run"]
    assert would[0] == "revision 0003"
    assert would[-1] >= "revision 0008"
    found = checks(ran.out)
    assert found["schema"][0] == "note"
    assert "revision 0002" in found["schema"][1]
    assert "a backup of it about" in found["disk"][1]

    assert checks(run("upgrade", "--check", "--dsn", log.dsn, "--json").out)["schema"][0] == "note", "only looked"
    done = checks(run("upgrade", "--dsn", log.dsn, "--json").out)
    assert done["upgraded"][0] == "ok"
    with reopened(log) as upgraded:
        assert verify(upgraded).events == 3
        append(upgraded, points(1, first_frame=3))


def test_an_upgrade_counts_row_tables_of_an_older_version_and_sealed_files(log: Log, run: Run, tmp_path: Path) -> None:
    append(log, points(3))
    seal_all(log, tmp_path / "archive")
    with owner(log) as connection:
        connection.execute("alter table sealed_files disable trigger user")
        connection.execute("update sealed_files set bytes = 5000 * 1024 * 1024::bigint")
        connection.execute("update projections set version = 1 where name = 'track_ended'")
    found = checks(run("upgrade", "--check", "--dsn", log.dsn, "--json").out)
    assert found["would rebuild"] == ("note", "rows of track_ended, of a newer version now")
    assert found["schema"][0] == "note"
    assert "a backup of it about 5000 MiB" in found["disk"][1]
    assert checks(run("upgrade", "--dsn", log.dsn, "--json").out)["upgraded"][0] == "ok"
    assert query(log, "select version from projections where name = 'track_ended'") == [(3,)]
    assert checks(run("upgrade", "--check", "--dsn", log.dsn, "--json").out)["schema"][0] == "ok"


def test_a_log_of_a_newer_version_is_not_touched(log: Log, run: Run, server: Server) -> None:
    with psycopg.connect(log.dsn, autocommit=True) as connection:
        connection.execute("update alembic_version set version_num = '9999'")
    for arguments in (["--check"], []):
        ran = run("upgrade", *arguments, "--dsn", log.dsn)
        assert ran.code == 1
        assert "bad   schema: revision 9999 is newer than this ViAn" in ran.out
        assert "Next: pip install --upgrade vian" in ran.out


def test_the_directory_of_another_major_is_told_the_way(run: Run, tmp_path: Path) -> None:
    (tmp_path / "log" / "pg").mkdir(parents=True)
    (tmp_path / "log" / "pg" / "PG_VERSION").write_text("15\n")
    ran = run("upgrade", "--check", "--data-dir", tmp_path / "log")
    assert ran.code == 1
    assert "bad   PostgreSQL: " in ran.out
    assert "vian backup FOLDER" in ran.out
    assert "vian restore FOLDER --verify with a new --data-dir" in ran.out


def test_where_there_is_no_log_there_is_nothing_to_upgrade(run: Run, tmp_path: Path, empty: str) -> None:
    ran = run("upgrade", "--check", "--data-dir", tmp_path / "new")
    assert (ran.code, (tmp_path / "new").exists()) == (0, False)
    assert "there is nothing to upgrade" in ran.out
    found = checks(run("upgrade", "--check", "--dsn", empty, "--json").out)
    assert "there is no log in the database yet" in found["schema"][1]


def test_an_embedded_log_is_examined_without_being_migrated(run: Run, data_dir: Path, log: Log) -> None:
    server = EmbeddedServer(data_dir)
    migrate(server.dsn, log.catalogue, "0002")
    server.close()
    found = checks(run("upgrade", "--check", "--data-dir", data_dir, "--json").out)
    assert "revision 0002" in found["schema"][1]
    assert found["disk"][0] == "ok"
    assert "revision 0002" in checks(run("upgrade", "--check", "--data-dir", data_dir, "--json").out)["schema"][1]


def test_every_revision_says_what_it_does() -> None:
    for script in ScriptDirectory.from_config(configuration()).walk_revisions():
        assert len(script.doc) > 10, script.revision
