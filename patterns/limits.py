"""What a rule may use. Each limit ends in an error that names it, never in a hang."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Limits:
    """Settings of the engine.

    Attributes:
        positions: Rows that a pattern unfolds to, repetitions written out.
        threads: Partial matches alive in one partition.
        partitions: Partitions that anything is remembered of.
        listed: Values that one partial match lists for an aggregate that cannot be kept up row by row.
        questions: Times that a query's DEFINE asks DuckDB about values of a partial match.
        steps: Rows that a search takes that has to go start by start, because DEFINE asks for MATCH_NUMBER.
    """

    positions: int = 10_000
    threads: int = 10_000
    partitions: int = 1_000_000
    listed: int = 1_000
    questions: int = 20_000
    steps: int = 10_000_000
