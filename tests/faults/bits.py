"""One flipped bit in what is stored: `verify` finds it and says where.

Two ways: in a value, as who has the owner's rights would change it, with every check of PostgreSQL's
own in order; and in the data files on the disk, as a failing disk does it.
"""

import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psycopg
from psycopg import sql

from events import StreamName
from store import DatabaseDamaged, Log, verify
from tests.faults.load import opened
from tests.store.samples import GATE, YARD, append, owner, query

_BYTES = ("payload", "payload_hash", "chain_hash", "configuration_hash")
_NUMBERS = ("position", "first_sequence", "event_count", "schema_version")
_TIMES = ("time_min", "time_max")
_TEXTS = ("producer", "producer_version")
SEGMENT_COLUMNS = (*_BYTES, *_NUMBERS, *_TIMES, *_TEXTS)
STREAM_COLUMNS = ("station", "source", "type", "epoch", "sequence", "chain_hash")


@dataclass(frozen=True, slots=True)
class Flip:
    """What was flipped, and what verify made of it."""

    where: str
    is_found: bool
    is_located: bool


def fill(log: Log) -> None:
    """Small segments, which lie in their rows, and large ones, which PostgreSQL keeps beside them."""
    for stream in (GATE, YARD):
        append(log, stream, 1, 30, 400, 2, 900, 3, 20, 600, 1, 5)


# In a value.


def flip_in_value(log: Log, choose: random.Random) -> Flip:
    """Flip a bit of a random value of a random segment, stream or the log's head; look; flip it back."""
    while True:
        kind = choose.choice(("segment", "segment", "segment", "stream", "head"))
        try:
            return {"segment": _in_segment, "stream": _in_stream, "head": _in_head}[kind](log, choose)
        except (psycopg.errors.IntegrityError, psycopg.errors.DataError):
            continue  # PostgreSQL cannot hold the flipped value at all


def _in_segment(log: Log, choose: random.Random) -> Flip:
    column, position = choose.choice(SEGMENT_COLUMNS), choose.randint(1, log.head())
    ((value,),) = query(log, f"select {_plain(column)} from segments where position = %s", position)
    flipped = _flipped(value, choose)
    key = flipped if column == "position" else position
    with _changed(log, "segments", column, flipped, "position", position, back=(value, key)):
        found = verify(log)
    return Flip(
        f"segments.{column} at {position}", not found.is_sound, any(each.position == position for each in found.broken)
    )


def _in_stream(log: Log, choose: random.Random) -> Flip:
    column, (number, *names) = (
        choose.choice(STREAM_COLUMNS),
        choose.choice(query(log, "select id, station, source, type from streams")),
    )
    ((value,),) = query(log, f"select {column} from streams where id = %s", number)
    ((first,),) = query(log, "select min(position) from segments where stream_id = %s", number)
    flipped = _flipped(value, choose)
    with _changed(log, "streams", column, flipped, "id", number, back=(value, number)):
        found = verify(log)
    stream = StreamName(*names)
    is_located = any(each.stream == stream or each.position == first for each in found.broken)
    return Flip(f"streams.{column} of {stream}", not found.is_sound, is_located)


def _in_head(log: Log, choose: random.Random) -> Flip:
    ((value,),) = query(log, "select position from log_head")
    flipped = _flipped(value, choose, bits=20)
    with _changed(log, "log_head", "position", flipped, "singleton", True, back=(value, True)):
        found = verify(log)
    # Positions that are not there any more, or streams of which events are missing behind the head.
    is_located = any(each.position in (min(value, flipped) + 1, None) for each in found.broken)
    return Flip("log_head.position", not found.is_sound, is_located)


