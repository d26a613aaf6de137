"""What a lane remembers of one rule as bytes: columns of integers, versioned, and of no rule but its own.

Layout: the four bytes `VRS2`, then the length of the header (4 bytes, big endian), the header (zstd of
UTF-8 JSON), and for each table that the header names an Arrow IPC stream, its buffers compressed with zstd.
A column is of the narrowest integers that hold its values. A newer layout gets another number.

A saved rule knows only itself. Rules that were saved at the same place of the same rows share a lane again.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import zstandard
from numpy.typing import NDArray

from patterns.binding.expressions import Kind
from patterns.binding.rows import SEQUENCE, STREAM, TIME
from patterns.engine import kernel as k
from patterns.engine.clock import Clock
from patterns.engine.interning import Keys, Texts
from patterns.engine.kernel import Integers, State
from patterns.engine.lane import Lane, LaneInput, Member
from patterns.engine.packed import Packed
from patterns.engine.pools import reached
from patterns.engine.records import Layout, moved
from patterns.engine.ruleset import KERNEL_STATE as MAGIC
from patterns.engine.running import Counts
from patterns.errors import StateError
from patterns.scene.site import Site

_POOLS = ("cells", "attempts", "threads", "registers", "traces")
_NARROW = tuple(np.iinfo(width) for width in (np.int8, np.int16, np.int32))


@dataclass(slots=True)
class Saved:
    """What was saved of a rule.

    Attributes:
        header: What is not a table.
        tables: The rows that wait, the partitions, their last rows and tails, and the kernel's pools.
    """

    header: dict[str, Any]
    tables: dict[str, pa.Table]


def saved_lane(lane: Lane, name: str) -> bytes:
    """What the lane remembers of the rule."""
    lane.prepare()
    at = lane.place_of(name)
    member = lane.members[at]
    pools = _pools_of(lane.state, at)
    partitions = _partitions(lane, at, pools)
    numbers = np.full(len(lane.state.first_cells), -1, dtype=np.int64)
    numbers[partitions] = np.arange(len(partitions))
    pools["cells"][:, k.C_PARTITION] = numbers[pools["cells"][:, k.C_PARTITION]]
    last_rows = _own_last_rows(lane, member, lane.state.last_rows[partitions])
    texts = _own_texts(lane, member, pools["registers"], last_rows)
    keys = lane.keys.kept(partitions)
    header = {
        "rule": member.bound.rule.hash,
        "columns": {name: kind.name for name, kind in member.bound.columns.items()},
        "streams": lane.streams.names,
        "site": lane.site.to_json(),
        "clock": lane.clock.to_json(),
        "emitter": member.emitter.to_json(),
        "counts": [lane.counts.rows, lane.counts.late, member.matches],
        "texts": texts,
        "key_texts": keys.texts.known,
        "due_us": int(lane.state.controls[k.DUE]),
        "begins_us": member.begins_us,
    }
    tables = {each: table_of(pools[each]) for each in _POOLS}
    tables |= {
        "keys": table_of(keys.table[: keys.count]),
        "last_rows": table_of(last_rows),
        "last_ordinals": table_of(lane.state.last_ordinals[partitions][:, None]),
        "tails": lane.tails.table(partitions, _own_columns(member)),
    }
    return _encoded(Saved(header, tables), _waiting_encoded(lane, member))


def encoded(saved: Saved, waiting: pa.Table | None) -> bytes:
    """The state as bytes; `waiting`: the rows that wait, in the total order."""
    return _encoded(saved, _stream(pa.table({}) if waiting is None else waiting))


def restored(
    name: str, packed: Packed, state: bytes, lanes: list[Lane], clock: Callable[[], float], *, is_strict: bool
) -> Lane:
    """The lane that goes on from the state: one of these if it stands at the same place, else a new one.

    Raises:
        StateError: Not a saved state, or that of another rule, version or set of columns.
    """
    saved = decoded(state)
    header = saved.header
    bound = packed.bound
    if header["rule"] != bound.rule.hash:
        raise StateError(f"the saved state is of rule hash {header['rule']}, this rule's is {bound.rule.hash}")
    if header["columns"] != {column: kind.name for column, kind in bound.columns.items()}:
        raise StateError("the saved state is of the same rule over other columns")
    site = Site.from_json(header["site"])
    for lane in lanes:
        if lane.has_room(packed) and _stands_at(lane, packed, saved, site):
            _admit(lane, name, packed, saved)
            return lane
    lane = Lane(LaneInput.of(packed), site, clock, is_strict=is_strict)
    lane.join(name, packed)
    lane.prepare()
    _begin(lane, saved)
    _insert(lane, 0, saved)
    return lane


# Saving.


def _pools_of(state: State, rule: int) -> dict[str, Integers]:
    """The pools with what is the rule's alone, numbered anew."""
    marks = [np.zeros(len(pool), dtype=np.bool_) for pool in (state.cells, state.attempts, state.threads, state.traces)]
    k.mark_rule(state, rule, *marks)
    cells, attempts, threads, traces = (np.flatnonzero(mark) for mark in marks)
    pools = {
        "cells": state.cells[cells],
        "attempts": state.attempts[attempts],
        "threads": state.threads[threads],
        "registers": state.registers[threads],
        "traces": state.traces[traces],
    }
    for name, columns, used, total in (
        ("cells", (k.C_FIRST, k.C_LAST), attempts, len(state.attempts)),
        ("attempts", (k.A_NEXT,), attempts, len(state.attempts)),
        ("attempts", (k.A_THREAD, k.E_THREAD), threads, len(state.threads)),
        ("threads", (k.T_NEXT,), threads, len(state.threads)),
        ("threads", (k.T_TRACE,), traces, len(state.traces)),
        ("traces", (k.X_PARENT,), traces, len(state.traces)),
    ):
        numbers = np.full(total + 1, -1, dtype=np.int64)
        numbers[used] = np.arange(len(used))
        for column in columns:
            pools[name][:, column] = numbers[pools[name][:, column]]
    return pools


