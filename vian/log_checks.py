"""What `vian doctor` looks at in a log: settings, clock, disk horizon, lag, backups and restores.

Contract: judges facts of `store.health` and `store.maintenance`; each finding ends with the next step.
"""

from collections.abc import Callable, Iterator, Mapping
from datetime import datetime, timedelta
from pathlib import Path

from store import ArchiveUnavailable, BackupDamaged, ChainBroken, Log, health, maintenance
from store.backup_files import restores
from store.maintenance import Care
from store.projector import NAME as PROJECTOR
from vian.clock import utc_now
from vian.findings import Finding, Verdict

GROWTH_WINDOW = timedelta(days=7)
GROWTH_LEAST = timedelta(hours=1)
"""How long a log must have been recorded before its growth says anything."""
HORIZON_BAD_DAYS = 7
HORIZON_NOTE_DAYS = 30
CLOCK_SECONDS_MAX = 2.0
BACKUP_AGE_MAX = timedelta(days=7)
WAL_BYTES_MIN = 512 * 2**20

_HURTS: Mapping[str, tuple[str, Verdict, str]] = {
    "fsync": ("on", Verdict.BAD, "a power cut can destroy the log"),
    "full_page_writes": ("on", Verdict.BAD, "a power cut can destroy pages of the log"),
    "synchronous_commit": ("on", Verdict.BAD, "what was acknowledged can be lost in a power cut"),
    "autovacuum": ("on", Verdict.BAD, "statistics age, row tables swell, and at last the database stops"),
    "zero_damaged_pages": ("off", Verdict.BAD, "damaged pages are silently emptied"),
    "ignore_checksum_failure": ("off", Verdict.BAD, "damaged pages are read as if they were whole"),
    "default_transaction_read_only": ("off", Verdict.BAD, "nothing can be appended"),
    "statement_timeout": ("0", Verdict.NOTE, "long reads, verify and backup among them, are broken off"),
}
"""For each setting what it should be, how bad another value is, and why."""
_DURABLE = ("on", "remote_apply", "remote_write", "local")
"""Values of synchronous_commit under which a commit is on this server's disk."""


def check_log(log: Log, free_bytes: int | None, now: Callable[[], datetime] = utc_now) -> Iterator[Finding]:
    """The findings about an open log.

    Args:
        log: The log.
        free_bytes: Room on its disk, if that can be seen.
        now: This machine's clock.
    """
    yield from _settings(log)
    yield check_clock(log, now)
    yield check_horizon(log, free_bytes)
    yield _lag(log)
    yield from _care(log, now())


def _settings(log: Log) -> Iterator[Finding]:
    found = health.settings(log)
    bad = False
    for name, (wanted, verdict, why) in _HURTS.items():
        value = found[name]
        if value == wanted or (name == "synchronous_commit" and value in _DURABLE):
            continue
        bad = True
        yield Finding("settings of the database", verdict, f"{name} is {value}: {why}. Next: {_set(name, wanted)}")
    if found["server_encoding"] != "UTF8":
        bad = True
        yield Finding(
            "settings of the database",
            Verdict.BAD,
            f"server_encoding is {found['server_encoding']}: texts beyond it cannot be stored. "
            "Next: make a database with encoding 'UTF8' and restore a backup into it",
        )
    wal = health.wal_bytes_max(log)
    if wal < WAL_BYTES_MIN:
        bad = True
        yield Finding(
            "settings of the database",
            Verdict.NOTE,
            f"max_wal_size is {found['max_wal_size']}: under load there is a checkpoint every few seconds. "
            f"Next: {_set('max_wal_size', '2GB')}",
        )
    if not bad:
        said = ", ".join(f"{name} {found[name]}" for name in ("fsync", "synchronous_commit", "max_wal_size"))
        yield Finding("settings of the database", Verdict.OK, said)


def _set(name: str, value: str) -> str:
    return f"alter system set {name} = '{value}'; select pg_reload_conf();"


def check_clock(log: Log, now: Callable[[], datetime]) -> Finding:
    """How this machine's clock agrees with the database's, and with the log."""
    before = now()
    told = health.clock(log)
    after = now()
    offset = max((before - told.now).total_seconds(), (told.now - after).total_seconds(), 0.0)
    if offset > CLOCK_SECONDS_MAX:
        return Finding(
            "clock",
            Verdict.BAD,
            f"the database's clock differs from this machine's by {offset:.0f} s ({told.now:%Y-%m-%d %H:%M:%S} UTC "
            "there). Next: set both by NTP",
        )
    ahead = (told.newest - told.now).total_seconds() if told.newest else 0.0
    if ahead > CLOCK_SECONDS_MAX:
        return Finding(
            "clock",
            Verdict.BAD,
            f"the newest segment was recorded {_span(timedelta(seconds=ahead))} in the future: the clock was set back. "
            "Times of recording stand still until it has caught up. Next: see that the clock is right, by NTP",
        )
    return Finding("clock", Verdict.OK, "that of the database agrees with this machine's and with the log")