class _changed:
    """The change of one value, for the length of a block, as its owner can make it."""

    def __init__(self, log: Log, table: str, column: str, value: Any, key: str, of: Any, back: tuple[Any, Any]) -> None:
        self._log, self._table, self._back = log, table, (column, back[0], key, back[1])
        self._forth = (column, value, key, of)

    def __enter__(self) -> None:
        self._set(*self._forth)

    def __exit__(self, *_: object) -> None:
        self._set(*self._back)

    def _set(self, column: str, value: Any, key: str, of: Any) -> None:
        to = "to_timestamp(0) + %s * interval '1 microsecond'" if column in _TIMES else "%s"
        with owner(self._log) as connection, connection.transaction():
            connection.execute(f"alter table {self._table} disable trigger user")
            done = connection.execute(f"update {self._table} set {column} = {to} where {key} = %s", (value, of))
            assert done.rowcount == 1
            connection.execute(f"alter table {self._table} enable trigger user")


def _plain(column: str) -> str:
    return f"(extract(epoch from {column}) * 1000000)::bigint" if column in _TIMES else column


def _flipped(value: Any, choose: random.Random, bits: int = 31) -> Any:
    if isinstance(value, int):
        return value ^ (1 << choose.randrange(bits))
    data = bytearray(value.encode() if isinstance(value, str) else value)
    data[choose.randrange(len(data))] ^= 1 << choose.randrange(7 if isinstance(value, str) else 8)
    return data.decode() if isinstance(value, str) else bytes(data)


# On the disk.


def flip_on_disk(data_dir: Path, choose: random.Random) -> Flip:
    """Flip a random bit of the files that hold the segments, with the server stopped; look; flip it back."""
    with opened(data_dir) as log:
        path, block, bit, wanted, relation = _place(log, choose)
    _flip(data_dir / "pg" / path, bit)
    try:
        with opened(data_dir) as log:
            try:
                found = verify(log)
            except DatabaseDamaged as error:
                return Flip(f"{relation} block {block}", True, f"in block {block}" in str(error) and path in str(error))
    finally:
        _flip(data_dir / "pg" / path, bit)
    is_located = any(each.position == min(wanted) for each in found.broken)
    return Flip(f"{relation} block {block}", not found.is_sound, is_located)


def _place(log: Log, choose: random.Random) -> tuple[str, int, int, set[int], str]:
    """A file, a block and a bit in it, and the positions of the segments that lie there."""
    (names,) = query(
        log,
        "select pg_relation_filepath('segments'), pg_relation_filepath(reltoastrelid), reltoastrelid::regclass::text "
        "from pg_class where oid = 'segments'::regclass",
    )
    heap, toast, toast_name = names
    with owner(log) as connection:
        connection.execute("checkpoint")
        if choose.random() < 0.5:
            rows = connection.execute("select (ctid::text::point)[0]::int, position from segments").fetchall()
            path, relation = heap, "segments"
        else:
            rows = connection.execute(
                sql.SQL(
                    "select (t.ctid::text::point)[0]::int, g.position from {} t "
                    "join segments g on pg_column_toast_chunk_id(g.payload) = t.chunk_id"
                ).format(sql.SQL(toast_name))
            ).fetchall()
            path, relation = toast, "the segments' payloads"
    block = choose.choice(sorted({block for block, _ in rows}))
    bit = (block * 8192 + choose.randrange(8192)) * 8 + choose.randrange(8)
    return path, block, bit, {position for at, position in rows if at == block}, relation


def _flip(path: Path, bit: int) -> None:
    with path.open("r+b") as file:
        file.seek(bit // 8)
        (byte,) = file.read(1)
        file.seek(bit // 8)
        file.write(bytes([byte ^ (1 << bit % 8)]))


def flip_many(
    data_dir: Path, seed: int, in_values: int, on_disk: int, show: Callable[[range], Any] = iter
) -> list[Flip]:
    """So many flips in values and so many on the disk, of a log that is made for it."""
    choose = random.Random(seed)
    flips = []
    with opened(data_dir) as log:
        fill(log)
        for _ in show(range(in_values)):
            flips.append(flip_in_value(log, choose))
        assert verify(log).is_sound, "every flip was taken back"
    for _ in show(range(on_disk)):
        flips.append(flip_on_disk(data_dir, choose))
    with opened(data_dir) as log:
        assert verify(log).is_sound, "every flip was taken back"
    return flips
