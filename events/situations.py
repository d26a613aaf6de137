"""Situations: what the rules found, and which rules stood when."""

from typing import Annotated, Literal

from pydantic import Field

from events.model import AtDoor, EventType, JsonText, Part, UtcTime


class MatchedRange(Part):
    """Events of one stream that one pattern variable matched, one after the other in the match's partition.

    Between the two sequences lie events of other partitions too; `events` says how many are the match's.
    """

    variable: str
    """pattern variable"""
    stream: str
    """stream as station/source/type"""
    first_sequence: Annotated[int, AtDoor(1)]
    """first sequence, inclusive"""
    last_sequence: Annotated[int, AtDoor(1)]
    """last sequence, inclusive"""
    events: Annotated[int, AtDoor(1)]
    """number of events in the range that are of the match's partition"""


class SituationDetected(EventType, type="situation_detected", version=1, subject="rule"):
    """A rule's pattern matched; its time is that of the event that decided the match."""

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


class RuleDeployed(EventType, type="rule_deployed", version=1, subject="rule"):
    """A version of a rule was put into service."""

    rule: str
    """name of the rule"""
    rule_version: Annotated[int, Field(ge=1)]
    """version of the rule"""
    rule_hash: str
    """SHA-256 of the rule's canonical form, in hexadecimal"""
    text: str
    """the rule file, whole"""
