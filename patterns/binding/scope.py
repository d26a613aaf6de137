"""What names mean where an expression stands."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from typing import Any

from patterns.binding.expressions import Const, Kind
from patterns.binding.typing_rules import TypeMismatch
from patterns.durations import microseconds
from patterns.language.text import Passage
from patterns.scene.quantities import Quantity


@dataclass(frozen=True, slots=True)
class Scope:
    """What names mean where an expression stands.

    Attributes:
        passage: The SQL, for errors.
        clause: The clause, for errors.
        columns: The event type's columns that the language can read.
        unreadable: Its other columns, and the Arrow type that keeps them from being read.
        variables: Pattern variables: compared name to shown name.
        frames: For each variable and each SUBSET the shown names of the variables that it means.
        own: The variable that DEFINE is defining.
        has_row: Whether there is a row at hand (DEFINE, WHERE) or a finished match (MEASURES).
        params: The rule's parameters.
        zones: Names of the rule's own zones.
        lines: Names of the rule's own lines.
        shared: Names of the shared zones and lines that the rule uses.
    """

    passage: Passage
    clause: str
    columns: Mapping[str, Kind]
    unreadable: Mapping[str, str]
    variables: Mapping[str, str]
    frames: Mapping[str, tuple[str, ...]]
    own: str | None
    has_row: bool
    params: Mapping[str, Any]
    zones: frozenset[str]
    lines: frozenset[str]
    shared: frozenset[str]

    @property
    def has_match(self) -> bool:
        """Whether there is a match to look at."""
        return self.clause in ("DEFINE", "MEASURES")


def constant(value: Any) -> Const:
    """A parameter's value as a constant.

    Raises:
        TypeMismatch: An integer, or a duration in microseconds, beyond 64 bits.
    """
    if isinstance(value, timedelta):
        if not _fits(microseconds(value)):
            raise TypeMismatch(f"a duration is below 2^63 microseconds (106751991 d), got {value.days} d")
        return Const(microseconds(value), Kind.DURATION)
    if isinstance(value, Quantity):
        return Const(value.value, Kind.FLOAT)
    if isinstance(value, int) and not _fits(value):
        raise TypeMismatch(f"an integer is at least -2^63 and below 2^63, got {value}")
    kinds = {bool: Kind.BOOL, int: Kind.INT, float: Kind.FLOAT, str: Kind.STRING}
    return Const(value, kinds[type(value)])


def _fits(value: int) -> bool:
    return -(2**63) <= value < 2**63
