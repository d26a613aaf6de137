"""What a match says: its measures, its title, where each of its rows came from, and its identity."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import chain
from typing import Any

from patterns.bound import BoundRule, Output
from patterns.durations import MICROSECOND
from patterns.errors import MatchError
from patterns.expressions import Crosses, InZone, Kind, OnGround, walk
from patterns.geometry import Line, Zone
from patterns.guards import Guard, compile_guard
from patterns.matcher import Event, Found, runs
from patterns.places import Places
from patterns.site import CALIBRATION
from patterns.titles import Scalar, filled_title

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_EARLIEST = datetime(1, 1, 1, tzinfo=UTC)
_LATEST = datetime(9999, 12, 31, 23, 59, 59, 999_999, tzinfo=UTC)
_EARLIEST_US, _LATEST_US = ((each - _EPOCH) // MICROSECOND for each in (_EARLIEST, _LATEST))
_ENCODER = json.JSONEncoder(separators=(",", ":"), ensure_ascii=False)


@dataclass(frozen=True, slots=True)
class EventRef:
    """One event: its stream (`station/source/type`), its sequence there, and when it happened."""

    stream: str
    sequence: int
    time: datetime


@dataclass(frozen=True, slots=True)
class EventRange:
    """Rows that follow each other in the match's partition and are of one stream.

    They are the events of the partition between the two sequences; `rows` says how many.
    """

    stream: str
    first_sequence: int
    last_sequence: int
    rows: int


@dataclass(frozen=True, slots=True)
class Match:
    """One final match of a rule.

    Attributes:
        rule: The rule's name.
        version: The rule's version.
        rule_hash: The rule's hash.
        severity: The rule's severity.
        title: The rule's title, filled in.
        partition: The partition columns and their values.
        measures: The measures in their order.
        first: The event of its first row.
        last: The event of its last row.
        decided_at: The event time from which it was final: of the row that decided it, or of the
            end of its WITHIN; None: only the end of the input decided it.
        lineage: For each pattern variable that took rows, which.
        judged_by: The events that drew what its rows were judged by: for each shared zone or line, and
            for the calibration, under `zone:NAME`, `line:NAME` and `calibration`.
        situation_id: Its identity, see `situation_id`.
    """

    rule: str
    version: int
    rule_hash: str
    severity: str
    title: str
    partition: dict[str, Scalar]
    measures: dict[str, Scalar]
    first: EventRef
    last: EventRef
    decided_at: datetime | None
    lineage: dict[str, tuple[EventRange, ...]]
    judged_by: dict[str, tuple[EventRange, ...]]
    situation_id: str


def situation_id(rule: str, version: int, partition: Sequence[Any], first: EventRef, last: EventRef) -> str:
    """The identity of a situation: equal for the same match of the same rule version, wherever it is found.

    SHA-256, in hex, of the UTF-8 JSON array, without spaces,
    `["situation/1", rule, version, [partition values], [stream, sequence, time], [stream, sequence, time]]`
    with the first and the last event; times and durations are whole microseconds, since 1970 UTC.
    """
    events = [[event.stream, event.sequence, as_microseconds(event.time)] for event in (first, last)]
    content = ["situation/1", rule, version, [as_microseconds(value) for value in partition], *events]
    return hashlib.sha256(_ENCODER.encode(content).encode()).hexdigest()


class Narrator:
    """Makes matches of what the matcher found."""

    def __init__(self, bound: BoundRule, places: Places, stream_names: Sequence[str]) -> None:
        self.bound = bound
        self.site = places.site
        self.stream_names = stream_names
        self.drawn = _drawn_by_events(bound)
        self.rule_hash = bound.rule.hash
        self.keys = [(name, bound.columns[name]) for name in bound.keys]
        slots = {slot: index for index, slot in enumerate(bound.slots)}
        registers = dict(bound.register_of)
        self.values: list[tuple[Output, Guard]] = [
            (output, compile_guard(output.value, slots, registers, places))
            for output in (*bound.measures, *bound.title_columns)
        ]

    @property
    def needs_calibration(self) -> bool:
        """Whether the rule itself asks for metres."""
        return "calibration" in self.drawn

    def match(self, key: Sequence[Any], found: Found) -> Match:
        """The match as it leaves the engine."""
        bound = self.bound
        partition = {name: as_python(value, kind) for (name, kind), value in zip(self.keys, key, strict=True)}
        values = {
            output.name: as_python(value((), found.ending.registers), output.value.kind)
            for output, value in self.values
        }
        measures = {measure.name: values[measure.name] for measure in bound.measures}
        first, last = (event_ref(event, self.stream_names) for event in (found.first, found.ending.event))
        return Match(
            rule=bound.rule.rule,
            version=bound.rule.version,
            rule_hash=self.rule_hash,
            severity=bound.rule.severity,
            title=filled_title(bound.rule.title, {**values, **partition, **measures}),
            partition=partition,
            measures=measures,
            first=first,
            last=last,
            decided_at=None if found.decided_us is None else nearest_time(found.decided_us),
            lineage=self._lineage(found),
            judged_by=self._judged_by(found),
            situation_id=situation_id(bound.rule.rule, bound.rule.version, key, first, last),
        )

    def _lineage(self, found: Found) -> dict[str, tuple[EventRange, ...]]:
        ranges: dict[str, list[EventRange]] = {}
        for _, variable, stream, first, last, _, rows in runs(found.ending.trace):
            each = EventRange(self.stream_names[stream], first, last, rows)
            ranges.setdefault(self.bound.variables[variable], []).append(each)
        return {variable: tuple(each) for variable, each in ranges.items()}

    def _judged_by(self, found: Found) -> dict[str, tuple[EventRange, ...]]:
        if not self.drawn:
            return {}
        streams = {self.stream_names[stream] for _, _, stream, *_ in runs(found.ending.trace)}
        sources = {stream.split("/")[1] for stream in streams}
        first_us, last_us = found.first[2], found.ending.event[2]
        versions = {label: self.site.judged_by(name, sources, first_us, last_us) for label, name in self.drawn.items()}
        if any(
            isinstance(each.said, Zone | Line) and each.said.units == "metres" for each in chain(*versions.values())
        ):
            versions["calibration"] = self.site.judged_by(CALIBRATION, sources, first_us, last_us)
        return {
            label: tuple(EventRange(each.stream, each.sequence, each.sequence, 1) for each in found)
            for label, found in versions.items()
            if found
        }


def _drawn_by_events(bound: BoundRule) -> dict[str, str]:
    """What the rule uses that events draw, by the label that a situation gives it."""
    rule = bound.rule
    drawn: dict[str, str] = {}
    if any(each.units == "metres" for each in (*rule.zones.values(), *rule.lines.values())):
        drawn["calibration"] = CALIBRATION
    guards = tuple(each.guard for each in bound.conditions if each.guard is not None)
    read = (part for each in bound.inputs for part in (*each.projected.values(), each.where) if part is not None)
    values = tuple(each.value for each in (*bound.measures, *bound.title_columns))
    for part in (part for expr in (*bound.predicates, *guards, *read, *values) for part in walk(expr)):
        if isinstance(part, InZone) and part.zone in rule.shared:
            drawn[f"zone:{part.zone}"] = part.zone
        elif isinstance(part, Crosses) and part.line in rule.shared:
            drawn[f"line:{part.line}"] = part.line
        elif isinstance(part, OnGround):
            drawn["calibration"] = CALIBRATION
    return drawn


def event_ref(event: Event, stream_names: Sequence[str]) -> EventRef:
    """The event with its stream's name and its time."""
    stream, sequence, time_us = event
    return EventRef(stream_names[stream], sequence, _time(time_us))


def as_python(value: Any, kind: Kind) -> Scalar:
    """A value of the engine as Python has it: times and durations are no longer microseconds."""
    if value is None:
        return None
    if kind is Kind.TIME:
        return _time(value)
    plain: Scalar = timedelta(microseconds=value) if kind is Kind.DURATION else value
    return plain


def nearest_time(microseconds: int) -> datetime:
    """The time, or the first or last that there is: for bounds, such as the end of a WITHIN."""
    return _EPOCH + timedelta(microseconds=min(max(microseconds, _EARLIEST_US), _LATEST_US))


def _time(microseconds: int) -> datetime:
    try:
        return _EPOCH + timedelta(microseconds=microseconds)
    except OverflowError as error:
        raise MatchError(f"a time must lie in the years 1 to 9999, got {microseconds} us since 1970") from error


def as_microseconds(value: Scalar) -> bool | int | float | str | None:
    """The value with times and durations as whole microseconds again: what identities are made of."""
    if isinstance(value, datetime):
        since = value - _EPOCH
        return (since.days * 86_400 + since.seconds) * 1_000_000 + since.microseconds
    return value // MICROSECOND if isinstance(value, timedelta) else value
