"""Situations as events: what a match says in the log.

Pure: the same match is the same event, whether it was found online or in a backtest.
"""

import json
import math
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from typing import Any

from events import Draft, MatchedRange, Producer, SituationDetected, SituationShadowed, StreamName, batch_of, encode
from patterns.rule import Rule
from patterns.running import SITUATIONS_SOURCE
from patterns.situations import Match

SOURCE = SITUATIONS_SOURCE
"""Source of deployments, and of situations of a rule that is not partitioned by source."""


def producer_of(rule: Rule) -> Producer:
    """Who says what the rule finds."""
    return Producer(f"rule/{rule.rule}", str(rule.version), bytes.fromhex(rule.hash))


def drafts_of(rule: Rule, station: str, matches: Sequence[Match], *, is_shadow: bool = False) -> list[Draft]:
    """The matches as situations to append: one draft for each source, in order."""
    event_type = SituationShadowed if is_shadow else SituationDetected
    by_source: dict[str, list[SituationDetected | SituationShadowed]] = {}
    for match in matches:
        said = shadow_of(match) if is_shadow else situation_of(match)
        by_source.setdefault(str(match.partition.get("source") or SOURCE), []).append(said)
    return [
        encode(StreamName.of(station, source, event_type.type_name), batch_of(events), _producer(rule, matches[0]))
        for source, events in by_source.items()
    ]


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
    return json.dumps(_finite(dict(values)), default=_plain, ensure_ascii=False, allow_nan=False)


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
            MatchedRange(
                variable=variable,
                stream=each.stream,
                first_sequence=each.first_sequence,
                last_sequence=each.last_sequence,
                events=each.rows,
            )
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