def _partitions(lane: Lane, at: int, pools: dict[str, Integers]) -> Integers:
    """The partitions that anything is remembered of for the rule."""
    is_wanted = np.zeros(lane.keys.count, dtype=np.bool_)
    watermark_us = lane.clock.watermark_us
    until = int(k.NEVER) * -1 if watermark_us is None else watermark_us
    k.wanted_by(lane.tables, lane.state, lane.keys.count, until, lane.layout.words, at, is_wanted)
    is_wanted[pools["cells"][:, k.C_PARTITION]] = True
    partitions: Integers = np.flatnonzero(is_wanted)
    return partitions


def own_layout(packed: Packed) -> Layout:
    """The layout of a lane of this rule alone."""
    layout = Layout()
    layout.add(packed.predicates, packed.slots, packed.zones)
    return layout


def _own_last_rows(lane: Lane, member: Member, rows: Integers) -> Integers:
    """The last rows as a lane of this rule alone would hold them."""
    packed = member.packed
    return moved(rows, lane.layout, own_layout(packed), packed.predicates, packed.slots)


def _own_texts(lane: Lane, member: Member, registers: Integers, last_rows: Integers) -> list[str]:
    """The texts that the rule remembers; numbers in these tables are changed to places in this list."""
    columns = _text_columns(member.packed, registers, last_rows, own_layout(member.packed))
    if not columns:
        return []
    known = len(lane.texts.known)
    used, places = np.unique(np.concatenate(columns), return_inverse=True)
    is_text = (used >= 0) & (used < known)
    texts = [lane.texts.known[number] for number in used[is_text].tolist()]
    numbers = np.where(is_text, np.cumsum(is_text) - 1, 0)[places]
    at = 0
    for column in columns:
        column[:] = numbers[at : at + len(column)]
        at += len(column)
    return texts


def _text_columns(packed: Packed, registers: Integers, last_rows: Integers, layout: Layout) -> list[Integers]:
    """The columns that hold numbers of texts, as views."""
    bound = packed.bound
    columns = [
        registers[:, at] for at, register in enumerate(bound.registers)
        if register.slot is not None and register.how != "values" and bound.slots[register.slot].kind is Kind.STRING
    ]  # fmt: skip
    first = k.R_BITS + layout.words
    return columns + [
        last_rows[:, first + number] for slot, number in layout.slots.items()
        if slot.kind is Kind.STRING and slot in packed.slots
    ]  # fmt: skip


def _own_columns(member: Member) -> list[str]:
    return sorted(member.bound.columns)


