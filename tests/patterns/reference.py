"""The slow, obvious matcher: backtracking straight from the definition, over rows as dictionaries.

It shares nothing with the engine: patterns are tuples, conditions are Python
functions. One partition at a time.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
Mapping_ = tuple[tuple[str, int], ...]
Tree = tuple[Any, ...]
Condition = Callable[["Seen"], bool | None]

STEPS_MOST = 30_000


class TooSlow(Exception):
    """The definition takes too long on this example."""


class SkipFails(Exception):
    """AFTER MATCH SKIP has no row to go to."""


@dataclass(frozen=True)
class Seen:
    """What a condition can look at: the rows, the row at hand and what is mapped, it included."""

    rows: list[Row]
    at: int
    mapped: Mapping_

    def current(self, column: str) -> Any:
        return self.rows[self.at][column]

    def prev(self, column: str, back: int = 1) -> Any:
        return self.rows[self.at - back][column] if self.at >= back else None

    def last(self, variable: str, column: str) -> Any:
        found = [at for name, at in self.mapped if name == variable]
        return self.rows[found[-1]][column] if found else None

    def first(self, variable: str, column: str) -> Any:
        found = [at for name, at in self.mapped if name == variable]
        return self.rows[found[0]][column] if found else None

    def count(self, variable: str) -> int:
        return sum(name == variable for name, _ in self.mapped)


class Reference:
    """Finds the matches of one pattern in one partition."""

    def __init__(
        self, tree: Tree, conditions: dict[str, Condition], skip: tuple[str, str | None], within: int | None
    ) -> None:
        self.tree = tree
        self.conditions = conditions
        self.skip = skip
        self.within = within
        self.steps = 0

    def matches(self, rows: list[Row]) -> list[Mapping_]:
        """The matches that are not empty, left to right."""
        found = []
        start = 0
        while start < len(rows):
            match = next((mapped for _, mapped in self.ways(self.tree, rows, start, start, ())), None)
            if not match:
                start += 1
                continue
            found.append(match)
            start = self.resume(start, match)
        return found

    def resume(self, start: int, match: Mapping_) -> int:
        mode, variable = self.skip
        if mode == "PAST LAST ROW":
            return match[-1][1] + 1
        if mode == "TO NEXT ROW":
            return start + 1
        rows = [at for name, at in match if name == variable]
        if not rows:
            raise SkipFails
        target = rows[0] if mode == "TO FIRST" else rows[-1]
        if target == start:
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
        else:
            yield from self.repeated(tree, 0, rows, start, at, mapped)

    def one_row(
        self, variable: str, rows: list[Row], start: int, at: int, mapped: Mapping_
    ) -> Iterator[tuple[int, Mapping_]]:
        if at >= len(rows):
            return
        if self.within is not None and rows[at]["us"] - rows[start]["us"] >= self.within:
            return
        longer = (*mapped, (variable, at))
        condition = self.conditions.get(variable)
        if condition is None or condition(Seen(rows, at, longer)) is True:
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
    _, body, least, most, greedy = tree
    simple = {(0, None): "*", (1, None): "+", (0, 1): "?"}
    bounds = f"{{{least},{'' if most is None else most}}}"
    inner = rendered(body) if body[0] == "var" else f"({rendered(body)})"
    return f"{inner}{simple.get((least, most), bounds)}{'' if greedy else '?'}"


def is_nullable(tree: Tree) -> bool:
    """Whether the tree can match no row at all."""
    kind = tree[0]
    if kind == "var":
        return False
    if kind == "cat":
        return all(is_nullable(part) for part in tree[1])
    if kind == "alt":
        return any(is_nullable(choice) for choice in tree[1])
    return tree[2] == 0 or is_nullable(tree[1])


def has_empty_body(tree: Tree) -> bool:
    """Whether a repetition's body can match no row."""
    if tree[0] == "var":
        return False
    if tree[0] == "rep":
        return is_nullable(tree[1]) or has_empty_body(tree[1])
    return any(has_empty_body(part) for part in tree[1])
