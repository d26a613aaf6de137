"""What the matcher found of one rule in one step, by column.

Many matches are found at once where history is read, so a match is a place in these columns, not an object of
its own parts: Python's garbage collector alone took as long for those as matching did.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from patterns.engine.matcher import Event, Found, runs

RUN_COLUMNS = 6
RUN_VARIABLE, RUN_STREAM, RUN_FIRST, RUN_LAST, RUN_ORDINAL, RUN_ROWS = range(RUN_COLUMNS)


class Events(NamedTuple):
    """Events by column: numbers of their streams, sequences there, times in microseconds."""

    streams: Sequence[int]
    sequences: Sequence[int]
    times_us: Sequence[int]

    def event(self, at: int) -> Event:
        """One of them."""
        return self.streams[at], self.sequences[at], self.times_us[at]


@dataclass(frozen=True, slots=True)
class Finds:
    """Final matches in the order in which they were decided.

    Attributes:
        keys: By partition column its values.
        first: The events of their first rows.
        last: The events of their last rows.
        decided_us: The event times from which they were final; None: only the end of the input decided it.
        numbers: Their numbers in their partitions, from 1; 0 where nobody counts.
        registers: By register what it held; `patterns.binding.registers.UNSET` where nothing.
        runs: Runs of rows of one variable and one stream, by columns `RUN_VARIABLE` and so on.
        begins: For each match where its runs begin, which stand in order.
        ends: For each match where its runs end.
    """

    keys: Sequence[Sequence[Any]]
    first: Events
    last: Events
    decided_us: Sequence[int | None]
    numbers: Sequence[int]
    registers: Sequence[Sequence[Any]]
    runs: NDArray[np.int64]
    begins: NDArray[np.int64]
    ends: NDArray[np.int64]

    def __len__(self) -> int:
        """How many matches there are."""
        return len(self.decided_us)

    def runs_of(self, at: int) -> list[list[int]]:
        """The runs of one match, from its first row to its last."""
        own: list[list[int]] = self.runs[self.begins[at] : self.ends[at]].tolist()
        return own

    @classmethod
    def of(cls, found: Iterable[tuple[tuple[Any, ...], Found]]) -> "Finds":
        """Those of partitions by these keys; one at least."""
        keys, each = zip(*found, strict=True)
        listed = [[run[1:] for run in runs(one.ending.trace)] for one in each]
        ends = np.cumsum([len(own) for own in listed])
        return cls(
            keys=list(zip(*keys, strict=True)),
            first=Events(*zip(*(one.first for one in each), strict=True)),
            last=Events(*zip(*(one.ending.event for one in each), strict=True)),
            decided_us=[one.decided_us for one in each],
            numbers=[one.number for one in each],
            registers=list(zip(*(one.ending.registers for one in each), strict=True)),
            runs=np.array([run for own in listed for run in own], dtype=np.int64),
            begins=ends - [len(own) for own in listed],
            ends=ends,
        )
