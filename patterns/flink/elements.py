"""A pattern as a row of elements, the only form that Flink has, and where Flink's answer is the standard's.

Flink keeps every way in which rows can be taken, and puts out the one that completes first; a greedy loop
never hands over a row that it could take itself. The standard prefers by the pattern, and goes back. Both agree
where at each row at most one way is open, and where the only choice is how often the last open loop, a
reluctant one, repeats: fewest repetitions complete first.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from patterns.binding.expressions import Call, Column, Const, Expr, Kind, Reference, is_row_local
from patterns.flink.exclusive import exclude_each_other
from patterns.flink.refusing import Refuse
from patterns.language.syntax import Concatenation, Pattern, Repetition, Variable


@dataclass(frozen=True, slots=True)
class Element:
    """One variable and how often it repeats; `most` None: any number of times."""

    variable: str
    least: int
    most: int | None
    is_greedy: bool
    at: int

    @property
    def is_fixed(self) -> bool:
        """Whether it always takes the same number of rows."""
        return self.least == self.most

    @property
    def text(self) -> str:
        """The quantifier as Flink writes it."""
        if self.is_fixed:
            return "" if self.least == 1 else f"{{{self.least}}}"
        if self.most is None:
            written = ("*", "+")[self.least] if self.least < 2 else f"{{{self.least},}}"
        else:
            written = "?" if (self.least, self.most) == (0, 1) else f"{{{self.least},{self.most}}}"
        return written if self.is_greedy else f"{written}?"


@dataclass(frozen=True, slots=True)
class Elements:
    """The pattern's elements in order; variables are distinct."""

    parts: tuple[Element, ...]

    def index(self, variable: str) -> int:
        """Which element the variable is."""
        return next(at for at, part in enumerate(self.parts) if part.variable == variable)

    def is_sure(self, variable: str, before: str | None) -> bool:
        """Whether the variable has a row when a row is looked at for `before`; None: when the match is complete."""
        at = self.index(variable)
        if variable == before:
            return True
        is_past = before is None or at < self.index(before)
        return is_past and self.parts[at].least > 0

    def least_rows_before(self, variable: str) -> int:
        """How many rows at least stand before a row of the variable, in the match."""
        return sum(part.least for part in self.parts[: self.index(variable)])

    def only_place(self, variable: str) -> int | None:
        """How many rows always stand before the variable's only row; None if that varies."""
        at = self.index(variable)
        own = self.parts[at]
        if (own.least, own.most) != (1, 1) or not all(part.is_fixed for part in self.parts[:at]):
            return None
        return self.least_rows_before(variable)

    def is_last(self, variable: str) -> bool:
        """Whether the match's last row is always the variable's last row."""
        return self.parts[-1].variable == variable and self.parts[-1].least > 0

    @property
    def least_rows(self) -> int:
        """How many rows the shortest match has."""
        return sum(part.least for part in self.parts)

    @property
    def is_fixed(self) -> bool:
        """Whether all matches have the same number of rows."""
        return all(part.is_fixed for part in self.parts)


def elements_of(pattern: Pattern, shown: Mapping[str, str]) -> Elements:
    """The elements of a pattern in which `patterns.flink.portable` finds nothing to refuse.

    Args:
        pattern: The tree of PATTERN.
        shown: The variables' names by the key that they are compared by.
    """
    return Elements(tuple(_flat(pattern, shown)))


def check_decided(elements: Elements, conditions: Mapping[str, Sequence[Expr]], refuse: Refuse) -> None:
    """Refuses a pattern for which Flink's answer may differ from the standard's.

    Args:
        elements: The pattern.
        conditions: For each variable the conditions that must all hold.
        refuse: Raises.
    """
    parts = elements.parts
    for at, part in enumerate(parts):
        if part.is_fixed:
            continue
        followers, is_ending = _followers(parts, at)
        if is_ending and part.is_greedy:
            refuse("greedy last variable", part.at)
        varying = next((each for each in parts[at + 1 :] if not each.is_fixed), None)
        for follower in followers:
            variables = {part.variable, follower.variable}
            if exclude_each_other(conditions[part.variable], conditions[follower.variable], variables):
                continue
            both = f"; here it may fit {part.variable} and {follower.variable}"
            if part.is_greedy:
                refuse("greedy variable with an open end", part.at, both)
            if varying is not None:
                refuse("two variables with open ends", part.at, f"{both}, and {varying.variable} varies too")


def ends_in_order(elements: Elements, conditions: Mapping[str, Sequence[Expr]]) -> bool:
    """Whether matches end in the order in which they begin, so that none waits for one that began before it.

    So it is where all have one length, where none can begin while another is under way, and where the
    last row of one is the last row of every other under way: it asks only how long ago the first row was.
    """
    first, *others = elements.parts
    if elements.is_fixed:
        return True
    if (first.least, first.most) != (1, 1):
        return False
    if len(others) == 2 and others[0].most is None and (others[1].least, others[1].most) == (1, 1):
        ending = conditions[others[1].variable]
        if all(is_row_local(each) or _asks_how_long_ago(each, first.variable) for each in ending):
            return True
    return all(
        exclude_each_other(conditions[first.variable], conditions[other.variable], {first.variable, other.variable})
        for other in others
    )


def _asks_how_long_ago(expr: Expr, variable: str) -> bool:
    """Whether the condition is that the row comes a while after the variable's."""
    if not isinstance(expr, Call) or expr.op not in (">", ">=", "<", "<="):
        return False
    later, earlier = expr.operands if expr.op in (">", ">=") else expr.operands[::-1]
    if isinstance(later, Call) and later.op == "-" and isinstance(earlier, Const):
        later, earlier = later.operands
    if not (isinstance(earlier, Reference) and earlier.variables == (variable,) and not earlier.offset):
        return False
    moved = earlier.operand
    if isinstance(moved, Call) and moved.op in ("+", "-"):
        moved = next((part for part in moved.operands if not isinstance(part, Const)), moved)
    return later == moved == Column("time", Kind.TIME)


def _followers(parts: tuple[Element, ...], at: int) -> tuple[list[Element], bool]:
    """What may stand right after the element, and whether nothing may."""
    found = []
    for part in parts[at + 1 :]:
        found.append(part)
        if part.least > 0:
            return found, False
    return found, True


def _flat(pattern: Pattern, shown: Mapping[str, str]) -> Iterator[Element]:
    if isinstance(pattern, Variable):
        yield Element(shown[pattern.name.key], 1, 1, True, pattern.name.at)
    elif isinstance(pattern, Concatenation):
        for part in pattern.parts:
            yield from _flat(part, shown)
    else:
        assert isinstance(pattern, Repetition), f"not portable: {pattern}"
        (body,) = _flat(pattern.body, shown)
        yield Element(body.variable, pattern.least, pattern.most, pattern.greedy, body.at)
