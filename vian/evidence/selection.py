"""Which events are wanted as evidence, and why: of one stream, or all that one situation rests on.

Contract: looks into the log and changes nothing. A `Wanted` names ranges of sequences of one life of one stream;
whole segments hold them, so a few neighbours come along.
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from events import (
    EventError,
    EventType,
    ProcessStarted,
    RuleDeployed,
    Run,
    Segment,
    SituationDetected,
    StreamName,
    VideoAdded,
    decode,
    events_of,
)
from store import Log, StreamHead
from vian.errors import WorldFailed, WrongUsage

SITUATION_MIN = 6
"""Fewest characters of a situation's identity that may stand for it."""


@dataclass(frozen=True, slots=True)
class Wanted:
    """Events of one life of one stream."""

    stream: StreamName
    epoch: int
    ranges: tuple[tuple[int, int], ...]
    """first and last sequence of each, inclusive, in order, apart from each other"""
    why: tuple[str, ...]

    def within(self, run: Run) -> "Wanted | None":
        """What of it is in a run of the stream; None where nothing is."""
        clipped = ((max(first, run.after + 1), min(last, run.sequence)) for first, last in self.ranges)
        ranges = tuple((first, last) for first, last in clipped if first <= last)
        return Wanted(self.stream, self.epoch, ranges, self.why) if ranges else None


@dataclass(frozen=True, slots=True)
class Found:
    """One event, and where it is."""

    event: EventType
    sequence: int
    segment: Segment


@dataclass(slots=True)
class Selection:
    """What is exported, and what the manifest says of it."""

    question: dict[str, Any]
    wanted: list[Wanted] = field(default_factory=list)
    situation: dict[str, Any] | None = None
    rule: dict[str, Any] | None = None
    videos: list[dict[str, Any]] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    """what could not be found, for people"""

    def want(self, stream: StreamName, epoch: int, first: int, last: int, why: str) -> None:
        """Want one more range."""
        for index, each in enumerate(self.wanted):
            if (each.stream, each.epoch) == (stream, epoch):
                why_all = each.why if why in each.why else (*each.why, why)
                self.wanted[index] = Wanted(stream, epoch, _merged([*each.ranges, (first, last)]), why_all)
                return
        self.wanted.append(Wanted(stream, epoch, ((first, last),), (why,)))

    def want_event(self, found: Found, why: str) -> None:
        """Want one event."""
        self.want(found.segment.stream, found.segment.header.epoch, found.sequence, found.sequence, why)


def of_stream(
    log: Log,
    stream: StreamName,
    since: int | datetime | None,
    until: int | datetime | None,
    epoch: int | None = None,
) -> Selection:
    """A stream's events between two sequences, both inclusive, or two times, the second exclusive.

    Args:
        log: The log.
        stream: The stream.
        since: From where on; the beginning by default.
        until: Up to where; the end by default.
        epoch: Only this life of the stream; all of them by default.

    Raises:
        WrongUsage: There is no such stream or life, it has no such events, or a sequence is one of several lives.
    """
    lives = _lives(log, stream, epoch)
    if len(lives) > 1 and (isinstance(since, int) or isinstance(until, int)):
        raise WrongUsage(
            f"{stream} has several lives, each with sequences of its own: {_told(lives)}. "
            "Next: say which by --epoch, or give times instead of sequences"
        )
    question: dict[str, Any] = {"stream": str(stream), "from": _plain(since), "to": _plain(until)}
    selection = Selection(question | ({"epoch": epoch} if epoch is not None else {}))
    for life in lives:
        first, last = _bounds(log, life, since, until)
        if first <= last:
            selection.want(stream, life.epoch, first, last, "asked for")
    if not selection.wanted:
        raise WrongUsage(
            f"{stream} has no events from {since or 'its beginning'} to {until or 'its end'}; "
            f"it has {_told(lives)}. Next: vian tail --source {stream.source} --type {stream.type}"
        )
    for wanted in list(selection.wanted):
        _want_origin(log, selection, wanted)
    return selection


