"""Payloads that are gone at both sides: a station pruned what central held, and central lost it since.

Contract: that is found when a station sends such segments once more, without payload. Before it does, it records the
exact ranges as `loss_recorded`, an accident and so without a policy, in its own log; the event reaches central as any
other does. So both sides know it from their logs, for ever, until the payloads are back: `gone_in` gives only what is
without payload in the log that is asked. A loss that the own station of that log records of another's stream, says
that its operator knows; as a loss names no epoch, its policy says of which life of the stream.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from events import EventError, LossRecorded, Segment, Station, StreamName, decode, events_of
from store import ChainBroken, Log
from store.absence import Absence, recorded, without
from store.payloads import Weight
from sync.errors import Damaged
from sync.keeping.pruning import loss_of, record_of, spans_of

REASON = "it was pruned here when central held it, and was sent once more because central lacks it"


@dataclass(frozen=True, slots=True, order=True)
class Gone:
    """Segments of one stream, each following the one before, without payload at both sides."""

    stream: StreamName
    epoch: int
    first_sequence: int
    last_sequence: int

    def __str__(self) -> str:
        return f"{self.stream}, epoch {self.epoch}, sequences {self.first_sequence} to {self.last_sequence}"


class GoneRecorder:
    """Records what a station is about to send without payload though it never gave it up."""

    def __init__(self, log: Log, station: Station, now: Callable[[], datetime]) -> None:
        self._log = log
        self._station = station
        self._now = now

    def record(self, segments: Iterable[Segment]) -> list[Gone]:
        """What of the segments is gone for good, recorded unless it was before.

        Raises:
            Damaged: What is recorded so far cannot be read; whether it is known stays open, and it must not be sent.
            LogUnavailable: The database is away.
        """
        # A loss names no epoch, so of an earlier life of the log nothing can be said.
        hollow = [each for each in segments if not each.has_payload and each.header.epoch == self._log.epoch]
        if not hollow:
            return []
        known = self._recorded(hollow)
        spans = spans_of(_weight(each) for each in hollow if not known.is_lost(each))
        if spans:
            events = [loss_of(span, self._now(), REASON, None) for span in spans]
            self._log.append([record_of(self._station, events)], from_reserve=True)
        return [Gone(each.stream, each.epoch, each.first_sequence, each.last_sequence) for each in spans]

    def _recorded(self, hollow: Sequence[Segment]) -> Absence:
        try:
            return recorded(self._log, {each.stream for each in hollow}, self._station)
        except (EventError, ChainBroken) as error:
            header = hollow[0].header
            reason = f"its payload left the disk, and what is recorded of that cannot be read: {error}"
            raise Damaged(header.stream, header.epoch, header.first_sequence, reason) from error


def gone_in(log: Log, own: Station | None, station: Station | None = None) -> list[Gone]:
    """What is gone at both sides and in this log, by stream; not what its own station recorded as lost of another's.

    Args:
        log: The log.
        own: The station whose log it is, if that is known.
        station: Only of this station.

    Raises:
        ChainBroken, EventError: A record, or a segment, cannot be read.
        LogUnavailable: The database is away.
    """
    said: dict[tuple[StreamName, int], list[tuple[int, int]]] = {}
    known: dict[tuple[StreamName, str | None], list[tuple[int, int]]] = {}
    """By stream, and the policy that its life's losses have."""
    for segment in log.read_all(types=[LossRecorded.type_name]):
        for event in events_of(decode(segment, log.catalogue)):
            if not isinstance(event, LossRecorded) or event.what != "segments" or event.first_sequence is None:
                continue
            stream = StreamName.parse(event.stream)
            span = event.first_sequence, event.last_sequence or event.first_sequence
            epoch = int(segment.header.epoch)
            if segment.stream.station == stream.station and event.policy is None and station in (None, stream.station):
                said.setdefault((stream, epoch), []).append(span)
            elif segment.stream.station == own:
                policy = _noted(epoch) if stream.station == own else event.policy
                known.setdefault((stream, policy), []).append(span)
    return [
        each
        for (stream, epoch), spans in sorted(said.items())
        for span in sorted(spans)
        for first, last in without(span, known.get((stream, _noted(epoch)), []))
        for each in _hollow(log, Gone(stream, epoch, first, last))
    ]


def _hollow(log: Log, wanted: Gone) -> Iterator[Gone]:
    """What of a range is without payload in a log."""
    at: Gone | None = None
    for segment in log.read(wanted.stream, wanted.first_sequence, epoch=wanted.epoch, with_hollow=True):
        first, last = int(segment.header.first_sequence), int(segment.header.last_sequence)
        if first > wanted.last_sequence:
            break
        if segment.has_payload:
            continue
        if at is not None and at.last_sequence + 1 == first:
            first = at.first_sequence
        elif at is not None:
            yield at
        at = Gone(wanted.stream, wanted.epoch, first, last)
    if at is not None:
        yield at


def told_at_station(gone: Gone) -> str:
    """What an operator of the station is told."""
    return (
        f"payload gone here and at central: {gone}; pruned here when central held it, and central lost it since. "
        "Next: restore central from a newer backup (vian restore there); what is in no backup is gone for good"
    )


def told_at_central(gone: Gone) -> str:
    """What an operator of central is told."""
    return (
        f"payload gone here and at its station: {gone}; the station pruned it when it was held here, and it was lost "
        "here since, as by vian restore of an older backup. Next: vian restore of a newer backup; else "
        f"vian sync repair --stream {gone.stream} --epoch {gone.epoch} --from {gone.first_sequence} "
        f"--to {gone.last_sequence} asks the station again, and with --lost notes that it is gone for good"
    )


def accept(log: Log, own: Station, gone: Sequence[Gone], now: datetime) -> None:
    """Record in a central's own stream that it is known what of stations is gone.

    Raises:
        LogUnavailable: The database is away.
    """
    events = [
        LossRecorded(
            time=now,
            stream=str(each.stream),
            what="segments",
            count=None,
            first_sequence=each.first_sequence,
            last_sequence=each.last_sequence,
            lost_from_at=None,
            lost_until_at=None,
            reason="its operator says that it is in no backup",
            policy=_noted(each.epoch),
        )
        for each in gone
    ]
    if events:
        log.append([record_of(own, events)])


def _noted(epoch: int) -> str:
    """The policy of losses in that life of a stream of which an operator says that they are known."""
    return f"vian sync repair --lost --epoch {epoch}"


def _weight(segment: Segment) -> Weight:
    header = segment.header
    return Weight(
        segment.position,
        header.stream,
        header.epoch,
        header.first_sequence,
        header.last_sequence,
        header.time_min,
        header.time_max,
        segment.recorded_at,
        0,
    )
