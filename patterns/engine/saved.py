"""The state of a run as bytes: compact, versioned, and of no rule but its own.

Layout: the four bytes `VRS1`, then zstd of: the length of the header (4 bytes,
big endian), the header (UTF-8 JSON), and the rows that wait (an Arrow IPC
stream, empty if there are none). A newer layout gets another number.
"""

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
import zstandard

from patterns.engine.ahead import Release
from patterns.engine.engine import Engine, Open
from patterns.engine.matcher import Attempt, Ending, Partition, Trace, runs
from patterns.errors import StateError

_MAGIC = b"VRS1"


@dataclass(frozen=True, slots=True)
class Saved:
    """What was saved: the header, and the rows that wait (None: no rows)."""

    header: dict[str, Any]
    waiting: pa.Table | None


def encode(saved: Saved) -> bytes:
    """The state as bytes."""
    header = json.dumps(saved.header, separators=(",", ":"), ensure_ascii=False).encode()
    sink = pa.BufferOutputStream()
    if saved.waiting is not None:
        with pa.ipc.new_stream(sink, saved.waiting.schema) as writer:
            writer.write_table(saved.waiting)
    body = struct.pack(">I", len(header)) + header + sink.getvalue().to_pybytes()
    return _MAGIC + zstandard.ZstdCompressor().compress(body)


def decode(state: bytes) -> Saved:
    """The state from its bytes.

    Raises:
        StateError: They are not a saved state, or of another layout.
    """
    if not state.startswith(_MAGIC):
        raise StateError(f"a saved state begins with {_MAGIC!r}, got {state[:4]!r}")
    try:
        body = zstandard.ZstdDecompressor().decompress(state[len(_MAGIC) :])
        (length,) = struct.unpack(">I", body[:4])
        header = json.loads(body[4 : 4 + length])
        rows = body[4 + length :]
        waiting = pa.ipc.open_stream(rows).read_all() if rows else None
    except (zstandard.ZstdError, struct.error, ValueError, pa.ArrowInvalid, OSError) as error:
        raise StateError(f"the saved state is damaged: {error}") from error
    return Saved(header, waiting)


def partitions_to_json(engine: Engine) -> list[Any]:
    """All that the engine remembers."""
    more = engine.bound.is_numbered or engine.ahead is not None
    return [partition_to_json(key, state, more=more) for key, state in engine.open.items()]


def partition_to_json(key: tuple[Any, ...], state: Open, *, more: bool = False) -> list[Any]:
    """What is remembered of the partition; `more`: what it counts, and which rows wait, too."""
    partition = state.partition
    attempts = [_attempt_to_json(attempt) for attempt in partition.attempts]
    rows = [list(row) for row in state.tail]
    said = [list(key), partition.ordinal, partition.last, partition.fired_us, rows, attempts]
    counted = [partition.number, partition.resumed]
    return [*said, counted, state.waiting, state.released] if more else said


def partitions_from_json(saved: list[Any]) -> Iterator[tuple[tuple[Any, ...], Open]]:
    """What the engine is to remember, by partition."""
    for key, ordinal, last, fired_us, tail, attempts, *more in saved:
        (number, resumed), waiting, released = more or ((0, 0), [], None)
        newest = None if last is None else _event(last)
        alive = [_attempt_from_json(attempt) for attempt in attempts]
        partition = Partition(alive, ordinal, newest, tuple(key), fired_us, number, resumed)
        yield (
            tuple(key),
            Open(
                partition,
                [tuple(row) for row in tail],
                waiting=[_event(event) for event in waiting],
                released=None if released is None else Release(released[0], _event(released[1])),
            ),
        )


def _attempt_to_json(attempt: Attempt) -> list[Any]:
    ending = attempt.ending
    threads = [[position, registers, _trace_to_json(trace)] for position, registers, trace in attempt.threads]
    best = None if ending is None else [ending.registers, _trace_to_json(ending.trace), ending.event, ending.ordinal]
    said = [attempt.event, attempt.ordinal, threads, best]
    return [*said, True] if attempt.is_over else said


def _attempt_from_json(saved: list[Any]) -> Attempt:
    event, ordinal, threads, best, *is_over = saved
    alive = [(position, _registers(registers), _trace(runs)) for position, registers, runs in threads]
    ending = None
    if best is not None:
        trace = _trace(best[1])
        assert trace is not None, "a match has rows"
        ending = Ending(_registers(best[0]), trace, _event(best[2]), best[3])
    return Attempt(_event(event), ordinal, alive, ending, bool(is_over))


def _event(saved: list[int]) -> tuple[int, int, int]:
    stream, sequence, time_us = saved
    return stream, sequence, time_us


def _registers(saved: list[Any]) -> tuple[Any, ...]:
    return tuple(tuple(value) if isinstance(value, list) else value for value in saved)


def _trace_to_json(trace: Trace | None) -> list[Any]:
    return [run[1:] for run in runs(trace)]


def _trace(saved: list[Any]) -> Trace | None:
    trace: Trace | None = None
    for variable, stream, first, last, ordinal, rows in saved:
        trace = (trace, variable, stream, first, last, ordinal, rows)
    return trace
