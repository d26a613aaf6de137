"""What a situation rests on, read back from the log: its rows by variable, its rule, who said the rows.

Contract: reads both tiers of the log and changes nothing. What cannot be found is listed, never left out
silently.
"""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import pyarrow as pa

from events import (
    MatchedRange,
    RuleDeployed,
    Segment,
    SituationDetected,
    SituationShadowed,
    StreamName,
    UnknownType,
    decode,
    events_of,
    with_envelope,
)
from patterns.binding.binder import bind
from patterns.binding.bound import BoundRule
from patterns.binding.inputs import rows_of
from patterns.binding.rows import SEQUENCE, StreamNumbers
from patterns.engine.situations import as_python
from patterns.errors import PatternError
from patterns.files.loading import parse_rule
from patterns.files.rule import Rule
from patterns.processor import readable_by
from patterns.scene.places import Places
from patterns.scene.site import SITE_TYPES, Site
from store import Log
from vian.errors import WrongUsage
from vian.evidence.selection import SITUATION_MIN, epoch_of

Said = SituationDetected | SituationShadowed
Row = dict[str, Any]
"""An event's columns by name, with the envelope."""


@dataclass(frozen=True, slots=True)
class Matched:
    """The rows of one range of the lineage.

    Attributes:
        variable: The pattern variable, or what drew a place: `zone:NAME`, `line:NAME`, `calibration`.
        stream: The rows' stream.
        rows: The rows in order.
        producers: Who said them, with version.
    """

    variable: str
    stream: str
    rows: list[Row]
    producers: list[str]

    @property
    def is_place(self) -> bool:
        """Whether it says what rows were judged by, and took no row of the pattern."""
        return self.variable == "calibration" or ":" in self.variable


@dataclass(slots=True)
class Explained:
    """All that a situation rests on.

    Attributes:
        event: The situation.
        place: Where it stands: stream/sequence.
        position: Its position in the log.
        rule: The rule that found it; None: the log does not have it.
        text: The rule file, whole; None likewise.
        matched: Its rows, range by range, in order of time.
        site: What the log had said of the cameras by then.
        missing: What could not be found, a sentence each.
    """

    event: Said
    place: str
    position: int
    rule: Rule | None = None
    text: str | None = None
    matched: list[Matched] = field(default_factory=list)
    site: Site = field(default_factory=Site)
    missing: list[str] = field(default_factory=list)

    @property
    def is_shadow(self) -> bool:
        """Whether the rule ran in shadow, and nobody was alerted."""
        return isinstance(self.event, SituationShadowed)


def explained(log: Log, identity: str) -> Explained:
    """The situation of this identity, or of the only one that begins so.

    Raises:
        WrongUsage: There is no such situation, or several begin so.
    """
    event, segment, sequence = _situation(log, identity)
    found = Explained(event, f"{segment.stream}/{sequence}", segment.position)
    _read_rule(log, found)
    found.site = _site(log, segment.position)
    bound = _bound(log, found)
    found.matched = [_matched(log, each, segment, bound, found) for each in event.lineage]
    return found


def _situation(log: Log, identity: str) -> tuple[Said, Segment, int]:
    if len(identity) < SITUATION_MIN:
        raise WrongUsage(
            f"a situation is named by its identity, or its first {SITUATION_MIN} characters or more; got {identity!r}"
        )
    types = [SituationDetected.type_name, SituationShadowed.type_name]
    hits = [hit for segment in log.read_all(types=types) for hit in _said(log, segment, identity)]
    if len(hits) != 1:
        what = "no situation begins" if not hits else f"{len(hits)} situations begin"
        raise WrongUsage(
            f"{what} with {identity!r}. Next: vian tail --type situation_detected, and give more of the field situation"
        )
    return hits[0]


def _said(log: Log, segment: Segment, identity: str) -> Iterator[tuple[Said, Segment, int]]:
    for sequence, event in enumerate(events_of(decode(segment, log.catalogue)), segment.header.first_sequence):
        if isinstance(event, SituationDetected | SituationShadowed) and event.situation.startswith(identity):
            yield event, segment, sequence