def of_situation(log: Log, identity: str) -> Selection:
    """All that a situation rests on: itself, the events of its lineage, its rule, the processes and videos.

    Raises:
        WrongUsage: There is no such situation, or several begin so.
    """
    found = _situation(log, identity)
    event = found.event
    assert isinstance(event, SituationDetected), "it was looked for"
    selection = Selection({"situation": event.situation})
    selection.situation = {"stream": str(found.segment.stream), "sequence": found.sequence, **_said(event)}
    selection.want_event(found, "the situation")
    _want_lineage(log, selection, found, set())
    for lineage in [each for each in selection.wanted if each.why[0].startswith("lineage")]:
        _want_origin(log, selection, lineage)
    _want_rule(log, selection, event)
    return selection


def _bounds(log: Log, head: StreamHead, since: int | datetime | None, until: int | datetime | None) -> tuple[int, int]:
    """First and last sequence."""
    times = [each for each in (since, until) if isinstance(each, datetime)]
    first = since if isinstance(since, int) else 1
    last = min(until if isinstance(until, int) else head.sequence, head.sequence)
    if not times:
        return max(first, 1), last
    begin, end = since if isinstance(since, datetime) else None, until if isinstance(until, datetime) else None
    hits = [
        sequence
        for segment in log.read(head.stream, first, epoch=head.epoch, with_hollow=True)
        if segment.header.first_sequence <= last
        if (begin is None or segment.header.time_max >= begin) and (end is None or segment.header.time_min < end)
        for sequence, time in _times(log, segment)
        if (begin is None or time >= begin) and (end is None or time < end) and first <= sequence <= last
    ]
    return (min(hits), max(hits)) if hits else (1, 0)


def _times(log: Log, segment: Segment) -> Iterator[tuple[int, datetime]]:
    try:
        times = decode(segment, log.catalogue).data.column("time").to_pylist()
    except EventError as error:
        raise WorldFailed(
            f"the times of {segment.stream} cannot be read: {error}. Next: give sequences instead of times"
        ) from error
    yield from enumerate(times, segment.header.first_sequence)


def _situation(log: Log, identity: str) -> Found:
    if len(identity) < SITUATION_MIN:
        raise WrongUsage(
            f"--situation wants an identity, or its first {SITUATION_MIN} characters or more; got {identity!r}"
        )
    hits = [
        found
        for segment in log.read_all(types=[SituationDetected.type_name])
        for found in _events(log, segment)
        if isinstance(found.event, SituationDetected) and found.event.situation.startswith(identity)
    ]
    if len(hits) != 1:
        what = "no situation begins" if not hits else f"{len(hits)} situations begin"
        raise WrongUsage(
            f"{what} with {identity!r}. Next: vian tail --type situation_detected, and give more of the field situation"
        )
    return hits[0]


def _want_lineage(log: Log, selection: Selection, found: Found, seen: set[str]) -> None:
    """Want the events of the lineage; of situations among them, their lineage and their rules, too."""
    event = found.event
    assert isinstance(event, SituationDetected), "it was looked for"
    seen.add(event.situation)
    for each in event.lineage:
        stream = StreamName.parse(each.stream)
        epoch = epoch_of(log, stream, found.segment, each.last_sequence)
        selection.want(stream, epoch, each.first_sequence, each.last_sequence, f"lineage: {each.variable}")
        if stream.type != SituationDetected.type_name:
            continue
        for segment in log.read(stream, each.first_sequence, epoch=epoch):
            if segment.header.first_sequence > each.last_sequence:
                break
            for lower in _events(log, segment):
                is_matched = each.first_sequence <= lower.sequence <= each.last_sequence
                if is_matched and isinstance(lower.event, SituationDetected) and lower.event.situation not in seen:
                    _want_lineage(log, selection, lower, seen)
                    _want_rule(log, selection, lower.event)


def _want_origin(log: Log, selection: Selection, wanted: Wanted) -> None:
    """Want the processes that said these events, and the videos that they worked on."""
    producers, positions = _producers(log, wanted)
    started = [
        found
        for found in _all(log, StreamName(wanted.stream.station, wanted.stream.source, ProcessStarted.type_name))
        if isinstance(found.event, ProcessStarted)
        and (found.event.extractor, found.event.extractor_version) in producers
        and found.segment.position <= positions[1]
    ]
    # Of the processes before the first event only the last can have said it.
    before = [each for each in started if each.segment.position <= positions[0]][-1:]
    for process in [*before, *(each for each in started if each.segment.position > positions[0])]:
        selection.want_event(process, "process")
        _want_video(log, selection, process)


