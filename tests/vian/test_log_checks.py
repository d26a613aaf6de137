"""What `vian doctor` makes of a log's database: each finding with what is wrong and what is next."""

import shutil
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import sqlalchemy as sa

from store import Log, Projector, back_up, maintenance, note_restored, restore
from store.sealing import Sealer
from tests.conftest import MakeLog, Server
from tests.store.samples import on_both, owner, query
from tests.store.tiered import seal_all
from tests.vian.samples import append, points, reopened
from vian.findings import Verdict
from vian.log_checks import check_log

MIB = 2**20


def findings(
    log: Log, free: int | None = None, now: Callable[[], datetime] = lambda: datetime.now(UTC)
) -> dict[str, tuple[Verdict, str]]:
    with reopened(log) as fresh:
        return {each.check: (each.verdict, each.text) for each in check_log(fresh, free, now)}


def all_findings(log: Log) -> list[tuple[str, Verdict, str]]:
    with reopened(log) as fresh:
        return [(each.check, each.verdict, each.text) for each in check_log(fresh, None)]


@on_both
@pytest.mark.usefixtures("durable")
def test_a_well_kept_log_is_all_well(log: Log) -> None:
    found = findings(log)
    assert {verdict for verdict, _ in found.values()} == {Verdict.OK}
    assert found["settings of the database"][1].startswith("fsync on, synchronous_commit on, max_wal_size ")


def test_a_database_that_forgets_in_a_power_cut_is_bad(log: Log) -> None:
    found = [text for check, verdict, text in all_findings(log) if verdict is Verdict.BAD]
    assert [text.split(":")[0] for text in found] == ["fsync is off", "full_page_writes is off", "autovacuum is off"]
    assert "Next: alter system set fsync = 'on'; select pg_reload_conf();" in found[0]


@pytest.mark.usefixtures("durable")
@pytest.mark.parametrize(
    "setting, value, verdict, why",
    [
        ("synchronous_commit", "off", Verdict.BAD, "what was acknowledged can be lost"),
        ("default_transaction_read_only", "on", Verdict.BAD, "nothing can be appended"),
        ("zero_damaged_pages", "on", Verdict.BAD, "silently emptied"),
        ("statement_timeout", "5s", Verdict.NOTE, "long reads"),
        ("synchronous_commit", "local", Verdict.OK, "synchronous_commit local"),
    ],
)
def test_a_setting_that_hurts_is_named_with_its_reason(
    log: Log, server: Server, setting: str, value: str, verdict: Verdict, why: str
) -> None:
    server.execute(f"alter database {sa.make_url(log.dsn).database} set {setting} = '{value}'")
    found = [each for each in all_findings(log) if each[0] == "settings of the database"]
    assert [each[1] for each in found] == [verdict]
    assert why in found[0][2]


@pytest.mark.usefixtures("durable")
def test_a_small_max_wal_size_is_noted(log: Log, server: Server) -> None:
    try:
        server.execute("alter system set max_wal_size = '64MB'", "select pg_reload_conf()")
        server.wait_for({"max_wal_size": "64"})
        verdict, text = findings(log)["settings of the database"]
        assert verdict is Verdict.NOTE
        assert text.startswith("max_wal_size is 64MB: ")
    finally:
        server.execute("alter system reset max_wal_size", "select pg_reload_conf()")
        server.wait_for({"max_wal_size": "1024"})


@pytest.mark.parametrize("days", [-1, 1])
def test_a_clock_that_differs_by_a_day_from_the_databases_is_bad(log: Log, days: int) -> None:
    verdict, text = findings(log, now=lambda: datetime.now(UTC) + timedelta(days=days))["clock"]
    assert verdict is Verdict.BAD
    assert "differs from this machine's by 86400 s" in text.replace("86399", "86400")
    assert "Next: set both by NTP" in text