def _read_rule(log: Log, found: Explained) -> None:
    """Notes the rule as it was deployed; its text is kept even if this program no longer understands it."""
    wanted = (found.event.rule, found.event.rule_version, found.event.rule_hash)
    for segment in log.read_all(types=[RuleDeployed.type_name]):
        for event in events_of(decode(segment, log.catalogue)):
            if isinstance(event, RuleDeployed) and (event.rule, event.rule_version, event.rule_hash) == wanted:
                found.text = event.text
    if found.text is None:
        found.missing.append(f"rule {wanted[0]} version {wanted[1]}: no rule_deployed of it is in this log")
        return
    try:
        found.rule = parse_rule(found.text, f"{wanted[0]}@{wanted[1]}")
    except PatternError as error:
        found.missing.append(f"rule {wanted[0]} version {wanted[1]} cannot be read any more: {error}")


def _bound(log: Log, found: Explained) -> BoundRule | None:
    if found.rule is None:
        return None
    try:
        return bind(found.rule, readable_by(log, found.rule))
    except PatternError as error:
        found.missing.append(f"rule {found.rule.rule} does not fit this log any more: {error}")
        return None


def _site(log: Log, position: int) -> Site:
    """What the log had said of the cameras up to a position."""
    site = Site()
    types = [str(each.type_name) for each in SITE_TYPES]
    for segment in log.read_all(types=types, to_position=position):
        try:
            for sequence, event in enumerate(events_of(decode(segment, log.catalogue)), segment.header.first_sequence):
                site.learn(event, str(segment.stream), sequence, epoch=segment.header.epoch)
        except (UnknownType, PatternError):
            continue  # what no rule could be judged by
    return site


def _matched(log: Log, wanted: MatchedRange, situation: Segment, bound: BoundRule | None, found: Explained) -> Matched:
    """The rows of a range, those of the match's partition only."""
    stream = StreamName.parse(wanted.stream)
    producers: dict[str, None] = {}
    rows: list[Row] = []
    for segment in log.read(
        stream, wanted.first_sequence, epoch=epoch_of(log, stream, situation, wanted.last_sequence)
    ):
        if segment.header.first_sequence > wanted.last_sequence:
            break
        producer = segment.header.producer
        producers.setdefault(
            f"{producer.name} {producer.version}, configuration {producer.configuration_hash.hex()[:12]}"
        )
        rows += _rows(log, segment, wanted)
    matched = Matched(wanted.variable, wanted.stream, rows, list(producers))
    if not matched.is_place:
        rows[:] = _own(rows, json.loads(found.event.partition), bound, found.site)
    if len(rows) != wanted.events:
        found.missing.append(
            f"{wanted.variable}: {wanted.stream} {wanted.first_sequence} to {wanted.last_sequence} has "
            f"{len(rows)} rows of the partition, the situation says {wanted.events}"
        )
    return matched


def _rows(log: Log, segment: Segment, wanted: MatchedRange) -> list[Row]:
    try:
        batch = decode(segment, log.catalogue)
    except UnknownType:
        return []
    first = segment.header.first_sequence
    rows = with_envelope(segment.stream, first, batch)
    begin = max(wanted.first_sequence - first, 0)
    return list(rows.slice(begin, wanted.last_sequence - first - begin + 1).to_pylist())


def _own(rows: list[Row], partition: Mapping[str, Any], bound: BoundRule | None, site: Site) -> list[Row]:
    """The rows of the partition that the rule reads; without the rule, those with the partition's columns."""
    if bound is None or not rows:
        return [row for row in rows if all(_plain(row.get(name)) == value for name, value in partition.items())]
    places = Places(bound.rule.zones, bound.rule.lines, site)
    read = rows_of(bound.inputs, pa.Table.from_pylist(rows), StreamNumbers(), places)
    if read is None:
        return []
    own = {
        row[SEQUENCE]
        for row in read.select([SEQUENCE, *bound.keys]).to_pylist()
        if all(_plain(as_python(row[name], bound.columns[name])) == partition.get(name) for name in bound.keys)
    }
    return [row for row in rows if row["sequence"] in own]


def _plain(value: Any) -> Any:
    """The value as a situation's JSON has it."""
    if isinstance(value, datetime):
        return value.isoformat()
    return value.total_seconds() if isinstance(value, timedelta) else value
