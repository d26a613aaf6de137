"""TIMER straight from its definition: virtual rows among the real ones, and backtracking. Slow and obvious.

Shares nothing with the engine. A tree is ("var", name), ("cat", parts), ("alt", choices) or
("rep", body, least, most or None, greedy). A row has `us`, `key` and `letter`.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

Row = dict[str, Any]
Tree = tuple[Any, ...]
Mapped = tuple[tuple[str, Row], ...]


@dataclass(frozen=True)
class TimedPattern:
    """A pattern whose variables take their letter, or are timers.

    Attributes:
        tree: The pattern.
        letters: For each variable without TIMER the letters that it takes.
        timers: For each variable with TIMER the variable that it counts from, and the duration in microseconds.
        within_us: WITHIN.
    """

    tree: Tree
    letters: Mapping[str, str]
    timers: Mapping[str, tuple[str, int]]
    within_us: int | None


def matches(pattern: TimedPattern, real: list[Row]) -> list[Mapped]:
    """The matches in the rows of one input, partition by partition; SKIP PAST LAST ROW."""
    newest = max((row["us"] for row in real), default=0)
    found = []
    for key in sorted({row["key"] for row in real}):
        rows = _united(pattern, [row for row in real if row["key"] == key], newest)
        at = 0
        while at < len(rows):
            if not rows[at]["is_virtual"]:
                match = next((mapped for _, mapped in _ways(pattern, pattern.tree, rows, at, ())), None)
                if match:
                    found.append(match)
                    at = rows.index(match[-1][1])
            at += 1
    return found


def _united(pattern: TimedPattern, real: list[Row], newest: int) -> list[Row]:
    """The rows and those that they set, as far as time gets: real ones of a time first, one virtual one for a time."""
    rows = [{**row, "is_virtual": False} for row in real]
    setters = [(name, after) for name, after in pattern.timers.values()]
    times = {
        row["us"] + after for row in real for name, after in setters if row["letter"] in pattern.letters[name]
    }  # fmt: skip
    rows += [{"us": us, "is_virtual": True} for us in times if us <= newest]
    return sorted(rows, key=lambda row: (row["us"], row["is_virtual"]))


def _is_seen(pattern: TimedPattern, row: Row, mapped: Mapped) -> bool:
    """Whether a virtual row is due at the last row of a variable that the match so far has."""
    return any(_is_due(timer, row, mapped) for timer in pattern.timers.values())


def _is_due(timer: tuple[str, int], row: Row, mapped: Mapped) -> bool:
    name, after = timer
    last = [each["us"] for variable, each in mapped if variable == name]
    return bool(last) and row["us"] == last[-1] + after


def _ways(pattern: TimedPattern, tree: Tree, rows: list[Row], at: int, mapped: Mapped) -> Iterator[tuple[int, Mapped]]:
    """All ways to match the tree from here on, preferred first."""
    if tree[0] == "var":
        yield from _one_row(pattern, tree[1], rows, at, mapped)
    elif tree[0] == "cat":
        yield from _in_turn(pattern, tree[1], rows, at, mapped)
    elif tree[0] == "alt":
        for choice in tree[1]:
            yield from _ways(pattern, choice, rows, at, mapped)
    else:
        yield from _repeated(pattern, tree, 0, rows, at, mapped)


def _one_row(
    pattern: TimedPattern, variable: str, rows: list[Row], at: int, mapped: Mapped
) -> Iterator[tuple[int, Mapped]]:
    while at < len(rows) and rows[at]["is_virtual"] and not _is_seen(pattern, rows[at], mapped):
        at += 1
    if at == len(rows):
        return
    row = rows[at]
    if pattern.within_us is not None and mapped and row["us"] - mapped[0][1]["us"] >= pattern.within_us:
        return
    if row["is_virtual"]:
        takes = variable in pattern.timers and _is_due(pattern.timers[variable], row, mapped)
    else:
        takes = variable not in pattern.timers and row["letter"] in pattern.letters[variable]
    if takes:
        yield at + 1, (*mapped, (variable, row))


def _in_turn(
    pattern: TimedPattern, parts: tuple[Tree, ...], rows: list[Row], at: int, mapped: Mapped
) -> Iterator[tuple[int, Mapped]]:
    if not parts:
        yield at, mapped
        return
    for after, longer in _ways(pattern, parts[0], rows, at, mapped):
        yield from _in_turn(pattern, parts[1:], rows, after, longer)


def _repeated(
    pattern: TimedPattern, tree: Tree, done: int, rows: list[Row], at: int, mapped: Mapped
) -> Iterator[tuple[int, Mapped]]:
    _, body, least, most, greedy = tree
    if done >= least and not greedy:
        yield at, mapped
    if most is None or done < most:
        for after, longer in _ways(pattern, body, rows, at, mapped):
            yield from _repeated(pattern, tree, done + 1, rows, after, longer)
    if done >= least and greedy:
        yield at, mapped