def test_a_newest_segment_from_the_future_is_bad(log: Log) -> None:
    append(log, points(1))
    assert findings(log)["clock"][0] is Verdict.OK
    with owner(log) as connection:
        connection.execute("update log_head set recorded_at = recorded_at + interval '3 days'")
    verdict, text = findings(log)["clock"]
    assert verdict is Verdict.BAD
    assert "recorded 3 days in the future: the clock was set back" in text


def age_by_a_day_each(log: Log, count: int) -> None:
    """Append so many like segments, recorded one a day, the last one now."""
    for number in range(count):
        append(log, points(50, first_frame=50 * number))
    with owner(log) as connection:
        connection.execute("alter table segments disable trigger user")
        connection.execute("update segments set recorded_at = now() - (%s - position) * interval '1 day'", (count,))


@pytest.mark.parametrize(
    "days_left, verdict, said",
    [
        (5, Verdict.BAD, "full in 5 days; "),
        (20, Verdict.NOTE, "full in 20 days; "),
        (100, Verdict.OK, "100 days; "),
        (10_000, Verdict.OK, "more than 10 years; "),
    ],
)
def test_the_disk_horizon_is_room_over_growth(log: Log, days_left: int, verdict: Verdict, said: str) -> None:
    age_by_a_day_each(log, 20)
    with owner(log) as connection:
        (size,) = connection.execute("select pg_database_size(current_database())").fetchone() or (0,)
    # Twenty days made the database as large as it is, and each the same part of it.
    found, text = findings(log, free=int(days_left * size / 20 * 1.001))["disk horizon"]
    assert found is verdict
    assert text.startswith(said)
    assert "a day over the last 7 days" in text
    assert ("Next: free some" in text) == (verdict is not Verdict.OK)


def test_only_the_newest_growth_counts(log: Log) -> None:
    age_by_a_day_each(log, 20)
    quick = findings(log, free=MIB)["disk horizon"][1]
    with owner(log) as connection:
        connection.execute("update segments set recorded_at = recorded_at - interval '10 days'")
    idle = findings(log, free=MIB)["disk horizon"][1]
    assert quick.startswith("full in")
    assert idle.startswith("more than 10 years; ")


def test_what_is_sealed_is_no_new_growth(log: Log, tmp_path: Path) -> None:
    age_by_a_day_each(log, 20)

    def days_left() -> int:
        return int(findings(log, free=200 * MIB)["disk horizon"][1].removeprefix("full in ").split()[0])

    before = days_left()
    list(Sealer(log, str(tmp_path)).seal(datetime.now(UTC) - timedelta(days=9.5)))
    # Sealed files are larger than the payloads in them.
    assert before <= days_left() < 2 * before
    assert query(log, "select count(*) from segments") == [(10,)]


def test_a_log_that_is_sealed_wholly_is_not_empty(log: Log, tmp_path: Path) -> None:
    append(log, points(1))
    seal_all(log, tmp_path)
    assert findings(log)["disk horizon"][1].startswith("not known yet: ")
    with owner(log) as connection:
        connection.execute("update log_head set recorded_at = now() - interval '3 days'")
    verdict, text = findings(log, free=MIB)["disk horizon"]
    assert verdict is Verdict.OK
    assert "0 MiB a day over the last 3 days" in text


def test_a_log_of_an_hour_has_no_horizon_yet(log: Log) -> None:
    assert findings(log)["disk horizon"] == (Verdict.OK, "the log is empty")
    append(log, points(1))
    verdict, text = findings(log, free=1)["disk horizon"]
    assert verdict is Verdict.NOTE
    assert text.startswith("not known yet: there are ")


