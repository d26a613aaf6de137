"""`vian archive` and its parts: status, project, relocate."""

import shutil
from pathlib import Path

import pytest

from store import Log
from tests.vian.conftest import Run
from tests.vian.samples import append, objects, points
from vian.exclusive import exclusively


def test_old_segments_are_sealed_and_every_command_sees_the_whole_log(filled: Log, run: Run, tmp_path: Path) -> None:
    def seen() -> list[str]:
        commands = (
            ["streams", "--json"],
            ["tail", "-n", "12", "--json"],
            ["verify", "--full"],
            [
                "query",
                "select source, count(*), max(recorded_at) from track_point group by all order by all",
                "--json",
            ],
            [
                "query",
                "select * from events order by time, source limit 9",
                "--json",
                "--since",
                "2026-01-01T10:00:04Z",
            ],
        )
        return [run(*command, "--dsn", filled.dsn).out for command in commands]

    before = seen()
    ran = run("archive", "--older-than", "0d", "--to", tmp_path / "kept", "--dsn", filled.dsn)
    assert ran.code == 0
    sealed, parquet, summary = ran.out.splitlines()
    assert sealed.startswith("sealed positions 1 to 3: _sealed/000000000001-000000000003-")
    assert parquet.endswith("40 events in 1 files")
    assert summary == f"3 segments sealed in 1 files at {tmp_path / 'kept'}"
    assert seen() == before
    again = run("archive", "--older-than", "0d", "--dsn", filled.dsn)
    assert again.out.startswith("nothing to seal: no segment in PostgreSQL was taken before ")
    append(filled, points(2, first_frame=35))
    assert objects(run("archive", "--older-than", "0s", "--dsn", filled.dsn, "--json").out)[0]["first_position"] == 4


def test_what_is_young_stays_by_default(filled: Log, run: Run, tmp_path: Path) -> None:
    for more in ([], ["--dry-run"]):
        assert run("archive", "--to", tmp_path, "--dsn", filled.dsn, *more).out.startswith("nothing to seal")


def test_a_dry_run_tells_and_changes_nothing(filled: Log, run: Run, tmp_path: Path) -> None:
    (found,) = objects(
        run("archive", "--older-than", "0d", "--to", tmp_path / "a", "--dry-run", "--json", "--dsn", filled.dsn).out
    )
    assert (found["first_position"], found["last_position"], found["segments"], found["events"]) == (1, 3, 3, 40)
    assert not (tmp_path / "a").exists()
    assert filled.archive.sealed_position() == 0


def test_status_tells_where_and_how_much(filled: Log, run: Run, tmp_path: Path) -> None:
    assert "nothing is sealed" in run("archive", "status", "--dsn", filled.dsn).out
    run("archive", "--older-than", "0d", "--to", tmp_path / "a", "--dsn", filled.dsn)
    append(filled, points(2, first_frame=35))
    (found,) = objects(run("archive", "status", "--json", "--dsn", filled.dsn).out)
    wanted = {
        "location": str(tmp_path / "a"), "sealed_position": 3, "position": 4, "files": 1, "events": 40,
        "segments_in_postgresql": 1, "files_without_parquet": 0, "segments_without_parquet": 0, "interrupted": None,
        "time_min": "2026-01-01T10:00:00+00:00", "time_max": "2026-01-01T10:00:34+00:00",
    }  # fmt: skip
    assert found | wanted == found
    assert "positions 1 to 3 of 4 in 1 sealed files" in run("archive", "status", "--dsn", filled.dsn).out


