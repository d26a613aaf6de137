"""What a rule may use. Each limit ends in an error that names it, never in a hang."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """Settings of the engine.

    Attributes:
        positions: Rows that a pattern unfolds to, repetitions written out.
        threads: Partial matches alive in one partition.
        partitions: Partitions that anything is remembered of.
    """

    positions: int = 10_000
    threads: int = 10_000
    partitions: int = 1_000_000
