"""Running a stage: on all rows, which is the definition, and online, which must equal it.

As with rules, a row waits until its time lies strictly below the watermark, and final rows are taken in the
total order (time, stream, sequence); one pushed batch is one unit of arrival.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import groupby
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from events import EventBatch, EventType, batch_of
from patterns.binding.columns import arrow_type
from patterns.binding.expressions import Kind
from patterns.binding.rows import (
    SEQUENCE,
    STREAM,
    TIME,
    StreamNumbers,
    check_envelope,
    in_total_order,
    newest_by_source,
    normalised,
)
from patterns.durations import microseconds
from patterns.engine.clock import Clock
from patterns.engine.saved import Saved, decode, encode
from patterns.engine.situations import as_microseconds
from patterns.errors import StateError
from patterns.scene.geometry import FrameSize
from patterns.stages.frames import READS
from patterns.stages.groups import StandingGroups
from patterns.stages.occupancy import ZoneCounts
from patterns.stages.pairs import NearPairs
from patterns.stages.settings import Groups, Pairs, Stage, Windows, Zones
from patterns.stages.tallies import WindowCounts


class Derivation(Protocol):
    """The core of a stage: what final rows, in their total order, lead to."""

    given_up: int
    """rows or pairs beyond a limit, which took no part"""

    def take(self, rows: pa.Table, until_us: int) -> list[tuple[str, EventType]]:
        """The events, each with its source, by time, that the next rows lead to; none before `until_us` is to come."""
        ...

    def reset(self) -> None:
        """The input has ended: what comes next begins anew."""
        ...

    def state(self) -> Any:
        """All that it remembers, as JSON has it."""
        ...

    def restore(self, saved: Any) -> None:
        """Goes on from what `state` gave."""
        ...


@dataclass(frozen=True, slots=True)
class Derived:
    """Events of one source, next to each other in the order of derivation."""

    source: str
    batch: EventBatch


@dataclass(frozen=True, slots=True)
class StageOutcome:
    """What a step led to: derived events in order, and how many rows came too late to take part."""

    derived: tuple[Derived, ...] = ()
    late: int = 0


def derive(
    stage: Stage, rows: pa.Table | pa.RecordBatch, frame_sizes: dict[str, FrameSize] | None = None
) -> tuple[Derived, ...]:
    """What the stage derives from these rows, which are all there are, in any order: the definition."""
    run = StageRun(stage)
    for source, (width, height) in (frame_sizes or {}).items():
        run.set_frame_size(source, width, height)
    run.hold(rows)
    return run.finish().derived


class StageRun:
    """One stage, online. Not for several threads at once."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.late = 0
        """Rows that came too late to take part."""
        idle = stage.time.idle
        self._clock = Clock(microseconds(stage.time.lateness), None if idle is None else microseconds(idle))
        self._streams = StreamNumbers()
        self._waiting: list[pa.Table] = []
        self._frame_sizes: dict[str, FrameSize] = {}
        self._reads: dict[str, Kind] = reads(stage)
        self._core: Derivation = _CORES[stage.derives](stage, self._frame_sizes)

    @property
    def input_types(self) -> frozenset[str]:
        """The event types that it takes."""
        return frozenset({self.stage.reads})

    @property
    def given_up(self) -> int:
        """What was beyond a limit of the stage and took no part."""
        return self._core.given_up

    def set_frame_size(self, source: str, width: int, height: int) -> None:
        """The source's frames have this size in pixels, from the next step on."""
        self._frame_sizes[source] = (width, height)

    def push(self, rows: pa.Table | pa.RecordBatch) -> StageOutcome:
        """Takes rows as they arrive, of any streams; rows of other types only move the watermark.

        Raises:
            MatchError: The stage cannot go on with these rows.
        """
        late = self.hold(rows)
        return StageOutcome(self._advanced(), late)

    def hold(self, rows: pa.Table | pa.RecordBatch) -> int:
        """Takes rows, and derives nothing yet; how many came too late."""
        table = pa.Table.from_batches([rows]) if isinstance(rows, pa.RecordBatch) else rows
        check_envelope(table)
        if self.stage.sources is not None:
            table = table.filter(pc.is_in(table.column("source"), pa.array(self.stage.sources, pa.string())))
        own = table.filter(pc.equal(table.column("type"), self.stage.reads))
        late = 0
        if own.num_rows:
            own = normalised(own, self._reads, self._streams)
            if self._clock.watermark_us is not None:
                is_late = np.asarray(own.column(TIME)) < self._clock.watermark_us
                late = int(is_late.sum())
                own = own.filter(pa.array(~is_late))
            self._waiting.append(own)
        self.late += late
        for source, newest_us in newest_by_source(table):
            self._clock.observe(source, newest_us)
        return late

    def source_ended(self, source: str) -> StageOutcome:
        """The source will send no more; when all have ended, the input has."""
        return self.finish() if self._clock.end(source) else StageOutcome(self._advanced())

    def advance_idle(self, now: datetime) -> StageOutcome:
        """Looks, by the clock on the wall, for sources that have been silent for the idle time."""
        now_us = as_microseconds(now)
        assert isinstance(now_us, int), "a time is whole microseconds"
        self._clock.look_for_idle(now_us)
        return StageOutcome(self._advanced())

    def finish(self) -> StageOutcome:
        """The input has ended; time has come to its newest event. What is pushed after this begins anew."""
        until_us = self._clock.newest_us() + 1
        found = self._core.take(self._released(until_us), until_us)
        self._core.reset()
        self._clock.reset()
        return StageOutcome(_batches(found))

    def state(self) -> bytes:
        """All that the run remembers; `restore` in a new run of the same stage goes on from it."""
        header = {
            "stage": self.stage.hash,
            "streams": self._streams.names,
            "frame_sizes": self._frame_sizes,
            "clock": self._clock.to_json(),
            "late": self.late,
            "core": self._core.state(),
        }
        return encode(Saved(header, pa.concat_tables(self._waiting) if self._waiting else None))

    def restore(self, state: bytes) -> None:
        """Goes on from what `state` gave.

        Raises:
            StateError: Not a saved state, or that of another stage or version.
        """
        saved = decode(state)
        header = saved.header
        if header.get("stage") != self.stage.hash:
            raise StateError(f"the saved state is of stage hash {header.get('stage')}, this one's is {self.stage.hash}")
        self._streams = StreamNumbers.of(header["streams"])
        self._frame_sizes.update({source: (width, height) for source, (width, height) in header["frame_sizes"].items()})
        self._clock.restore(header["clock"])
        self.late = header["late"]
        self._core.restore(header["core"])
        self._waiting = [] if saved.waiting is None else [saved.waiting]

    def _advanced(self) -> tuple[Derived, ...]:
        watermark_us = self._clock.advance()
        if watermark_us is None:
            return ()
        return _batches(self._core.take(self._released(watermark_us), watermark_us))

    def _released(self, before_us: int) -> pa.Table:
        """The rows before this time, in the total order; they wait no longer."""
        if not self._waiting:
            return _no_rows(self._reads)
        waiting = pa.concat_tables(self._waiting).combine_chunks()
        is_final = np.asarray(waiting.column(TIME)) < before_us
        rest = waiting.filter(pa.array(~is_final))
        self._waiting = [rest] if rest.num_rows else []
        return in_total_order(waiting.filter(pa.array(is_final)), self._streams)


