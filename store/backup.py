"""Backup: the log's segments verbatim in a folder, with checkpoints and heads of one moment.

Contract: a backup reads, beside writers, and changes nothing but the log's record of its backups. It
may be made again into the same folder and then adds what is new; killed at any moment, the backup
that was there stays good, and the next run goes on. Every segment's hash and chain is checked on the
way, so damage does not creep into a backup. Why this and not pg_dump: docs/decisions/0014.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from events import GENESIS, Base, Chains, Segment
from store import backup_files as files
from store.backup_files import BegunBehind, Head, Manifest
from store.errors import UNKNOWN, BackupUnusable, ChainBroken
from store.following import follow
from store.log import Log
from store.maintenance import BACKED_UP, note
from store.standing import STANDING, Standing, standing_of

SPARE_BYTES = 32 * 2**20
"""Room that a backup leaves on its disk."""


@dataclass(frozen=True, slots=True)
class Backup:
    """What a backup did."""

    manifest: Manifest
    segments_new: int
    bytes_new: int


@dataclass(frozen=True, slots=True)
class _Moment:
    """Where everything stood at one moment."""

    epoch: int
    recorded_at: datetime
    checkpoints: list[tuple[str, int, bytes]]
    standing: Standing

    @property
    def position(self) -> int:
        return self.standing.position


def back_up(log: Log, folder: Path, on_segment: Callable[[Segment], None] | None = None) -> Backup:
    """Bring the backup in the folder up to the log as it stands.

    Args:
        log: The log.
        folder: Where the backup is or will be; made if it is not there.
        on_segment: Called after each segment, to show progress.

    Raises:
        BackupUnusable: The folder holds the backup of another log or something else, or is full.
        BackupDamaged: The folder's manifest cannot be read.
        ChainBroken: A segment of the log is damaged; what was backed up before stays good.
        LogUnavailable: The database is away.
    """
    _make_folder(folder)
    base = _base(log, folder)
    moment = _moment(log)
    try:
        manifest, count = _add_segments(log, folder, base, moment, on_segment)
        file = files.write_checkpoints(folder, moment.position, moment.checkpoints)
        manifest = manifest.model_copy(
            update={"made_at": datetime.now(UTC), "epoch": moment.epoch, "checkpoints": file}
        )
        files.write_manifest(folder, manifest)
        (folder / files.UNFINISHED).unlink(missing_ok=True)
        files.remove_strays(folder, [*manifest.segments, file])
    except OSError as error:
        raise BackupUnusable(
            f"the backup cannot be written to {folder}: {error.strerror or error} "
            f"({shutil.disk_usage(folder).free // 2**20} MiB free). What was backed up before stays good. "
            "Next: make room there, or give another folder; then run the same command again"
        ) from error
    note(log, BACKED_UP, folder, manifest.position)
    known = base.bytes if base else 0
    return Backup(manifest, count, manifest.bytes - known)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
        strangers = [path.name for path in folder.iterdir()] if not _is_backup(folder) else []
    except OSError as error:
        raise BackupUnusable(
            f"{folder} cannot be used for a backup: {error.strerror or error}. Next: give a folder that you may write"
        ) from error
    if strangers:
        raise BackupUnusable(
            f"{folder} is no backup and not empty: it holds {sorted(strangers)[0]!r}. Next: give a new folder"
        )


def _is_backup(folder: Path) -> bool:
    names = (files.MANIFEST, files.UNFINISHED)
    # A run that was killed before its first file was complete left at most parts of files.
    return any((folder / name).exists() for name in names) or all(
        path.name.endswith((".part", ".arrow")) for path in folder.iterdir()
    )


def _base(log: Log, folder: Path) -> Manifest | None:
    """What the folder holds already of this log."""
    candidates = [files.read_manifest(folder, name) for name in (files.UNFINISHED, files.MANIFEST)]
    for manifest in candidates:
        if manifest is None or manifest.position == 0:
            continue
        missing = [file.name for file in manifest.segments if not files.has_file(folder, file)]
        if missing:
            raise BackupUnusable(
                f"the backup in {folder} lacks {missing[0]} or has another size of it. "
                "Next: back up to a new folder, and keep this one until that is done"
            )
        _check_same_log(log, manifest, folder)
        return manifest
    return None


def _check_same_log(log: Log, manifest: Manifest, folder: Path) -> None:
    at = manifest.position
    newest = next(log.read_all(at, to_position=at, with_hollow=True), None) if log.head() >= at else None
    if newest is None or newest.chain_hash.hex() != manifest.last_chain_hash:
        here = f"stands at {log.head()}" if newest is None else "holds another segment there"
        raise BackupUnusable(
            f"{folder} holds the backup of another history: up to position {at}, this log {here}. "
            "Next: back up to a new folder"
        )


def _moment(log: Log) -> _Moment:
    """Head, streams and checkpoints in one snapshot: a checkpoint never speaks of output that is not there."""
    with log.connection() as connection, connection.transaction():
        connection.execute("set transaction isolation level repeatable read read only")
        head = connection.execute("select epoch, recorded_at from log_head").fetchone()
        assert head is not None, "a log has its one row"
        checkpoints = connection.execute(
            "select name, position, state from checkpoints order by name", binary=True
        ).fetchall()
        standing = standing_of(connection.execute(STANDING, binary=True))
    epoch, recorded_at = head
    return _Moment(epoch, recorded_at, checkpoints, standing)


def _add_segments(
    log: Log,
    folder: Path,
    base: Manifest | None,
    moment: _Moment,
    on_segment: Callable[[Segment], None] | None,
) -> tuple[Manifest, int]:
    """The manifest with all segments up to the moment, and how many of them are new."""
    manifest = base or Manifest(
        made_at=moment.recorded_at,
        epoch=moment.epoch,
        position=0,
        events=0,
        last_chain_hash=GENESIS.hex(),
        recorded_at=moment.recorded_at,
        segments=(),
        checkpoints=None,
        streams=(),
    )
    begun_at = manifest.position
    bases = [base for base in moment.standing.bases if base.position > begun_at]
    chains = Chains(manifest.runs, bases)
    last: list[Segment] = []
    segments = _checked(
        log.read_all(begun_at + 1, to_position=moment.position, with_hollow=True), chains, begun_at, last, on_segment
    )
    while (written := files.write_segments(folder, segments)) is not None:
        file, events = written
        # A segment may have been taken from the iterator but not written: none is, a file ends where it asks no more.
        assert last[0].position == file.last_position
        manifest = manifest.model_copy(
            update={
                "position": file.last_position,
                "events": manifest.events + events,
                "last_chain_hash": last[0].chain_hash.hex(),
                "recorded_at": last[0].recorded_at,
                "segments": (*manifest.segments, file),
                "checkpoints": None,
                "streams": tuple(Head.of(place, run) for place, runs in chains.runs.items() for run in runs),
                "bases": tuple(BegunBehind.of(base) for base in _begun(moment.standing, file.last_position)),
            }
        )
        files.write_manifest(folder, manifest, files.UNFINISHED)
        _check_room(folder)
    if manifest.position != moment.position:
        raise ChainBroken(
            UNKNOWN,
            manifest.position + 1,
            0,
            f"the log ends at position {manifest.position}, its head says {moment.position}",
        )
    _check_ends(chains, moment.standing)
    return manifest, manifest.position - begun_at


def _begun(standing: Standing, position: int) -> list[Base]:
    """The bases that are known at a position, in order."""
    begun = (base for base in standing.bases if base.position <= position)
    return sorted(begun, key=lambda base: base.position)


def _check_ends(chains: Chains, moment: Standing) -> None:
    """Nothing, if the segments end where the log says that its streams stand."""
    if chains.runs == moment.runs and not chains.not_begun():
        return
    places = [*moment.runs, *chains.runs, *(base.place for base in chains.not_begun())]
    wrong = next((each for each in places if chains.runs.get(each) != moment.runs.get(each)), places[-1])
    newest = max((run.sequence for run in moment.runs.get(wrong, ())), default=0)
    raise ChainBroken(wrong[0], None, newest, "its head or its bases are not those of its segments")


def _checked(
    segments: Iterable[Segment],
    chains: Chains,
    position: int,
    last: list[Segment],
    on_segment: Callable[[Segment], None] | None,
) -> Iterator[Segment]:
    """The segments, each checked; `last` holds the newest."""
    for segment in segments:
        if segment.position != position + 1:
            header = segment.header
            reason = f"position {position + 1} is missing before it"
            raise ChainBroken(header.stream, segment.position, header.first_sequence, reason)
        follow(chains, segment)
        position = segment.position
        last[:] = [segment]
        yield segment
        if on_segment is not None:
            on_segment(segment)


def _check_room(folder: Path) -> None:
    free = shutil.disk_usage(folder).free
    if free < SPARE_BYTES:
        raise OSError(f"the disk is nearly full, {free // 2**20} MiB are left")
