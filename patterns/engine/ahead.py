"""NEXT online: a row waits until the rows after it that it needs are known, and the rows behind it with it.

A row needs as many rows of its partition after it as any variable looks ahead that could take it, judged by what the
row and those before it decide; where nothing is open, as any that could take a match's first row. It is released by
the last of these rows, or where they never come by the end of the input; and never before a row ahead of it. What the
row decides is decided then. So too what time decides while a row before that time waits.

All of this follows from the rows and their order alone, so that no split of the rows changes it.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from patterns.binding.bound import BoundRule
from patterns.binding.expressions import ahead
from patterns.engine.matcher import Block, Event, Found, Matcher, Partition
from patterns.engine.timers import TIMER_STREAM

END = 2**62
"""The number of a row that no partition has."""


class Release(NamedTuple):
    """What released a row: the number of a row in the partition and its event; None: the end of the input."""

    ordinal: int
    event: Event | None


@dataclass(frozen=True, slots=True)
class Needs:
    """For each row of a block, how many rows after it must be known.

    Attributes:
        inside: Where a partial match is open.
        first: Where none is.
        begins: The rows, ascending, that a match may begin at, or that need others to say so.
    """

    inside: Sequence[int]
    first: Sequence[int]
    begins: Sequence[int]


class Ahead:
    """How far a rule looks ahead of its rows."""

    def __init__(self, bound: BoundRule) -> None:
        """That of a rule which looks ahead."""
        looks = enumerate(bound.ahead)
        self._looks = [(variable, rows) for variable, rows in looks if rows and not bound.timed[variable]]
        self._firsts = {bound.tables.variables[position] for position in bound.tables.firsts()}
        self._known = [
            [at for at in condition.predicates if not ahead(bound.predicates[at])] for condition in bound.conditions
        ]

    def needs(self, truths: Sequence[NDArray[np.bool_]], starts: NDArray[np.bool_], kept: NDArray[np.int64]) -> Needs:
        """What the kept rows need, of rows of which these row-local conditions are true and these may begin a match."""
        inside, first = (np.zeros(len(starts), dtype=np.int64) for _ in range(2))
        for variable, rows in self._looks:
            needed = np.where(self._could_take(variable, truths, len(starts)), rows, 0)
            np.maximum(inside, needed, out=inside)
            if variable in self._firsts:
                np.maximum(first, needed, out=first)
        begins = np.flatnonzero(starts[kept] | (first[kept] > 0))
        return Needs(inside[kept].tolist(), first[kept].tolist(), begins.tolist())

    def may_begin(self, truths: Sequence[NDArray[np.bool_]], rows: int) -> NDArray[np.bool_]:
        """The rows that may begin a match once the rows after them are known."""
        may = np.zeros(rows, dtype=np.bool_)
        for variable, _ in self._looks:
            if variable in self._firsts:
                may |= self._could_take(variable, truths, rows)
        return may

    def _could_take(self, variable: int, truths: Sequence[NDArray[np.bool_]], rows: int) -> NDArray[np.bool_]:
        """The rows that the variable could take, as far as they and those before them say."""
        could = np.ones(rows, dtype=np.bool_)
        for at in self._known[variable]:
            could &= truths[at]
        return could


def run(
    matcher: Matcher, partition: Partition, block: Block, needs: Needs, rows: tuple[int, int], released: Release | None,
    *, is_end: bool,
) -> tuple[list[Found], int, Release | None]:  # fmt: skip
    """What rows of a partition, its next, make final; where the rows begin that wait; what released the last before.

    Args:
        matcher: The matcher.
        partition: The partition.
        block: The rows, those of other partitions too.
        needs: What they need.
        rows: Where those of the partition begin and end in the block.
        released: What released the partition's last row before them.
        is_end: Whether no row comes after them.
    """
    found: list[Found] = []
    row, end = rows
    while row < end:
        if partition.attempts:
            found += moved(matcher.expire(partition, block.events[row][2]), released)
        if partition.attempts:
            needed = needs.inside[row]
        else:
            at = bisect_left(needs.begins, row)
            begin = min(needs.begins[at], end) if at < len(needs.begins) else end
            if begin > row:
                found += matcher.run(partition, block, row, begin)
                row = begin
                continue
            needed = needs.first[row]
        if row + needed >= end and not is_end:
            break
        known = row + needed < end
        release = Release(partition.ordinal + needed, block.events[row + needed]) if known else Release(END, None)
        released = release if released is None else max(released, release, key=_ordinal)
        found += moved(matcher.run(partition, block, row, row + 1), released)
        row += 1
    return found, row, released


def _ordinal(release: Release) -> int:
    return release.ordinal


def moved(found: list[Found], released: Release | None) -> list[Found]:
    """The matches, none decided before the last row that it could have had was released."""
    if released is None:
        return found
    event = released.event
    decided_us = None if event is None else event[2]
    return [
        each if event is not None and _is_later(each, event) else each._replace(decided_us=decided_us, decided_by=event)
        for each in found
    ]  # fmt: skip


def _is_later(found: Found, event: Event) -> bool:
    """Whether the match was decided after this event; by another row it was not, for that was released by it."""
    if found.decided_us is None:
        return True
    if found.decided_by is None:
        return found.decided_us > event[2]
    return found.decided_by[0] == TIMER_STREAM and found.decided_us >= event[2]
