"""What a rule may use. Each limit ends in an error that names it, or in a loss that is said; never in a hang."""

from dataclasses import dataclass
from datetime import timedelta

from patterns.durations import microseconds

_LOOKS = 16
"""How often in the span of `expiry` partitions are looked through."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Settings of the engine.

    Attributes:
        positions: Rows that a pattern unfolds to, repetitions written out.
        threads: Partial matches alive in one partition.
        partitions: Partitions that anything is remembered of, by a rule, or by rules that run together. Online half of
            them are given up then: those that were silent longest.
        expiry: A partition that had no row for so long, in event time, is given up: then, or up to a sixteenth of
            this later. Online only; None: never.
        listed: Values that one partial match lists for an aggregate that cannot be kept up row by row.
        questions: Times that a query's DEFINE asks DuckDB about values of a partial match.
        steps: Rows, each times the partial matches that take it, of a search that has to go start by start, because
            DEFINE asks for MATCH_NUMBER; or ten for each row of the input, where that is more.
    """

    positions: int = 10_000
    threads: int = 10_000
    partitions: int = 1_000_000
    listed: int = 1_000
    questions: int = 20_000
    steps: int = 2_000_000
    expiry: timedelta | None = None

    def expired_before_us(self, before_us: int | None, now_us: int) -> int | None:
        """The time before which a partition's last row must lie to be given up; None: it is not time to look.

        Args:
            before_us: Where the watermark was.
            now_us: Where it is now.
        """
        if self.expiry is None:
            return None
        expiry_us = microseconds(self.expiry)
        grain_us = max(expiry_us // _LOOKS, 1)
        if before_us is not None and before_us // grain_us == now_us // grain_us:
            return None
        return now_us - expiry_us