def _waiting_encoded(lane: Lane, member: Member) -> bytes:
    """The rows that wait, encoded: once for all rules that read the same columns and are saved at once."""
    names = [STREAM, TIME, SEQUENCE, *(name for name in lane.columns if name in member.bound.columns)]
    tables, known, encoded = lane.waiting_saved
    is_known = known == names and len(tables) == len(lane.waiting)
    if not is_known or any(each is not other for each, other in zip(tables, lane.waiting, strict=True)):
        encoded = _stream(_waiting(lane, names))
        lane.waiting_saved = list(lane.waiting), names, encoded
    return encoded


def _waiting(lane: Lane, names: list[str]) -> pa.Table:
    """The rows that wait, in the total order, with these columns."""
    if not lane.waiting:
        return pa.table({})
    rows = pa.concat_tables([table.select(names) for table in lane.waiting]).combine_chunks()
    rank = lane.streams.ranks()[rows.column(STREAM).to_numpy()]
    return rows.take(pa.array(np.lexsort((rows.column(SEQUENCE).to_numpy(), rank, rows.column(TIME).to_numpy()))))


# Restoring.


def _stands_at(lane: Lane, packed: Packed, saved: Saved, site: Site) -> bool:
    """Whether the lane has seen exactly the rows that the saved rule had seen."""
    header = saved.header
    rows, late, _ = header["counts"]
    is_same = (
        lane.input == LaneInput.of(packed)
        and (lane.counts.rows, lane.counts.late) == (rows, late)
        and lane.clock.to_json() == header["clock"]
        and lane.streams.names == header["streams"]
        and lane.site == site
        and lane.tails.covers(packed.bound.reach, lane.looked_back_at(packed))
        and lane.place_if_any(header["rule"]) is None
    )
    return is_same and _waits_alike(lane, saved.tables["waiting"])


def _waits_alike(lane: Lane, waiting: pa.Table) -> bool:
    if sum(table.num_rows for table in lane.waiting) != waiting.num_rows:
        return False
    if waiting.num_rows == 0:
        return True
    (rows,) = lane.waiting if len(lane.waiting) == 1 else (None,)
    return rows is not None and all(
        np.array_equal(rows.column(name).to_numpy(), waiting.column(name).to_numpy())
        for name in (STREAM, TIME, SEQUENCE)
    )


def _admit(lane: Lane, name: str, packed: Packed, saved: Saved) -> None:
    """The rule goes on among the lane's; if it cannot, the lane is as it was."""
    lane.prepare()
    try:
        lane.admit(name, packed)
        _insert(lane, len(lane.members) - 1, saved)
    except Exception:  # Whatever it is, the lane goes on without the rule; the caller is told.
        lane.drop(name)
        raise


def _begin(lane: Lane, saved: Saved) -> None:
    """A lane that has seen nothing stands where the saved rule stood."""
    header = saved.header
    lane.streams.take(header["streams"])
    lane.clock = Clock(lane.input.lateness_us, lane.input.idle_us)
    lane.clock.restore(header["clock"])
    lane.counts = Counts(header["counts"][0], header["counts"][1])
    lane.waiting = [saved.tables["waiting"]] if saved.tables["waiting"].num_rows else []


def _insert(lane: Lane, at: int, saved: Saved) -> None:
    """The lane remembers what was saved of the rule, which is its last."""
    header, member = saved.header, lane.members[at]
    member.emitter.restore(header["emitter"])
    member.matches = header["counts"][2]
    member.begins_us = header.get("begins_us")
    waiting = saved.tables["waiting"]
    if waiting.num_rows:
        (rows,) = lane.waiting
        # As rows come, so that those that waited stand beside those that come.
        names = [STREAM, TIME, SEQUENCE, *(n for n in lane.columns if n in {*rows.column_names, *waiting.column_names})]
        columns = [(rows if name in rows.column_names else waiting).column(name) for name in names]
        lane.waiting = [pa.table(columns, names=names)]
    pools = {name: integers_of(saved.tables[name]) for name in _POOLS}
    keys = Keys(lane.input.kinds)
    keys.texts = Texts(header["key_texts"])
    table = integers_of(saved.tables["keys"])
    partitions = lane.keys.numbers_of(table, keys.texts)
    lane.make_room()
    packed, own = member.packed, own_layout(member.packed)
    last_rows = integers_of(saved.tables["last_rows"])
    texts = np.array([lane.texts.number(text) for text in header["texts"]] or [0], dtype=np.int64)
    for column in _text_columns(packed, pools["registers"], last_rows, own):
        column[:] = texts[column]
    ordinals = integers_of(saved.tables["last_ordinals"])[:, 0]
    known = lane.state.last_ordinals[partitions]
    _renumber_rows(pools, np.where(known < 0, 0, known - ordinals))
    _insert_rows(lane, packed, partitions, last_rows, ordinals, own)
    lane.tails.insert(partitions, saved.tables["tails"])
    lane.state = _with_pools(lane.state, at, pools, partitions, header["due_us"])
    for place, each in enumerate(lane.members):
        if each.begins_us is not None:
            lane.state = _begun(lane.state, place, lane.keys.count, each.begins_us)


