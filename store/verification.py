"""Verify: recompute every hash of the log from its stored bytes, and check what was signed.

Contract: `verify` reads; it changes nothing. It finds a changed payload, a changed header, a
missing, doubled or reordered segment, and a head or a base that does not belong to its stream, and names the
first bad position of each stream. A gap before a base is no break: it is named as what is not here. Chains need no
knowledge of event types. `position` and `recorded_at`
are local to a log and not in the chain: signed checkpoints cover them, so a change of the order of
two streams or of a recorded_at is found up to the newest checkpoint, and named by the range between two. A sealed
file is compared to the byte with what was sealed.

It can begin behind what an earlier run found sound (`Verified`), once that is checked itself: the log
must not end before it, and each stream must still stand there with the hash that it had. Of a sealed file
that the earlier run compared to the byte, only that it is there in its size is looked at again.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from time import monotonic

from events import GENESIS, EventError, Place, Run, Segment, StreamName
from store import absence
from store.audit import Audit, Covered
from store.errors import UNKNOWN, ChainBroken, SealedFileDamaged
from store.log import Log
from store.sealed import SealedFile
from store.verified import Verified
from store.walk import Walk, pages

_SAVE_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class Gap:
    """Events of a stream that are not here because it was begun behind them, or chosen so by its station."""

    stream: StreamName
    epoch: int
    first: int
    last: int


@dataclass(frozen=True, slots=True)
class Verification:
    """What a verification found."""

    segments: int
    """read now; those up to `since` were not"""
    events: int
    streams: int
    position: int
    """The log was verified up to here."""
    broken: list[ChainBroken]
    """The first break of each broken stream, in the order of positions; empty when all is well."""
    since: int = 0
    """Up to here an earlier run had found the log sound; it was not read again."""
    covered: tuple[Covered, ...] = ()
    """What signatures cover."""
    hollow: int = 0
    """segments without payload, of those read now: pruned or lost"""
    unrecorded: int = 0
    """ranges of other stations' segments without payload of which these recorded no loss, or it has not come yet"""
    verified: Verified | None = field(default=None, compare=False, repr=False)
    """Where the next run can begin; None when the log is not sound."""
    gaps: tuple[Gap, ...] = ()
    """What is not here, and was said not to be; no breaks."""

    @property
    def is_sound(self) -> bool:
        """Whether every hash is right."""
        return not self.broken


def verify(
    log: Log,
    on_segment: Callable[[Segment], None] | None = None,
    *,
    before: Verified | None = None,
    station: str | None = None,
    trusted: Mapping[str, bytes] | None = None,
    save: Callable[[Verified], None] | None = None,
) -> Verification:
    """Check the log, as it stood when the call began.

    Args:
        log: The log.
        on_segment: Called after each segment, to show progress.
        before: What an earlier run found sound; the whole log is read without it, or where it does not hold.
        station: The station whose log this is.
        trusted: Its public keys by key id; without them, its first key is believed.
        save: Called every few seconds, as long as all is sound, with where an interrupted run can go on.
    """
    standing = log.standing()
    end = standing.position
    outdated = _outdated(log, end, before) if before is not None else []
    start = before if before is not None and not outdated else Verified.nothing()
    walk = start.walk()
    walk.chains.expect(base for base in standing.bases if base.position > start.position)
    audit = Audit(log, walk, end, standing.heads, standing.runs, station, trusted or {}, start.trails)
    saved_at = monotonic()
    for page in pages(log, start.position + 1, end):
        if isinstance(page, ChainBroken):
            walk.take_unreadable(page)
            audit.at()
            continue
        for segment in page:
            walk.take(segment)
            audit.take(segment)
            if on_segment is not None:
                on_segment(segment)
        if save is not None and walk.is_sound and monotonic() - saved_at > _SAVE_SECONDS:
            save(Verified.of(walk, audit.trails, start.digested))
            saved_at = monotonic()
    walk.go_to(end + 1)
    walk.position = end
    audit.at()
    audit.finish()
    walk.check_runs(standing)
    walk.faults += [fault for fault in outdated if fault.stream not in walk.broken]
    missing = _unrecorded(log, walk, station)
    foreign = [each for each in missing if each.stream.station != station and station is not None]
    walk.faults += [each for each in missing if each not in foreign and each.stream not in walk.broken]
    files = log.archive.files()
    walk.faults += _changed_files(log, files, start.digested, walk.faults)
    digested = max((file.last_position for file in files), default=0)
    return Verification(
        walk.segments - start.segments,
        walk.events - start.events,
        len(walk.chains.runs),
        end,
        walk.all_broken(),
        start.position,
        audit.covered(),
        walk.hollow_segments,
        len(foreign),
        Verified.of(walk, audit.trails, digested) if walk.is_sound else None,
        tuple(gaps_in(walk.chains.runs)),
    )


def gaps_in(runs: Mapping[Place, list[Run]]) -> Iterator[Gap]:
    """The gaps before and between the runs of streams."""
    for (stream, epoch), each in runs.items():
        last = 0
        for run in each:
            if run.after > last:
                yield Gap(stream, epoch, last + 1, run.after)
            last = run.sequence


def _unrecorded(log: Log, walk: Walk, station: str | None) -> list[ChainBroken]:
    """What has no payload though nothing says why; as much of it as the records that can be read tell."""
    try:
        return [
            absence.fault(place, span, walk.hollow_at.get((place, span[0])))
            for place, span in absence.unrecorded(log, walk.hollow, station)
        ]
    except (ChainBroken, EventError):
        return []  # the walk came by and says so


def _changed_files(
    log: Log, files: list[SealedFile], digested: int, faults: list[ChainBroken]
) -> list[SealedFileDamaged]:
    """The sealed files that differ from what was sealed, but for those that are told of already."""
    told = [fault.position or 0 for fault in faults if isinstance(fault, SealedFileDamaged)]
    return [
        changed
        for changed in log.archive.changed_files(files, digested)
        if not any((changed.position or 0) <= position <= changed.last_position for position in told)
    ]


def _outdated(log: Log, end: int, before: Verified) -> list[ChainBroken]:
    """Where the log is no longer what an earlier run found."""
    if end < before.position:
        reason = f"the log was found sound up to position {before.position}, now it ends at {end}"
        return [ChainBroken(UNKNOWN, end + 1, 0, reason)]
    faults = []
    for (stream, epoch), runs in before.runs.items():
        faults += [
            fault for run in runs if (fault := _outdated_run(log, stream, epoch, run, before, runs[-1])) is not None
        ]
    return faults


def _outdated_run(
    log: Log, stream: StreamName, epoch: int, run: Run, before: Verified, newest: Run
) -> ChainBroken | None:
    """How a run is no longer what an earlier verification found."""
    if run is newest:
        head = log.stream_head(stream, epoch=epoch, at_position=before.position)
        now = (head.sequence, head.chain_hash)
    else:
        segment = next(log.read(stream, run.sequence, epoch=epoch, with_hollow=True), None)
        now = (0, GENESIS) if segment is None else (int(segment.header.last_sequence), segment.chain_hash)
    if now == (run.sequence, run.chain_hash):
        return None
    reason = (
        f"it was found sound up to sequence {run.sequence} with the chain hash {run.chain_hash.hex()}, "
        f"now it stands there at {now[0]} with {now[1].hex()}"
    )
    return ChainBroken(stream, run.position, run.sequence, reason)
