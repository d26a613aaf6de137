"""Rounds in which candidates take turns, and the ratio of what they came to.

Machines are noisy: what is quoted is the median of the ratios of neighbours in time, and both medians.
"""

import json
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement beside its reference."""

    what: str
    unit: str
    ours: float
    reference: float
    reference_name: str
    ratio: float
    target: float | None
    at_least: bool = True
    """whether the ratio must reach the target, else it must stay below it"""

    @property
    def is_reached(self) -> bool | None:
        """Whether the target is reached; None where there is none."""
        if self.target is None:
            return None
        return self.ratio >= self.target if self.at_least else self.ratio <= self.target

    def plain(self) -> dict[str, Any]:
        """For a file of results."""
        return asdict(self)


@dataclass(frozen=True, slots=True)
class Figure:
    """One measurement beside what is wanted, where nothing else does the same."""

    what: str
    unit: str
    reached: float
    target: float | None = None
    at_least: bool = True

    @property
    def is_reached(self) -> bool | None:
        """Whether the target is reached; None where there is none."""
        if self.target is None:
            return None
        return self.reached >= self.target if self.at_least else self.reached <= self.target

    def plain(self) -> dict[str, Any]:
        """For a file of results."""
        return asdict(self)


def rate(count: int, work: Callable[[], object]) -> float:
    """Units of work a second: `count` of them done by one call."""
    began = time.perf_counter()
    work()
    return count / (time.perf_counter() - began)


def compared(
    what: str,
    unit: str,
    rounds: int,
    ours: Callable[[int], float],
    reference: tuple[str, Callable[[int], float]],
    target: float | None,
) -> Row:
    """Ours beside the reference, turn by turn; each is given the round's number and returns its rate."""
    name, measure = reference
    pairs = []
    for number in range(rounds):
        first, second = (measure, ours) if number % 2 else (ours, measure)
        one, two = first(number), second(number)
        pairs.append((two, one) if number % 2 else (one, two))
    medians = [statistics.median(side) for side in zip(*pairs, strict=True)]
    ratio = statistics.median(mine / theirs for mine, theirs in pairs)
    return Row(what, unit, medians[0], medians[1], name, ratio, target)


def keep(results: Path, *, is_quick: bool, **found: Any) -> None:
    """Write what a run found, and when, into its file of results."""
    said = {"measured_at": datetime.now(UTC).isoformat(timespec="seconds"), "is_quick": is_quick, **found}
    results.parent.mkdir(parents=True, exist_ok=True)
    results.write_text(json.dumps(said, indent=1) + "\n")


@contextmanager
def cpu_of(processes: Callable[[], list[Any]]) -> Iterator[Callable[[], float]]:
    """A clock of the CPU seconds that these processes have used since the block began."""
    before = {process.pid: _cpu(process) for process in processes()}
    yield lambda: sum(_cpu(process) - before.get(process.pid, 0.0) for process in processes())


def _cpu(process: Any) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)