def reads(stage: Stage) -> dict[str, Kind]:
    """The columns that the stage reads, with their types."""
    if stage.tally is None:
        return READS
    return {"source": Kind.STRING} | ({stage.tally.by: Kind.STRING} if stage.tally.by else {})


def _pairs(stage: Stage, frame_sizes: dict[str, FrameSize]) -> Derivation:
    assert isinstance(stage.settings, Pairs), "KINDS says so"
    return NearPairs(stage.stage, stage.settings)


def _occupancy(stage: Stage, frame_sizes: dict[str, FrameSize]) -> Derivation:
    assert isinstance(stage.settings, Zones), "KINDS says so"
    return ZoneCounts(stage.stage, stage.settings, frame_sizes)


def _groups(stage: Stage, frame_sizes: dict[str, FrameSize]) -> Derivation:
    assert isinstance(stage.settings, Groups), "KINDS says so"
    return StandingGroups(stage.stage, stage.settings)


def _tally(stage: Stage, frame_sizes: dict[str, FrameSize]) -> Derivation:
    assert isinstance(stage.settings, Windows), "KINDS says so"
    return WindowCounts(stage.stage, stage.settings)


_CORES: dict[str, Callable[[Stage, dict[str, FrameSize]], Derivation]] = {
    "pair_distance": _pairs, "occupancy": _occupancy, "group_seen": _groups, "tally": _tally,
}  # fmt: skip


def _batches(found: Sequence[tuple[str, EventType]]) -> tuple[Derived, ...]:
    return tuple(
        Derived(source, batch_of([event for _, event in run]))
        for source, run in groupby(found, key=lambda pair: pair[0])
    )


def _no_rows(columns: dict[str, Kind]) -> pa.Table:
    types = {STREAM: pa.int64(), TIME: pa.int64(), SEQUENCE: pa.int64()}
    types |= {name: arrow_type(kind) for name, kind in columns.items()}
    return pa.schema(list(types.items())).empty_table()
