"""How fast a station's log comes to be central's, beside PostgreSQL's logical replication, in one run.

    python -m benchmarks.sync [--quick] [--folder DIR] [--results FILE] [--only TEXT]

Central is `vian serve`, the station's daemon `vian sync`, each a process in a network namespace of its own over an
embedded log with durable commits; all on this machine. Realistic track points of a hundred cameras, 1,000 a segment.
Needs root, for the namespaces. Results go to a file, from which `python -m benchmarks.report` writes
docs/performance.md.
"""

import argparse
import platform
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import sync_alerts, sync_drain, sync_idle, sync_many
from benchmarks.measuring import Figure, Row, keep


@dataclass(frozen=True, slots=True)
class Plan:
    """How much of everything."""

    rounds: int
    segments: int
    """of a round's backlog"""
    waiting_segments: int
    """of the backlog that alerts overtake"""
    watched_s: float | None
    """how long it is watched; None: until it is gone"""
    idle_s: float


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, print the table, and keep it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="less of everything, in under 3 minutes")
    parser.add_argument("--full", action="store_true", help="let the backlog of 12 days drain to its end: 50 minutes")
    parser.add_argument("--folder", type=Path, help="where the databases live, on a real disk")
    parser.add_argument("--results", type=Path, default=Path("benchmarks/results/sync.json"))
    parser.add_argument("--only", help="only measurements whose name holds this text")
    options = parser.parse_args(arguments)
    plan = Plan(3, 300, 1000, 30.0, 30.0) if options.quick else Plan(5, 1000, 10_000, 300.0, 180.0)
    if options.full:
        plan = replace(plan, watched_s=None)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # servers and namespaces are cleared away then, too
    rows: list[Row | Figure] = []
    for name, measurement in MEASUREMENTS.items():
        if options.only and options.only not in name:
            continue
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            Path(folder).chmod(0o755)
            for row in measurement(Path(folder), plan):
                rows.append(row)
                print(_line(row), flush=True)
    if not options.only:
        machine = f"{platform.machine()}, {platform.system()}, Python {platform.python_version()}"
        keep(options.results, is_quick=options.quick, machine=machine, rows=[row.plain() for row in rows])


def _line(row: Row | Figure) -> str:
    target = "" if row.target is None else f"  target {row.target:.3g}: {'reached' if row.is_reached else 'MISSED'}"
    if isinstance(row, Figure):
        return f"{row.what:80} {row.reached:,.3f} {row.unit}{target}"
    return (
        f"{row.what:54} {row.ours:>12,.1f} {row.unit:12} {row.reference_name}: {row.reference:,.1f}"
        f"  ratio {row.ratio:.3f}{target}"
    )


MEASUREMENTS: dict[str, Callable[[Path, Plan], Iterator[Row | Figure]]] = {
    "drain": lambda folder, plan: sync_drain.drained(folder, plan.rounds, plan.segments),
    "wire": lambda folder, plan: sync_drain.crossed(folder, 3, min(plan.segments, 300)),
    "alerts": lambda folder, plan: sync_alerts.alerts(folder, plan.waiting_segments, plan.watched_s),
    "many": lambda folder, plan: sync_many.many(folder, plan.rounds, 6 * plan.segments),
    "idle": lambda folder, plan: sync_idle.idle(folder, plan.idle_s),
}


if __name__ == "__main__":
    main()
