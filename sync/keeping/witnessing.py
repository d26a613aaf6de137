"""Whether the countersignatures that a log holds hold themselves.

Contract: reads only. Each signature by a key that is known is checked over all that its event says, and the newest of
each station against the log: at its heads and bases the log must have the very chain hashes, as far as it is there.
Signatures by other keys, as of a central of before, are counted and prove nothing.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from events import CheckpointCountersigned, EventError, Segment, Station, decode, events_of
from store import ChainBroken, Log
from sync.keeping.countersigned import Held, held_in, is_countersigned
from sync.keeping.held import hash_at


@dataclass(frozen=True, slots=True)
class Witnessed:
    """What was found."""

    signatures: int
    """by keys that are known, and sound"""
    unknown: int
    """by keys that are not known"""
    broken: tuple[ChainBroken, ...]


def witnessed(log: Log, keys: Mapping[str, bytes], after: int = 0) -> Witnessed:
    """What the countersignatures of a log are worth.

    Args:
        log: The log.
        keys: Public keys of centrals that are known, by key id.
        after: Only what the log took behind this position.

    Raises:
        LogUnavailable: The database is away.
    """
    sound, unknown = 0, 0
    broken: list[ChainBroken] = []
    newest: dict[Station, tuple[Segment, int, CheckpointCountersigned]] = {}
    for segment in log.read_all(after + 1, types=[CheckpointCountersigned.type_name]):
        try:
            events = events_of(decode(segment, log.catalogue))
        except EventError as error:
            broken.append(ChainBroken(segment.stream, segment.position, segment.header.first_sequence, str(error)))
            continue
        for sequence, event in enumerate(events, segment.header.first_sequence):
            assert isinstance(event, CheckpointCountersigned), "only these were asked for"
            if event.key_id not in keys:
                unknown += 1
            elif is_countersigned(event, keys[event.key_id]):
                sound += 1
                newest[segment.stream.station] = segment, sequence, event
            else:
                reason = f"it says that key {event.key_id} signed it, whose signature it does not bear"
                broken.append(ChainBroken(segment.stream, segment.position, sequence, reason))
    for segment, sequence, event in newest.values():
        for reason in _contradictions(log, event):
            broken.append(ChainBroken(segment.stream, segment.position, sequence, reason))
    return Witnessed(sound, unknown, tuple(broken))


def _contradictions(log: Log, event: CheckpointCountersigned) -> Iterator[str]:
    """Where the log has another chain hash than central signed."""
    for held in held_in(event.held):
        for sequence, said in _places(held):
            here = hash_at(log, held.head.stream, held.head.epoch, sequence)
            if here is not None and here != said:
                yield (
                    f"central signed the chain hash {said.hex()} at sequence {sequence} of {held.head.stream}, "
                    f"epoch {held.head.epoch}, here it is {here.hex()}"
                )


def _places(held: Held) -> Iterator[tuple[int, bytes]]:
    yield held.head.sequence, held.head.chain_hash
    if held.after:
        yield held.after, held.after_hash