def _renumber_rows(pools: dict[str, Integers], more: Integers) -> None:
    """Adds to the numbers of the rows that each partition's records speak of: other rules counted from another row."""
    if not more.any():
        return
    cells, attempts, threads, traces = (pools[name] for name in ("cells", "attempts", "threads", "traces"))
    of_cells = more[cells[:, k.C_PARTITION]]
    cells[:, k.C_RESUME] += of_cells
    of_attempts = reached(len(attempts), (cells[:, k.C_FIRST], of_cells), attempts[:, k.A_NEXT])
    attempts[:, [k.A_ORDINAL, k.E_ORDINAL]] += of_attempts[:, None]
    of_threads = reached(len(threads), (attempts[:, k.A_THREAD], of_attempts), threads[:, k.T_NEXT])
    has_ending = attempts[:, k.E_THREAD] >= 0
    of_threads[attempts[has_ending, k.E_THREAD]] = of_attempts[has_ending]
    traces[:, k.X_ORDINAL] += reached(len(traces), (threads[:, k.T_TRACE], of_threads), traces[:, k.X_PARENT])


def _insert_rows(
    lane: Lane, packed: Packed, partitions: Integers, last_rows: Integers, ordinals: Integers, own: Layout
) -> None:
    state, layout = lane.state, lane.layout
    own_rows = moved(last_rows, own, layout, packed.predicates, packed.slots)
    is_new = state.last_ordinals[partitions] < 0
    others = sum(1 << number for slot, number in layout.slots.items() if slot not in packed.slots)
    state.last_rows[partitions[is_new]] = own_rows[is_new]
    state.last_rows[partitions[is_new], k.R_NULLS] |= others
    state.last_ordinals[partitions[is_new]] = ordinals[is_new]
    known, mine = partitions[~is_new], own_rows[~is_new]
    first = k.R_BITS + layout.words
    held = state.last_rows[known]
    held[:, k.R_BITS : first] |= mine[:, k.R_BITS : first]
    said = {slot for member in lane.members[:-1] for slot in member.packed.slots}
    for slot in packed.slots:
        number = layout.slots[slot]
        bit = np.int64(1) << number
        # A rule that came from the general matcher says NULL of a row that others know.
        is_mine = mine[:, k.R_NULLS] & bit == 0 if slot in said else np.ones(len(mine), dtype=np.bool_)
        held[is_mine, first + number] = mine[is_mine, first + number]
        held[is_mine, k.R_NULLS] = (held[is_mine, k.R_NULLS] & ~bit) | (mine[is_mine, k.R_NULLS] & bit)
    state.last_rows[known] = held


def _begun(state: State, rule: int, partitions: int, begins_us: int) -> State:
    """The state in which the rule begins no match at rows before this time, which others of the lane remember."""
    is_open = (state.last_ordinals[:partitions] >= 0) & (state.last_rows[:partitions, k.R_TIME] < begins_us)
    is_open[state.cells[state.cells[:, k.C_RULE] == rule, k.C_PARTITION]] = False
    begun = np.flatnonzero(is_open)
    cells = np.zeros((len(begun), k.C_WIDTH), dtype=np.int64)
    cells[:, k.C_RULE], cells[:, k.C_PARTITION], cells[:, k.C_NEXT] = rule, begun, state.first_cells[begun]
    cells[:, k.C_FIRST] = cells[:, k.C_LAST] = -1
    cells[:, k.C_RESUME] = state.last_ordinals[begun] + 1
    state.first_cells[begun] = len(state.cells) + np.arange(len(begun))
    return state._replace(cells=np.concatenate((state.cells, cells)))


