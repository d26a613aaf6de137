"""Runs: which ranges of a stream central holds, and what is left to send.

Contract: pure. The runs of a stream ascend and do not touch; a run holds the events behind `after`, up to
`sequence`, and says the chain hash at both. A gap is a range that is to be sent and that no run holds.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from events import GENESIS, Run, StreamName


class StreamKey(NamedTuple):
    """A stream in one epoch: what has a cursor of its own."""

    stream: StreamName
    epoch: int


Runs = tuple[Run, ...]


@dataclass(frozen=True, slots=True)
class Point:
    """A place between two segments of a stream."""

    sequence: int
    """of the last event before it; 0 at the beginning"""
    chain_hash: bytes


BEGINNING = Point(0, GENESIS)


@dataclass(frozen=True, slots=True)
class Gap:
    """A range of one stream that is to be sent: the events behind `after`, up to `until`."""

    key: StreamKey
    after: Point
    until: Point
    begins_run: bool
    """Central holds nothing that ends at `after`, so what is sent first must say that it begins a run."""

    @property
    def events(self) -> int:
        """How many."""
        return self.until.sequence - self.after.sequence


def end_of(runs: Sequence[Run]) -> Point:
    """Where the newest run ends; the beginning where there is none."""
    return Point(runs[-1].sequence, runs[-1].chain_hash) if runs else BEGINNING


def gaps_of(key: StreamKey, runs: Iterable[Run], start: Point, head: Point) -> list[Gap]:
    """What is to be sent of the events behind `start`, up to `head`, ascending.

    >>> run = Run(5, b"e", 9, b"i")
    >>> [(gap.after.sequence, gap.until.sequence) for gap in gaps_of(None, [run], BEGINNING, Point(12, b"l"))]
    [(0, 5), (9, 12)]
    """
    gaps: list[Gap] = []
    at, is_end = start, not start.sequence
    for run in runs:
        if run.sequence < at.sequence:
            continue
        if run.after > at.sequence:
            gaps.append(Gap(key, at, Point(run.after, run.after_hash), not is_end))
        at, is_end = Point(run.sequence, run.chain_hash), True
    if head.sequence > at.sequence:
        gaps.append(Gap(key, at, head, not is_end))
    return gaps


def split(gap: Gap, mark: Point) -> tuple[Gap, Gap]:
    """The gap below the mark, and the gap above it, which begins a run."""
    assert gap.after.sequence < mark.sequence < gap.until.sequence, "a mark splits a gap that it lies in"
    return Gap(gap.key, gap.after, mark, gap.begins_run), Gap(gap.key, mark, gap.until, True)


def with_range(runs: Iterable[Run], after: Point, end: Point) -> Runs:
    """The runs once the events behind `after`, up to `end`, are there too.

    >>> with_range([Run(0, GENESIS, 4, b"d")], Point(4, b"d"), Point(6, b"f"))[-1].sequence
    6
    """
    joined = Run(after.sequence, after.chain_hash, end.sequence, end.chain_hash)
    result: list[Run] = []
    for run in runs:
        if run.sequence < joined.after or run.after > joined.sequence:
            result.append(run)
            continue
        low, high = min(run, joined, key=lambda r: r.after), max(run, joined, key=lambda r: r.sequence)
        joined = Run(low.after, low.after_hash, high.sequence, high.chain_hash)
    return tuple(sorted([*result, joined], key=lambda run: run.after))


def are_held(runs: Iterable[Run], after: int, end: Point) -> bool:
    """Whether one of the runs holds the events behind `after`, up to `end`; at its own end with that very hash."""
    return any(
        run.after <= after
        and (run.sequence > end.sequence or (run.sequence, run.chain_hash) == (end.sequence, end.chain_hash))
        for run in runs
    )
