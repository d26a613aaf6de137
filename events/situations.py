"""Situations: what the rules found, and which rules stood when."""

from typing import Annotated, Literal

import pyarrow as pa
from pydantic import BaseModel, ConfigDict, Field

from events.columns import schema_of
from events.model import AtDoor, EventType, JsonText, Part, UtcTime


class MatchedRange(Part):
    """Events of one stream that one pattern variable matched, one after the other in the match's partition.

    Between the two sequences lie events of other partitions too; `events` says how many are the match's.
    """

    variable: str
    """pattern variable; `zone:NAME`, `line:NAME` or `calibration` for events that say what rows were judged by"""
    stream: str
    """stream as station/source/type"""
    first_sequence: Annotated[int, AtDoor(1)]
    """first sequence, inclusive"""
    last_sequence: Annotated[int, AtDoor(1)]
    """last sequence, inclusive"""
    events: Annotated[int, AtDoor(1)]
    """number of events in the range that are of the match's partition"""


class _Situation(BaseModel):
    """What every situation says, whether it alerts somebody or not."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    situation: str
    """identity: hash of rule, version, partition, first and last event, in hexadecimal"""
    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    rule_hash: str
    """SHA-256 of the rule's canonical form, in hexadecimal"""
    severity: Literal["info", "warning", "alarm"]
    """severity that the rule gives"""
    title: str
    """title for people, filled in"""
    partition: JsonText
    """values of the PARTITION BY columns by name"""
    measures: JsonText
    """values of the MEASURES by name; times in ISO 8601"""
    began_at: UtcTime
    """time of the first matched event (UTC)"""
    ended_at: UtcTime
    """time of the last matched event (UTC)"""
    lineage: tuple[MatchedRange, ...]
    """the events that the match rests on, by pattern variable"""


class SituationDetected(_Situation, EventType, type="situation_detected", version=1, subject="rule"):
    """A rule's pattern matched; its time is that of the event that decided the match."""


class SituationShadowed(_Situation, EventType, type="situation_shadowed", version=1, subject="rule"):
    """A rule that runs in shadow matched: what would have been its `situation_detected`. It alerts nobody."""


class RuleDeployedV1(EventType, type="rule_deployed", version=1, subject="rule"):
    """A version of a rule was put into service. Stored before version 2 came, and read as that."""

    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    rule_hash: str
    """SHA-256 of the rule's canonical form, in hexadecimal"""
    text: str
    """the rule file, whole"""


class RuleDeployed(EventType, type="rule_deployed", version=2, subject="rule", older=RuleDeployedV1):
    """A version of a rule was put into service, or back into it, from a place in the log on."""

    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    rule_hash: str
    """SHA-256 of the rule's canonical form, in hexadecimal"""
    text: str
    """the rule file, whole"""
    after_position: Annotated[int, AtDoor(0)] | None = 0
    """the rule sees the log behind this position; null: behind this very event"""
    is_shadow: bool = False
    """whether what it finds is recorded as `situation_shadowed`, which alerts nobody"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Events of version 1, whose rules saw the whole log and ran for all to see."""
        rows = older.num_rows
        began, is_shadow = pa.repeat(pa.scalar(0, pa.int64()), rows), pa.repeat(pa.scalar(False), rows)
        return pa.RecordBatch.from_arrays([*older.columns, began, is_shadow], schema=schema_of(cls))


class RuleRetired(EventType, type="rule_retired", version=1, subject="rule"):
    """A version of a rule was taken out of service; deploying it again brings it back."""

    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    why: Literal["told", "replaced", "failed", "too_slow"]
    """told: somebody said so; replaced: another version took over; failed: it raised; too_slow: over its budget"""
    open_matches: Literal["dropped", "finished"]
    """what becomes of matches that had begun: dropped at once, or still finished, while no new one begins"""
    reason: str
    """why, as told to the user; of a rule that failed, with the position where it did"""


class RuleMissed(EventType, type="rule_missed", version=1, subject="rule"):
    """A rule went on without something that it should have had: a sum since the last one, by kind and stream."""

    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    what: Literal["late_events", "future_events", "partial_matches"]
    """events behind the watermark, events far ahead of the log's own clock, or matches that had begun"""
    count: Annotated[int, AtDoor(1)]
    """how many"""
    stream: str | None
    """stream of the events, as station/source/type; null for partial matches"""
    first_sequence: Annotated[int, AtDoor(1)] | None
    """least sequence among the events, inclusive; null for partial matches"""
    last_sequence: Annotated[int, AtDoor(1)] | None
    """greatest sequence among the events, inclusive; null for partial matches"""
    began_at: UtcTime
    """time of the earliest that was missed (UTC)"""
    ended_at: UtcTime
    """time of the latest that was missed (UTC)"""
    partition: JsonText | None
    """partition columns of the first partial matches that were given up; null for events"""
    reason: str
    """why, and which setting decided it"""
