"""Of which sources a rule asks for metres, and so for their calibration."""

from collections.abc import Iterable
from dataclasses import dataclass

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import Crosses, InZone, OnGround, walk


@dataclass(frozen=True, slots=True)
class Metres:
    """What of a rule is in metres.

    Attributes:
        of_any: Whether metres are asked of every source's rows, by ground_x and alike.
        sources: The sources of its own zones and lines in metres.
        shared: Names of shared zones and lines that it asks for, which may be in metres.
    """

    of_any: bool
    sources: frozenset[str]
    shared: frozenset[str]

    @property
    def is_asked(self) -> bool:
        """Whether metres may be asked of any source."""
        return self.of_any or bool(self.sources) or bool(self.shared)

    def asks(self, source: str, in_metres: Iterable[str]) -> bool:
        """Whether metres are asked of the source's rows, which has shared zones and lines of these names in metres."""
        return self.of_any or source in self.sources or not self.shared.isdisjoint(in_metres)


def metres_of(bound: BoundRule) -> Metres:
    """What of the rule is in metres."""
    rule = bound.rule
    guards = tuple(each.guard for each in bound.conditions if each.guard is not None)
    read = (part for each in bound.inputs for part in (*each.projected.values(), each.where) if part is not None)
    values = tuple(each.value for each in (*bound.measures, *bound.title_columns))
    parts = [part for expr in (*bound.predicates, *guards, *read, *values) for part in walk(expr)]
    names = {each.zone for each in parts if isinstance(each, InZone)}
    names |= {each.line for each in parts if isinstance(each, Crosses)}
    own = {name: shape for name, shape in (*rule.zones.items(), *rule.lines.items()) if name in names}
    return Metres(
        of_any=any(isinstance(each, OnGround) for each in parts),
        sources=frozenset(shape.source for shape in own.values() if shape.units == "metres"),
        shared=frozenset(names & set(rule.shared)),
    )
