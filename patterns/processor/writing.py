"""Situations as events: what a match says in the log.

Pure: the same match is the same event, whether it was found online or in a backtest.
"""

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

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
    schema_of,
)
from patterns.engine.running import SITUATIONS_SOURCE
from patterns.engine.situations import Match
from patterns.files.rule import Rule

SOURCE = SITUATIONS_SOURCE
"""Source of deployments, and of situations of a rule that is not partitioned by source."""
SITUATIONS_TOGETHER = 5_000
"""Most situations of one segment: with their lineage they take a kilobyte each, or more."""


def producer_of(rule: Rule) -> Producer:
    """Who says what the rule finds."""
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(rule.hash))


def drafts_of(rule: Rule, station: str, matches: Sequence[Match], *, is_shadow: bool = False) -> list[Draft]:
    """The matches as situations to append: for each source one draft, or more where there are many, in order."""
    event_type = SituationShadowed if is_shadow else SituationDetected
    by_source: dict[str, list[Match]] = {}
    for match in matches:
        by_source.setdefault(str(match.partition.get("source") or SOURCE), []).append(match)
    return [
        encode(StreamName.of(station, source, event_type.type_name), _batch(event_type, few), _producer(rule, few[0]))
        for source, own in by_source.items()
        for few in _pages(own)
    ]


def _pages(matches: list[Match]) -> Iterator[list[Match]]:
    for begin in range(0, len(matches), SITUATIONS_TOGETHER):
        yield matches[begin : begin + SITUATIONS_TOGETHER]


def _batch(event_type: type[EventType], matches: Sequence[Match]) -> EventBatch:
    """The events that say the matches: by column, because models are dear where there are many."""
    rows = [_fields(match) for match in matches]
    columns = [pa.array([row[field.name] for row in rows], field.type) for field in schema_of(event_type)]
    return EventBatch(event_type, pa.RecordBatch.from_arrays(columns, schema=schema_of(event_type)))


def _producer(rule: Rule, match: Match) -> Producer:
    """The same as `producer_of`, by the hash that the match carries: a rule's own takes milliseconds to make."""
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(match.rule_hash))


def situation_of(match: Match) -> SituationDetected:
    """The event that says the match."""
    return SituationDetected(**_fields(match))


def shadow_of(match: Match) -> SituationShadowed:
    """The event that says the match of a rule in shadow."""
    return SituationShadowed(**_fields(match))


def json_of(values: Mapping[str, Any]) -> str:
    """JSON of partition columns or measures: times in ISO 8601, durations in seconds, NaN as null."""
    try:
        return _JSON.encode(dict(values))
    except ValueError:
        return _JSON.encode(_finite(dict(values)))


def _fields(match: Match) -> dict[str, Any]:
    return {
        "time": match.decided_at or match.last.time,
        "situation": match.situation_id,
        "rule": match.rule,
        "rule_version": match.version,
        "rule_hash": match.rule_hash,
        "severity": match.severity,
        "title": match.title,
        "partition": json_of(match.partition),
        "measures": json_of(match.measures),
        "began_at": match.first.time,
        "ended_at": match.last.time,
        "lineage": tuple(
            {
                "variable": variable,
                "stream": each.stream,
                "first_sequence": each.first_sequence,
                "last_sequence": each.last_sequence,
                "events": each.rows,
            }
            for variable, ranges in (*match.lineage.items(), *match.judged_by.items())
            for each in ranges
        ),
    }


def _finite(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, dict):
        return {name: _finite(each) for name, each in value.items()}
    return [_finite(each) for each in value] if isinstance(value, list | tuple) else value


def _plain(value: Any) -> Any:
    if isinstance(value, datetime):
        return value.isoformat()
    assert isinstance(value, timedelta), f"rules have no values of {type(value)}"
    return value.total_seconds()


_JSON = json.JSONEncoder(default=_plain, ensure_ascii=False, allow_nan=False)