def test_the_row_tables_are_as_far_as_the_type_that_is_furthest_behind(log: Log, tmp_path: Path) -> None:
    for number in range(3):
        append(log, points(1, first_frame=number))
    projector = Projector(log)
    projector.catch_up()
    assert findings(log)["row tables"] == (Verdict.OK, "0 segments behind the log")
    projector.rebuild("track_point")
    began = next(log.read_all()).recorded_at
    seal_all(log, tmp_path / "archive")
    verdict, text = findings(log)["row tables"]
    assert verdict is Verdict.NOTE
    assert text == (
        f"up to 3 segments behind the log (since {began:%Y-%m-%d %H:%M:%S} UTC); not built up yet: track_point. "
        "Next: vian project, or keep vian serve running"
    )
    (tmp_path / "archive").rename(tmp_path / "elsewhere")
    verdict, text = findings(log)["row tables"]
    assert verdict is Verdict.NOTE
    assert "since when cannot be told" in text
    assert f"is not at {tmp_path}/archive" in text


def test_a_log_without_a_backup_is_told_to_make_one(log: Log) -> None:
    assert "backup" not in findings(log)
    append(log, points(1))
    assert findings(log)["backup"] == (Verdict.NOTE, "there is none. Next: vian backup FOLDER, on another disk")


def test_a_backup_grows_old_when_there_is_more_to_back_up(log: Log, tmp_path: Path) -> None:
    append(log, points(1))
    back_up(log, tmp_path / "b")

    def next_month() -> datetime:
        return datetime.now(UTC) + timedelta(days=30)

    assert findings(log)["backup"][0] is Verdict.OK
    assert findings(log, now=next_month)["backup"][0] is Verdict.OK
    append(log, points(1, first_frame=1))
    assert findings(log)["backup"][0] is Verdict.OK
    verdict, text = findings(log, now=next_month)["backup"]
    assert verdict is Verdict.NOTE
    assert text == f"30 days ago to {tmp_path}/b, up to position 1; 1 segments since. Next: vian backup {tmp_path}/b"


def test_the_log_that_was_backed_up_knows_when_a_restore_was_last_verified(
    log: Log, make_log: MakeLog, tmp_path: Path
) -> None:
    append(log, points(1))
    folder = tmp_path / "b"
    back_up(log, folder)
    verdict, text = findings(log)["verified restore"]
    assert verdict is Verdict.NOTE
    assert f"never of {folder}: nobody knows that it works. Next: vian restore {folder} --verify" in text
    target = make_log()
    target.close()
    note_restored(folder, restore(target.dsn, folder), is_verified=True)
    verdict, text = findings(log)["verified restore"]
    assert verdict is Verdict.OK
    assert text.endswith(f" s ago, of {folder} up to position 1")
    shutil.rmtree(folder)
    assert findings(log)["verified restore"] == (
        Verdict.NOTE,
        f"not known: {folder} is not there now. Next: connect it",
    )


def test_a_restored_log_knows_where_it_came_from_and_whether_it_was_read_back(
    log: Log, make_log: MakeLog, tmp_path: Path
) -> None:
    append(log, points(1))
    back_up(log, tmp_path / "b")
    target = make_log()
    target.close()
    restore(target.dsn, tmp_path / "b")
    verdict, text = findings(target)["restore"]
    assert verdict is Verdict.NOTE
    assert "and was not read back. Next: vian verify" in text
    with reopened(target) as other:
        maintenance.note(other, maintenance.VERIFIED, tmp_path / "b", 1)
    verdict, text = findings(target)["restore"]
    assert verdict is Verdict.OK
    assert text.endswith("read back and verified up to position 1")
    with reopened(target) as other:
        maintenance.note(other, maintenance.RESTORED, tmp_path / "b", 1)
    assert "and was not read back" in findings(target)["restore"][1], "it was restored once more"


def test_a_restore_that_did_not_finish_is_bad(log: Log, tmp_path: Path) -> None:
    maintenance.note(log, maintenance.RESTORE_BEGAN, tmp_path / "b", 7)
    verdict, text = findings(log)["restore"]
    assert verdict is Verdict.BAD
    assert f"the restore of {tmp_path}/b that began at " in text
    assert f"did not finish; nothing of it is in the log. Next: vian restore {tmp_path}/b --verify" in text