def _with_pools(state: State, rule: int, pools: dict[str, Integers], partitions: Integers, due_us: int) -> State:
    """The state with these records as well, behind those that are there."""
    base = {name: len(getattr(state, name)) for name in _POOLS}
    cells, attempts, threads, traces = (pools[name] for name in ("cells", "attempts", "threads", "traces"))
    for table, columns, name in (
        (cells, (k.C_FIRST, k.C_LAST), "attempts"), (attempts, (k.A_NEXT,), "attempts"),
        (attempts, (k.A_THREAD, k.E_THREAD), "threads"), (threads, (k.T_NEXT,), "threads"),
        (threads, (k.T_TRACE,), "traces"), (traces, (k.X_PARENT,), "traces"),
    ):  # fmt: skip
        for column in columns:
            table[:, column] = np.where(table[:, column] < 0, -1, table[:, column] + base[name])
    cells[:, k.C_RULE] = rule
    cells[:, k.C_PARTITION] = partitions[cells[:, k.C_PARTITION]]
    cells[:, k.C_NEXT] = state.first_cells[cells[:, k.C_PARTITION]]
    state.first_cells[cells[:, k.C_PARTITION]] = base["cells"] + np.arange(len(cells))
    state.controls[k.DUE] = min(int(state.controls[k.DUE]), due_us)
    registers = np.zeros((len(threads), state.registers.shape[1]), dtype=np.int64)
    width = min(pools["registers"].shape[1], registers.shape[1])
    registers[:, :width] = pools["registers"][:, :width]
    return state._replace(
        cells=np.concatenate((state.cells, cells)),
        attempts=np.concatenate((state.attempts, attempts)),
        threads=np.concatenate((state.threads, threads)),
        registers=np.concatenate((state.registers, registers)),
        traces=np.concatenate((state.traces, traces)),
    )


# Bytes.


def table_of(integers: Integers) -> pa.Table:
    """The integers as columns."""
    columns = [_narrowed(np.ascontiguousarray(integers[:, at])) for at in range(integers.shape[1])]
    return pa.table([pa.array(column) for column in columns], names=[str(at) for at in range(len(columns))])


def _narrowed(column: Integers) -> NDArray[np.signedinteger[Any]]:
    """The column in as few bytes a value as it fits in: compressing is what saving takes longest for."""
    least, most = int(column.min(initial=0)), int(column.max(initial=0))
    fits = (each for each in _NARROW if each.min <= least and most <= each.max)
    width = next(fits, None)
    return column if width is None else column.astype(width.dtype)


def integers_of(table: pa.Table) -> Integers:
    """The columns as integers."""
    integers = np.empty((table.num_rows, table.num_columns), dtype=np.int64)
    for at in range(table.num_columns):
        integers[:, at] = table.column(at).to_numpy()
    return integers


def _encoded(saved: Saved, waiting: bytes) -> bytes:
    streams = {name: _stream(table) for name, table in saved.tables.items()} | {"waiting": waiting}
    said = {**saved.header, "tables": {name: len(each) for name, each in streams.items()}}
    header = zstandard.compress(json.dumps(said, separators=(",", ":"), ensure_ascii=False).encode())
    return b"".join((MAGIC, struct.pack(">I", len(header)), header, *streams.values()))


def _stream(table: pa.Table) -> bytes:
    options = pa.ipc.IpcWriteOptions(compression="zstd", use_threads=False)
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, table.schema, options=options) as writer:
        writer.write_table(table)
    encoded: bytes = sink.getvalue().to_pybytes()
    return encoded


def decoded(state: bytes) -> Saved:
    """The state from its bytes.

    Raises:
        StateError: They are not a saved state, or of another layout.
    """
    if not state.startswith(MAGIC):
        raise StateError(
            f"a saved state of this version begins with {MAGIC!r}, got {state[:4]!r}. "
            "Next: run the rule anew over the log"
        )
    try:
        (length,) = struct.unpack(">I", state[4:8])
        header = json.loads(zstandard.decompress(state[8 : 8 + length]))
        at, tables = 8 + length, {}
        for name, size in header.pop("tables").items():
            tables[name] = pa.ipc.open_stream(state[at : at + size]).read_all()
            at += size
        if at != len(state):
            raise ValueError(f"{len(state)} bytes, wanted {at}")
    except (zstandard.ZstdError, struct.error, ValueError, KeyError, pa.ArrowInvalid, OSError) as error:
        raise StateError(f"the saved state is damaged: {error}") from error
    return Saved(header, tables)