def _producers(log: Log, wanted: Wanted) -> tuple[set[tuple[str, str]], tuple[int, int]]:
    """Name and version of who said the events, and the positions of the first and the last segment."""
    producers, positions = set(), []
    for segment in log.read(wanted.stream, wanted.ranges[0][0], epoch=wanted.epoch, with_hollow=True):
        if segment.header.first_sequence > wanted.ranges[-1][1]:
            break
        producers.add((segment.header.producer.name, segment.header.producer.version))
        positions.append(segment.position)
    return producers, (min(positions, default=0), max(positions, default=0))


def _want_video(log: Log, selection: Selection, process: Found) -> None:
    assert isinstance(process.event, ProcessStarted), "it was looked for"
    stream = process.segment.stream
    for found in _all(log, StreamName(stream.station, stream.source, VideoAdded.type_name)):
        if isinstance(found.event, VideoAdded) and found.event.video == process.event.video:
            selection.want_event(found, "video")
            said = {"source": stream.source, "process": process.event.process, **_said(found.event)}
            if said not in selection.videos:
                selection.videos.append(said)
            return
    selection.missing.append(f"video_added of {process.event.video} on {stream.source}")


def _want_rule(log: Log, selection: Selection, situation: SituationDetected) -> None:
    for segment in log.read_all(types=[RuleDeployed.type_name]):
        for found in _events(log, segment):
            event = found.event
            if isinstance(event, RuleDeployed) and (event.rule, event.rule_version, event.rule_hash) == (
                situation.rule,
                situation.rule_version,
                situation.rule_hash,
            ):
                selection.want_event(found, "rule")
                selection.rule = {"stream": str(segment.stream), "sequence": found.sequence, **_said(event)}
                return
    selection.missing.append(f"rule_deployed of {situation.rule} version {situation.rule_version}")


def _all(log: Log, stream: StreamName) -> Iterator[Found]:
    for segment in log.read_lives(stream):
        yield from _events(log, segment)


def _events(log: Log, segment: Segment) -> Iterator[Found]:
    for number, event in enumerate(events_of(decode(segment, log.catalogue))):
        yield Found(event, segment.header.first_sequence + number, segment)


def _lives(log: Log, stream: StreamName, epoch: int | None) -> list[StreamHead]:
    """The heads of a stream's lives, or of one of them."""
    lives = log.lives(stream)
    if not lives:
        known = ", ".join(sorted({str(head.stream) for head in log.streams()})) or "none yet"
        raise WrongUsage(f"there is no stream {stream}; known: {known}")
    chosen = [life for life in lives if epoch in (None, life.epoch)]
    if not chosen:
        raise WrongUsage(f"{stream} has no events of epoch {epoch}; it has {_told(lives)}")
    return chosen


def _told(lives: Sequence[StreamHead]) -> str:
    """What there is of a stream, for people."""
    if len(lives) == 1:
        return f"sequences 1 to {lives[0].sequence}"
    return ", ".join(f"epoch {life.epoch} with sequences 1 to {life.sequence}" for life in lives)


def epoch_of(log: Log, stream: StreamName, situation: Segment, last_sequence: int) -> int:
    """Which life of a stream a situation speaks of: the newest that held so many events when it was recorded.

    Its own station's lives are none that began after the situation's.
    """
    is_own = stream.station == situation.stream.station
    lives = [life.epoch for life in log.lives(stream) if not is_own or life.epoch <= situation.header.epoch]
    at = situation.position
    held = [each for each in lives if log.stream_head(stream, epoch=each, at_position=at).sequence >= last_sequence]
    return max(held or lives, default=situation.header.epoch)


def _merged(ranges: list[tuple[int, int]]) -> tuple[tuple[int, int], ...]:
    """The ranges in order, those that touch as one."""
    merged: list[tuple[int, int]] = []
    for first, last in sorted(ranges):
        if merged and first <= merged[-1][1] + 1:
            merged[-1] = (merged[-1][0], max(last, merged[-1][1]))
        else:
            merged.append((first, last))
    return tuple(merged)


def _said(event: EventType) -> dict[str, Any]:
    """The event as the manifest says it, JSON inside it laid open."""
    said: dict[str, Any] = event.model_dump(mode="json")
    return said | {name: json.loads(said[name]) for name in ("partition", "measures") if name in said}


def _plain(bound: int | datetime | None) -> int | str | None:
    return bound.isoformat() if isinstance(bound, datetime) else bound
