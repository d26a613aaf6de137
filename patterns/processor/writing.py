"""Situations as events: what a match says in the log.

Pure: the same match is the same event, whether it was found online or in a backtest.
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate, pairwise
from typing import TypeVar

import pyarrow as pa

from events import (
    Draft,
    EventBatch,
    EventType,
    Producer,
    SituationDetected,
    SituationShadowed,
    StreamName,
    encode,
    events_of,
)
from patterns.engine.running import SITUATIONS_SOURCE
from patterns.engine.situations import Match
from patterns.files.rule import Rule
from patterns.processor.situation_rows import situation_rows, together

S = TypeVar("S", bound=EventType)

SOURCE = SITUATIONS_SOURCE
"""Source of deployments, and of situations of a rule that is not partitioned by source."""
SITUATIONS_TOGETHER = 5_000
"""Most situations of one segment: with their lineage they take a kilobyte each, or more."""


def producer_of(rule: Rule) -> Producer:
    """Who says what the rule finds."""
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(rule.hash))


def drafts_of(rule: Rule, station: str, matches: Sequence[Match], *, is_shadow: bool = False) -> list[Draft]:
    """The matches as situations to append: for each source one draft, or more where there are many, in order."""
    (drafts,) = drafts_of_each(rule, station, [matches], is_shadow=is_shadow)
    return drafts


def drafts_of_each(
    rule: Rule, station: str, findings: Sequence[Sequence[Match]], *, is_shadow: bool = False
) -> list[list[Draft]]:
    """For each finding its matches as drafts, see `drafts_of`; what they say is made for all findings at once."""
    event_type = SituationShadowed if is_shadow else SituationDetected
    matches = [match for finding in findings for match in finding]
    if not matches:
        return [[] for _ in findings]
    rows, sources = situation_rows(event_type, matches), _sources(matches)
    producer = _producer(rule, matches[0])
    bounds = pairwise(accumulate(map(len, findings), initial=0))
    return [
        [
            encode(StreamName.of(station, source, event_type.type_name), EventBatch(event_type, few), producer)
            for source, few in _pages(rows.slice(begin, end - begin), sources[begin:end])
        ]
        for begin, end in bounds
    ]


def _sources(matches: Sequence[Match]) -> list[str]:
    """In whose streams the situations go."""
    found: list[str] = []
    for said, places in together(matches):
        own = said.partitions(places).get("source") or [None] * len(places)
        found += [str(source or SOURCE) for source in own]
    return found


def _pages(rows: pa.RecordBatch, sources: Sequence[str]) -> Iterator[tuple[str, pa.RecordBatch]]:
    """The rows by source, so many together at most."""
    by_source: dict[str, list[int]] = {}
    for at, source in enumerate(sources):
        by_source.setdefault(source, []).append(at)
    for source, own in by_source.items():
        of_source = rows if len(by_source) == 1 else rows.take(pa.array(own))
        for begin in range(0, len(own), SITUATIONS_TOGETHER):
            yield source, of_source.slice(begin, SITUATIONS_TOGETHER)


def _producer(rule: Rule, match: Match) -> Producer:
    """The same as `producer_of`, by the hash that the match carries: a rule's own takes milliseconds to make."""
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(match.rule_hash))


def situation_of(match: Match) -> SituationDetected:
    """The event that says the match."""
    return _event_of(SituationDetected, match)


def shadow_of(match: Match) -> SituationShadowed:
    """The event that says the match of a rule in shadow."""
    return _event_of(SituationShadowed, match)


def _event_of(event_type: type[S], match: Match) -> S:
    (event,) = events_of(EventBatch(event_type, situation_rows(event_type, [match])))
    assert isinstance(event, event_type), "a batch holds events of its type"
    return event
