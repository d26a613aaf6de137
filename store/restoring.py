"""Restore: a backup into an empty log, which thereby begins a new epoch.

Contract: all or nothing, in one transaction: interrupted at any moment the target stays empty, its
record says that a restore began, and the same command can be given again. Positions, times of
recording, bytes and chains come out as they were; each segment's hash and chain is checked before it
is stored. The streams of this log's own go on in a new epoch, behind every epoch that was given out
to a restore of this backup, so what the old log said after the backup is another history, and both
stay. Subscribers' checkpoints come back as they stood; those of row tables do not, since rows are
made again from the segments.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psycopg

from events import Chains, Place, Segment
from store import backup_files as files
from store.backup_files import Manifest, Restored
from store.epochs import others
from store.errors import BackupDamaged, BackupUnusable, ChainBroken, LogUnavailable
from store.following import follow
from store.log import Log
from store.maintenance import RESTORE_BEGAN, RESTORED, VERIFIED, newest, note, note_on
from store.projector import BEHIND
from store.projector import NAME as PROJECTOR
from store.schema import safe_dsn
from store.verification import Verification, verify

_COPY = (
    "copy segments (position, stream_id, first_sequence, event_count, schema_version, time_min, time_max, recorded_at, "
    "producer, producer_version, configuration_hash, payload, payload_hash, chain_hash) from stdin (format binary)"
)
_COPY_TYPES = (
    *("int8", "int8", "int8", "int4", "int4", "timestamptz", "timestamptz", "timestamptz"),
    *("text", "text", "bytea", "bytea", "bytea", "bytea"),
)


@dataclass(frozen=True, slots=True)
class Restore:
    """What a restore did."""

    position: int
    events: int
    epoch: int
    """The epoch that the log's own streams go on in."""
    made_at: datetime
    """When the backup was made: what came later is not in it."""


def restore(dsn: str, folder: Path, on_segment: Callable[[Segment], None] | None = None) -> Restore:
    """Fill the empty, migrated log at `dsn` from the backup in the folder.

    Args:
        dsn: Address of the log, as its owner; nobody else may be connected to it.
        folder: The backup.
        on_segment: Called after each segment, to show progress.

    Raises:
        BackupUnusable: There is no finished backup, or the log is not empty or in use.
        BackupDamaged: A file of the backup is not what its manifest says.
        LogUnavailable: The database is away, or the role is not the log's owner.
    """
    manifest = usable_manifest(folder)
    epoch = 1 + max([manifest.epoch, *(each.epoch for each in files.restores(folder))])
    try:
        with psycopg.connect(dsn, autocommit=True) as connection:
            connection.execute("set timezone to 'UTC'")
            _check_alone(connection)
            _check_empty(connection)
            note_on(connection, RESTORE_BEGAN, folder, manifest.position)
            with connection.transaction():
                # Who opens the log meanwhile waits here, and then learns the new epoch.
                connection.execute("lock table log_head in access exclusive mode")
                _check_empty(connection)
                _fill(connection, folder, manifest, epoch, on_segment)
                note_on(connection, RESTORED, folder, manifest.position)
            connection.execute("analyze segments")
    except psycopg.errors.InsufficientPrivilege as error:
        raise LogUnavailable(
            f"{safe_dsn(dsn)}: {error}. Next: restore as the role that owns the log's tables"
        ) from error
    except psycopg.OperationalError as error:
        raise LogUnavailable(
            f"the database at {safe_dsn(dsn)} could not take the backup: {error}. Nothing of it was stored. "
            "Next: vian doctor, then the same command again"
        ) from error
    return Restore(manifest.position, manifest.events, epoch, manifest.made_at)


def verify_restored(log: Log, folder: Path, on_segment: Callable[[Segment], None] | None = None) -> Verification:
    """Read the restored log back and check it as a whole; a sound one is recorded."""
    found = verify(log, on_segment)
    if found.is_sound:
        note(log, VERIFIED, folder, found.position)
    return found


def note_read_back(log: Log, position: int) -> None:
    """Record of a restored log that it was found sound as a whole, unless that was recorded since its restore."""
    done = newest(log)
    restored, verified = done.get(RESTORED), done.get(VERIFIED)
    if restored is not None and (verified is None or verified.at < restored.at):
        note(log, VERIFIED, restored.place, position)


def note_restored(folder: Path, restored: Restore, *, is_verified: bool) -> None:
    """Leave word beside the backup that it was restored: the log it came from reads it there.

    Raises:
        OSError: The folder cannot be written.
    """
    line = Restored(at=datetime.now(UTC), position=restored.position, epoch=restored.epoch, verified=is_verified)
    files.note_restore(folder, line)


def usable_manifest(folder: Path) -> Manifest:
    """The manifest of a finished backup whose files are all there.

    Raises:
        BackupUnusable: There is none.
    """
    manifest = files.read_manifest(folder)
    if manifest is None:
        is_begun = (folder / files.UNFINISHED).exists()
        state = "a backup that was never finished" if is_begun else "no backup"
        next_step = "vian backup to it again" if is_begun else "give the folder that vian backup wrote"
        raise BackupUnusable(f"{folder} holds {state}: there is no {files.MANIFEST}. Next: {next_step}")
    missing = [file.name for file in manifest.segments if not files.has_file(folder, file)]
    if missing:
        raise BackupDamaged(
            f"{folder} lacks {missing[0]}, or it has another size than the manifest says. "
            "Next: restore from another copy"
        )
    return manifest