def check_horizon(log: Log, free_bytes: int | None) -> Finding:
    """When the log's disk is full at the rate of the last days; `free_bytes` None where that cannot be seen."""
    grown = health.growth(log, GROWTH_WINDOW)
    if grown is None:
        return Finding("disk horizon", Verdict.OK, "the log is empty")
    if grown.over < GROWTH_LEAST:
        return Finding(
            "disk horizon",
            Verdict.NOTE,
            f"not known yet: there are {_span(grown.over)} to judge by; {_mib(grown.bytes)} now",
        )
    rate = f"{_mib(grown.bytes)} now, {_mib(grown.bytes_per_day)} a day over the last {_span(grown.over)}"
    if free_bytes is None:
        return Finding("disk horizon", Verdict.NOTE, f"{rate}; room on the database's server cannot be seen from here")
    days = free_bytes / max(1.0, grown.bytes_per_day)
    if days >= HORIZON_NOTE_DAYS:
        return Finding("disk horizon", Verdict.OK, f"{_days(days)}; {rate}")
    verdict = Verdict.BAD if days < HORIZON_BAD_DAYS else Verdict.NOTE
    return Finding(
        "disk horizon", verdict, f"full in {_days(days)}; {rate}. Next: free some, or move the log with --data-dir"
    )


def _lag(log: Log) -> Finding:
    behind = health.rows_behind(log)
    position = min([log.checkpoint(PROJECTOR).position, *behind.values()])
    lag = log.head() - position
    if lag <= 0:
        return Finding("row tables", Verdict.OK, "0 segments behind the log")
    try:
        since = health.recorded_at(log, position + 1)
        waits = f" (since {since:%Y-%m-%d %H:%M:%S} UTC)" if since else ""
    except (ArchiveUnavailable, ChainBroken) as error:
        waits = f" (since when cannot be told: {error})"
    most = "up to " if behind else ""
    built = f"; not built up yet: {', '.join(sorted(behind))}" if behind else ""
    unknown = sorted(name for name in behind if name not in log.catalogue)
    install = f"; install what brings {', '.join(unknown)}" if unknown else ""
    return Finding(
        "row tables",
        Verdict.NOTE,
        f"{most}{lag} segments behind the log{waits}{built}. Next: vian project, or keep vian serve running{install}",
    )


def _care(log: Log, now: datetime) -> Iterator[Finding]:
    done = maintenance.newest(log)
    began, restored = done.get(maintenance.RESTORE_BEGAN), done.get(maintenance.RESTORED)
    if began and not restored:
        yield Finding(
            "restore",
            Verdict.BAD,
            f"the restore of {began.place} that began at {began.at:%Y-%m-%d %H:%M:%S} UTC did not finish; nothing of "
            f"it is in the log. Next: vian restore {began.place} --verify, into an empty log",
        )
    elif restored:
        yield _restored(restored, done.get(maintenance.VERIFIED))
    yield from _backup(log, done.get(maintenance.BACKED_UP), now)


def _restored(restored: Care, verified: Care | None) -> Finding:
    came = f"this log was restored from {restored.place} at {restored.at:%Y-%m-%d %H:%M:%S} UTC"
    if verified and verified.at >= restored.at:
        return Finding("restore", Verdict.OK, f"{came}, read back and verified up to position {verified.position}")
    return Finding("restore", Verdict.NOTE, f"{came} and was not read back. Next: vian verify")


def _backup(log: Log, last: Care | None, now: datetime) -> Iterator[Finding]:
    head = log.head()
    if last is None:
        if head:
            yield Finding("backup", Verdict.NOTE, "there is none. Next: vian backup FOLDER, on another disk")
        return
    age = now - last.at
    behind = head - last.position
    said = f"{_span(age)} ago to {last.place}, up to position {last.position}; {behind} segments since"
    is_old = age > BACKUP_AGE_MAX and behind
    next_step = f". Next: vian backup {last.place}" if is_old else ""
    yield Finding("backup", Verdict.NOTE if is_old else Verdict.OK, said + next_step)
    yield _drill(last.place, now)


def _drill(place: Path, now: datetime) -> Finding:
    """When a restore of the backup was last verified; the backup's folder knows."""
    next_step = f"Next: vian restore {place} --verify, with --data-dir a new folder"
    try:
        verified = [each for each in restores(place) if each.verified]
        is_there = place.is_dir()
    except (OSError, BackupDamaged) as error:
        return Finding("verified restore", Verdict.NOTE, f"{place} cannot be looked at: {error}")
    if not is_there:
        return Finding("verified restore", Verdict.NOTE, f"not known: {place} is not there now. Next: connect it")
    if not verified:
        return Finding("verified restore", Verdict.NOTE, f"never of {place}: nobody knows that it works. {next_step}")
    newest = verified[-1]
    return Finding(
        "verified restore",
        Verdict.OK,
        f"{_span(now - newest.at)} ago, of {place} up to position {newest.position}",
    )


def _mib(size: float) -> str:
    return f"{size / 2**20:.0f} MiB" if size < 10 * 2**30 else f"{size / 2**30:.0f} GiB"


def _days(days: float) -> str:
    return f"{days:.0f} days" if days < 3650 else "more than 10 years"


def _span(span: timedelta) -> str:
    seconds = span.total_seconds()
    for size, name in ((86_400, "days"), (3_600, "hours"), (60, "minutes")):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} s"