def test_two_at_once_one_works_and_the_other_says_so(
    filled: Log, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("vian.exclusive.exclusively.__wrapped__.__kwdefaults__", {"patience_s": 0.1})
    with exclusively(filled, "the archive"):
        ran = run("archive", "--older-than", "0d", "--to", tmp_path, "--dsn", filled.dsn)
    assert ran.code == 1
    assert "another command is at work on the archive. Next: wait" in ran.words
    assert filled.archive.sealed_position() == 0


def test_an_interrupted_run_is_taken_up_by_the_next(filled: Log, run: Run, tmp_path: Path) -> None:
    run("archive", "--older-than", "0d", "--to", tmp_path, "--dsn", filled.dsn, "--file-mb", "1")
    append(filled, points(2, first_frame=35))
    half = tmp_path / "_sealed" / "half.parquet"
    half.write_bytes(b"PAR1")
    with Log(filled.dsn, filled.catalogue, role="vian_archiver") as log, log.connection() as connection:
        connection.execute("select plan_sealing(%s, '_sealed/half.parquet', 4)", (str(tmp_path),))
    assert "interrupted there" in run("archive", "status", "--dsn", filled.dsn).out
    ran = run("archive", "--older-than", "0d", "--dsn", filled.dsn)
    assert (ran.code, ran.out.splitlines()[-1]) == (0, f"1 segments sealed in 1 files at {tmp_path}")
    assert not half.exists()


def test_parquet_that_was_deleted_is_written_anew(filled: Log, run: Run, tmp_path: Path) -> None:
    run("archive", "--older-than", "0d", "--to", tmp_path, "--dsn", filled.dsn)
    (path,) = tmp_path.glob("track_point/**/*.parquet")
    path.unlink()
    assert "every sealed file has its Parquet" in run("archive", "project", "--dsn", filled.dsn).err
    ran = run("archive", "project", "--all", "--dsn", filled.dsn)
    assert ran.out.endswith("40 events in 1 files\n")
    assert path.exists()


def test_the_archive_moves_when_all_its_files_have(filled: Log, run: Run, tmp_path: Path) -> None:
    run("archive", "--older-than", "0d", "--to", tmp_path / "old", "--dsn", filled.dsn)
    (tmp_path / "new").mkdir()
    refused = run("archive", "relocate", "--to", tmp_path / "new", "--dsn", filled.dsn)
    assert refused.code == 1
    assert "is not there. Next: copy all files first" in refused.words
    shutil.copytree(tmp_path / "old", tmp_path / "new", dirs_exist_ok=True)
    (file,) = (tmp_path / "new" / "_sealed").iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[:-1] + b"?")
    assert "Next: copy it again" in run("archive", "relocate", "--to", tmp_path / "new", "--dsn", filled.dsn).words
    file.write_bytes(whole)
    moved = run("archive", "relocate", "--to", tmp_path / "new", "--dsn", filled.dsn)
    assert (moved.code, moved.out.startswith(f"the archive is at {tmp_path / 'new'}: 1 sealed files")) == (0, True)
    shutil.rmtree(tmp_path / "old")
    assert run("verify", "--dsn", filled.dsn).code == 0


def test_an_archive_that_is_away_is_told_with_the_next_command(filled: Log, run: Run, tmp_path: Path) -> None:
    run("archive", "--older-than", "0d", "--to", tmp_path / "a", "--dsn", filled.dsn)
    shutil.rmtree(tmp_path / "a")
    for command in (["tail"], ["verify", "--full"], ["query", "select count(*) from track_point"]):
        ran = run(*command, "--dsn", filled.dsn)
        assert ran.code == 1
        assert f"the archive of sealed files is not at {tmp_path / 'a'}. Next: mount or bring back" in ran.words


def test_doctor_looks_after_the_sealed_files(filled: Log, run: Run, tmp_path: Path) -> None:
    def finding() -> list[str]:
        return [line for line in run("doctor", "--dsn", filled.dsn).out.splitlines() if "archive: " in line]

    assert finding() == []
    run("archive", "--older-than", "0d", "--to", tmp_path / "a", "--dsn", filled.dsn)
    assert finding() == [f"ok    archive: 1 sealed files at {tmp_path / 'a'}"]
    (file,) = (tmp_path / "a" / "_sealed").iterdir()
    file.write_bytes(file.read_bytes()[:-1])
    assert finding()[0].startswith(f"bad   archive: 1 of 1 sealed files are missing or cut off, first {file}. Next: ")
    shutil.rmtree(tmp_path / "a")
    assert finding()[0].startswith(f"bad   archive: the archive of sealed files is not at {tmp_path / 'a'}. Next: ")


@pytest.mark.parametrize(
    "arguments, said",
    [
        (["--older-than", "soon"], "--older-than must be a span of time such as 30d"),
        (["--older-than", "-3d"], "--older-than must be a span of time such as 30d"),
        (["--older-than", "9999999d"], "lies before the year 1"),
        (["--older-than", "0d", "--to", "nope://x"], "no file system for the archive's URL 'nope://x'"),
        (["--older-than", "0d"], "Next: give --to FOLDER or URL"),
    ],
)
def test_wrong_usage_is_told(filled: Log, run: Run, arguments: list[str], said: str) -> None:
    ran = run("archive", *arguments, "--dsn", filled.dsn)
    assert ran.code == 2
    assert said in ran.words
    assert filled.archive.sealed_position() == 0