def _check_alone(connection: psycopg.Connection[Any]) -> None:
    """Nothing, if no other program is connected: it would go on in the old epoch."""
    if count := others(connection):
        raise BackupUnusable(
            f"the log is in use: {count} other connections. Next: stop vian serve and whatever else uses it, "
            "then give the same command again"
        )


def _check_empty(connection: psycopg.Connection[Any]) -> None:
    row = connection.execute(
        "select position, (select count(*) from streams), (select count(*) from checkpoints where position > 0) "
        "from log_head"
    ).fetchone()
    assert row is not None, "a log has its one row"
    if any(row):
        raise BackupUnusable(
            f"a backup is restored into an empty log only, this one holds {row[0]} segments of {row[1]} streams and "
            f"{row[2]} checkpoints. Next: give a new folder with --data-dir, or an empty database with --dsn"
        )


def _fill(
    connection: psycopg.Connection[Any],
    folder: Path,
    manifest: Manifest,
    epoch: int,
    on_segment: Callable[[Segment], None] | None,
) -> None:
    connection.execute("delete from checkpoints")
    ids = _insert_streams(connection, manifest)
    chains = Chains(bases=[each.base for each in manifest.bases])
    with connection.cursor().copy(_COPY) as copy:
        copy.set_types(_COPY_TYPES)
        for segment in _checked(folder, manifest, chains):
            copy.write_row(_row(segment, ids))
            if on_segment is not None:
                on_segment(segment)
    if chains.runs != manifest.runs or chains.not_begun():
        raise BackupDamaged(f"{folder}: its segments do not end at the heads, or behind the bases, of its manifest")
    _insert_bases(connection, manifest, ids)
    for name, position, state in files.read_checkpoints(folder, manifest.checkpoints) if manifest.checkpoints else ():
        if name != PROJECTOR and not name.startswith(BEHIND):
            connection.execute(
                "insert into checkpoints (name, position, state) values (%s, %s, %s)", (name, position, state)
            )
    connection.execute(
        "update log_head set position = %s, epoch = %s, recorded_at = %s",
        (manifest.position, epoch, manifest.recorded_at),
    )


def _insert_streams(connection: psycopg.Connection[Any], manifest: Manifest) -> dict[Place, int]:
    ids = {}
    for (stream, epoch), runs in manifest.runs.items():
        head = max(runs, key=lambda run: run.sequence)
        row = connection.execute(
            "insert into streams (station, epoch, source, type, sequence, chain_hash) "
            "values (%s, %s, %s, %s, %s, %s) returning id",
            (stream.station, epoch, stream.source, stream.type, head.sequence, head.chain_hash),
        ).fetchone()
        assert row is not None, "an insert returns its row"
        ids[stream, epoch] = row[0]
    return ids


def _insert_bases(connection: psycopg.Connection[Any], manifest: Manifest, ids: dict[Place, int]) -> None:
    """Enter where runs began, and how far what lies below has come since."""
    runs = Chains(manifest.runs)
    for base in (each.base for each in manifest.bases):
        below = runs.below(base.place, base.sequence)
        is_reached = below.sequence >= base.sequence
        filled = (base.sequence, base.chain_hash) if is_reached else (below.sequence, below.chain_hash)
        connection.execute(
            "insert into stream_bases (stream_id, sequence, chain_hash, position, filled_sequence, filled_hash) "
            "values (%s, %s, %s, %s, %s, %s)",
            (ids[base.place], base.sequence, base.chain_hash, base.position, *filled),
        )


def _checked(folder: Path, manifest: Manifest, chains: Chains) -> Iterator[Segment]:
    """The backup's segments from position 1 to its last, each checked."""
    position = 0
    for file in manifest.segments:
        for segment in files.read_segments(folder, file):
            position += 1
            if segment.position != position:
                raise BackupDamaged(f"{folder / file.name}: position {position} is missing")
            try:
                follow(chains, segment)
            except ChainBroken as error:
                raise BackupDamaged(f"{folder / file.name}: {error}. Next: restore from another copy") from error
            yield segment
    if position != manifest.position:
        raise BackupDamaged(f"{folder}: its files end at position {position}, its manifest at {manifest.position}")


def _row(segment: Segment, ids: dict[Place, int]) -> tuple[Any, ...]:
    header = segment.header
    stream_id = ids.get((header.stream, header.epoch))
    if stream_id is None:
        raise BackupDamaged(f"position {segment.position} is of {header.stream}, which the manifest does not name")
    return (
        segment.position,
        stream_id,
        header.first_sequence,
        header.event_count,
        header.schema_version,
        header.time_min,
        header.time_max,
        segment.recorded_at,
        header.producer.name,
        header.producer.version,
        header.producer.configuration_hash,
        segment.payload or None,
        segment.payload_hash,
        segment.chain_hash,
    )
