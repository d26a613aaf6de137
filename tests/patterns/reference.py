"""The slow, obvious matcher: backtracking straight from the definition, over rows as dictionaries.

It shares nothing with the engine: patterns are tuples, conditions are Python
functions. One partition at a time.

    ("var", name)                        a row
    ("cat", parts)   ("alt", choices)    one after the other; one of them, the left one preferred
    ("rep", body, least, most, greedy)   so many times; most is None for any number
    ("perm", parts)                      all of them, in the first order of the list that matches
    ("excl", body)                       the body, whose rows are not shown
    ("start",)  ("end",)  ("empty",)     no row: before the first, after the last, anywhere
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any, NamedTuple

Row = dict[str, Any]
Tree = tuple[Any, ...]

STEPS_MOST = 30_000


class Mapped(NamedTuple):
    """One row of a match."""

    variable: str
    at: int
    is_shown: bool = True


Mapping_ = tuple[Mapped, ...]


class TooSlow(Exception):
    """The definition takes too long on this example."""


class SkipFails(Exception):
    """AFTER MATCH SKIP has no row to go to."""


@dataclass(frozen=True)
class Seen:
    """What an expression can look at: the partition, and the rows mapped up to the one at hand, it included.

    In a measure, `final` has all rows of the match; in a condition it is not used.
    """

    rows: list[Row]
    at: int
    mapped: Mapping_
    number: int = 1
    subsets: Mapping[str, str] = field(default_factory=dict)
    whole: Mapping_ | None = None

    @property
    def final(self) -> "Seen":
        assert self.whole is not None
        return Seen(self.rows, self.at, self.whole, self.number, self.subsets, self.whole)

    def of(self, variable: str | None) -> list[Mapped]:
        """The rows of a variable, of the members of a subset, or all."""
        members = self.subsets.get(variable, [variable]) if variable else None
        return [each for each in self.mapped if members is None or each.variable in members]

    def place(self, variable: str | None, is_first: bool = False, offset: int = 0) -> int | None:
        """Where FIRST or LAST with this offset is."""
        found = self.of(variable) if is_first else self.of(variable)[::-1]
        return found[offset].at if offset < len(found) else None

    def value(self, column: str, at: int | None, shift: int = 0) -> Any:
        """The column so many rows after the place; NULL outside of the partition."""
        return None if at is None or not 0 <= at + shift < len(self.rows) else self.rows[at + shift][column]

    def classifier(self, variable: str | None = None) -> str | None:
        found = self.of(variable)
        return found[-1].variable if found else None

    def current(self, column: str) -> Any:
        return self.rows[self.at][column]

    def prev(self, column: str, back: int = 1) -> Any:
        return self.value(column, self.at, -back)

    def last(self, variable: str, column: str) -> Any:
        return self.value(column, self.place(variable))

    def first(self, variable: str, column: str) -> Any:
        return self.value(column, self.place(variable, is_first=True))

    def count(self, variable: str) -> int:
        return len(self.of(variable))


Condition = Callable[[Seen], bool | None]


@dataclass(frozen=True)
class Found:
    """One match, or a row that has none.

    Attributes:
        start: Where the search stood.
        number: 1 for the partition's first match, the empty ones counted; None for a row without a match.
        mapped: Its rows.
    """

    start: int
    number: int | None
    mapped: Mapping_


class Reference:
    """Finds the matches of one pattern in one partition."""

    def __init__(
        self,
        tree: Tree,
        conditions: Mapping[str, Condition],
        skip: tuple[str, str | None],
        within: int | None,
        subsets: Mapping[str, str] | None = None,
    ) -> None:
        self.tree = tree
        self.conditions = conditions
        self.skip = skip
        self.within = within
        self.subsets = subsets or {}
        self.steps = 0
        self.number = 1

    def matches(self, rows: list[Row]) -> list[Mapping_]:
        """The matches that are not empty, left to right."""
        return [found.mapped for found in self.found(rows) if found.mapped]

    def found(self, rows: list[Row]) -> list[Found]:
        """What the search comes to at each row where it stands: a match, an empty match, or none."""
        result = []
        covered = -1
        start = 0
        self.number = 1
        while start < len(rows):
            mapped = next((mapped for _, mapped in self.ways(self.tree, rows, start, start, ())), None)
            if mapped is None:
                if start > covered:
                    result.append(Found(start, None, ()))
                start += 1
                continue
            result.append(Found(start, self.number, mapped))
            self.number += 1
            covered = max(covered, mapped[-1].at if mapped else start)
            start = self.resume(start, mapped) if mapped else start + 1
        return result

    def resume(self, start: int, match: Mapping_) -> int:
        mode, variable = self.skip
        if mode == "PAST LAST ROW":
            return match[-1].at + 1
        if mode == "TO NEXT ROW":
            return start + 1
        target = Seen([], start, match, subsets=self.subsets).place(variable, is_first=mode == "TO FIRST")
        if target is None or target == start:
            raise SkipFails
        return target

    def ways(
        self, tree: Tree, rows: list[Row], start: int, at: int, mapped: Mapping_
    ) -> Iterator[tuple[int, Mapping_]]:
        """All ways to match the tree from this row on, preferred first."""
        self.steps += 1
        if self.steps > STEPS_MOST:
            raise TooSlow
        kind = tree[0]
        if kind == "var":
            yield from self.one_row(tree[1], rows, start, at, mapped)
        elif kind == "cat":
            yield from self.in_turn(tree[1], rows, start, at, mapped)
        elif kind == "alt":
            for choice in tree[1]:
                yield from self.ways(choice, rows, start, at, mapped)
        elif kind == "perm":
            for order in permutations(tree[1]):
                yield from self.in_turn(order, rows, start, at, mapped)
        elif kind == "excl":
            for after, longer in self.ways(tree[1], rows, start, at, mapped):
                hidden = tuple(each._replace(is_shown=False) for each in longer[len(mapped) :])
                yield after, (*mapped, *hidden)
        elif kind == "rep":
            yield from self.repeated(tree, 0, rows, start, at, mapped)
        elif kind == "empty" or at == {"start": 0, "end": len(rows)}[kind]:
            yield at, mapped

    def one_row(
        self, variable: str, rows: list[Row], start: int, at: int, mapped: Mapping_
    ) -> Iterator[tuple[int, Mapping_]]:
        if at >= len(rows):
            return
        if self.within is not None and rows[at]["us"] - rows[start]["us"] >= self.within:
            return
        longer = (*mapped, Mapped(variable, at))
        condition = self.conditions.get(variable)
        if condition is None or condition(Seen(rows, at, longer, self.number, self.subsets)) is True:
            yield at + 1, longer

    def in_turn(
        self, parts: tuple[Tree, ...], rows: list[Row], start: int, at: int, mapped: Mapping_
    ) -> Iterator[tuple[int, Mapping_]]:
        if not parts:
            yield at, mapped
            return
        for after, longer in self.ways(parts[0], rows, start, at, mapped):
            yield from self.in_turn(parts[1:], rows, start, after, longer)

    def repeated(
        self, tree: Tree, done: int, rows: list[Row], start: int, at: int, mapped: Mapping_
    ) -> Iterator[tuple[int, Mapping_]]:
        _, body, least, most, greedy = tree
        if done < least:
            for after, longer in self.ways(body, rows, start, at, mapped):
                yield from self.repeated(tree, done + 1, rows, start, after, longer)
            return
        if not greedy:
            yield at, mapped
        if most is None or done < most:
            for after, longer in self.ways(body, rows, start, at, mapped):
                if after == at:
                    yield after, longer  # an iteration that takes no row ends the repetition
                else:
                    yield from self.repeated(tree, done + 1, rows, start, after, longer)
        if greedy:
            yield at, mapped


def rendered(tree: Tree) -> str:
    """The tree as SQL writes it."""
    kind = tree[0]
    if kind == "var":
        return str(tree[1])
    if kind == "cat":
        return " ".join(f"({rendered(part)})" if part[0] == "alt" else rendered(part) for part in tree[1])
    if kind == "alt":
        return " | ".join(rendered(choice) for choice in tree[1])
    if kind == "perm":
        return f"PERMUTE({', '.join(rendered(part) for part in tree[1])})"
    if kind == "excl":
        return f"{{- {rendered(tree[1])} -}}"
    if kind in ("start", "end", "empty"):
        return {"start": "^", "end": "$", "empty": "()"}[kind]
    _, body, least, most, greedy = tree
    simple = {(0, None): "*", (1, None): "+", (0, 1): "?"}
    bounds = f"{{{least},{'' if most is None else most}}}"
    inner = rendered(body) if body[0] == "var" else f"({rendered(body)})"
    return f"{inner}{simple.get((least, most), bounds)}{'' if greedy else '?'}"


def children(tree: Tree) -> tuple[Tree, ...]:
    """The trees right below this one."""
    if tree[0] in ("cat", "alt", "perm"):
        return tuple(tree[1])
    return (tree[1],) if tree[0] in ("rep", "excl") else ()


def variables(tree: Tree) -> set[str]:
    """The variables of the pattern."""
    return {tree[1]} if tree[0] == "var" else {name for part in children(tree) for name in variables(part)}


def is_nullable(tree: Tree) -> bool:
    """Whether the tree can match no row at all."""
    kind = tree[0]
    if kind == "var":
        return False
    if kind == "alt":
        return any(is_nullable(choice) for choice in tree[1])
    return (kind == "rep" and tree[2] == 0) or all(is_nullable(part) for part in children(tree))


def has_empty_body(tree: Tree) -> bool:
    """Whether a repetition's body can match no row."""
    return (tree[0] == "rep" and is_nullable(tree[1])) or any(has_empty_body(part) for part in children(tree))
