"""Rules that find what another rule finds: by what they read, their patterns and their conditions.

Sound, not complete: two rules are named only if every run of rows that the one takes, the other can
take too. Which of several runs a rule prefers, and what it skips, is not looked at.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from typing import Any, Literal

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Crosses, Expr, InZone, conjuncts
from patterns.scene.places import Places

Relation = Literal["same", "part"]


@dataclass(frozen=True, slots=True)
class Overlap:
    """How two rules overlap: they take the `same` runs of rows, or those of the first are a `part`."""

    narrow: BoundRule
    wide: BoundRule
    relation: Relation


def overlaps(bounds: Sequence[BoundRule]) -> list[Overlap]:
    """The pairs that overlap, in the order of the rules; versions of one rule are not compared."""
    shapes = [_Shape.of(bound) for bound in bounds]
    found = []
    for index, (bound, shape) in enumerate(zip(bounds, shapes, strict=True)):
        for other, other_shape in zip(bounds[index + 1 :], shapes[index + 1 :], strict=True):
            if bound.rule.rule == other.rule.rule or shape.frame != other_shape.frame:
                continue
            is_part, is_whole = shape.is_part_of(other_shape), other_shape.is_part_of(shape)
            if is_part and is_whole:
                found.append(Overlap(other, bound, "same"))
            elif is_part or is_whole:
                narrow, wide = (bound, other) if is_part else (other, bound)
                found.append(Overlap(narrow, wide, "part"))
    return found


@dataclass(frozen=True, slots=True)
class _Shape:
    """A rule without its names.

    Attributes:
        frame: What must be equal: input, partition, order of the pattern.
        conditions: For each variable, in the order of the pattern, the parts that must all be true.
        within_us: WITHIN.
    """

    frame: Any
    conditions: tuple[frozenset[Any], ...]
    within_us: int | None

    @classmethod
    def of(cls, bound: BoundRule) -> "_Shape":
        numbers = {name: index for index, name in enumerate(bound.variables)}
        places = Places(bound.rule.zones, bound.rule.lines, bound.site)

        def plain(value: Any) -> Any:
            return _plain(value, numbers, bound, places)

        conditions = []
        for each in bound.conditions:
            parts: list[Expr] = [bound.predicates[index] for index in each.predicates]
            parts += conjuncts(each.guard) if each.guard is not None else ()
            conditions.append(frozenset((plain(part), each.is_timed) for part in parts))
        # Of a plain input a column means the same in both rules, whichever of them reads it.
        inputs = tuple(
            (
                each.type,
                each.situation_of,
                plain(each.where),
                not each.is_plain and plain(tuple(each.projected.items())),
            )
            for each in bound.inputs
        )
        tables = bound.tables
        frame = (inputs, bound.keys, tables.variables, tables.follow, tables.accepts, tables.accepts_end)
        return cls(frame, tuple(conditions), bound.within_us)

    def is_part_of(self, other: "_Shape") -> bool:
        """Whether whatever meets this shape's conditions meets the other's."""
        is_shorter = other.within_us is None or (self.within_us is not None and self.within_us <= other.within_us)
        return is_shorter and all(
            theirs <= ours for ours, theirs in zip(self.conditions, other.conditions, strict=True)
        )


def _plain(value: Any, numbers: dict[str, int], bound: BoundRule, places: Places) -> Any:
    """The expression as nested tuples in which variables are numbers, and zones and lines are what they are."""
    if isinstance(value, InZone) and value.zone in bound.rule.zones:
        drawn = tuple(each.model_dump_json() for each in places.zones_named(value.zone))
        return ("InZone", drawn, tuple(_plain(part, numbers, bound, places) for part in value.operands))
    if isinstance(value, Crosses) and value.line in bound.rule.lines:
        drawn = tuple(each.model_dump_json() for each in places.lines_named(value.line))
        operands = tuple(_plain(part, numbers, bound, places) for part in value.operands)
        return ("Crosses", drawn, value.direction, operands)
    if is_dataclass(value) and not isinstance(value, type):
        inner = tuple(
            tuple(sorted(numbers[name] for name in each))
            if (each := getattr(value, item.name)) is not None and item.name == "variables"
            else _plain(each, numbers, bound, places)
            for item in fields(value)
        )
        return (type(value).__name__, *inner)
    if isinstance(value, tuple):
        return tuple(_plain(each, numbers, bound, places) for each in value)
    return value.name if isinstance(value, Enum) else value
