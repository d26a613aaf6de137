"""From where on a log holds a station's streams with all their payloads, as it must to vouch for them.

Contract: a segment is looked at once, however often that is asked: what was looked at is kept in the log's database,
as a checkpoint whose state says for each stream which range it was, and the last segment without payload there. Where
that payload came back, the range is looked at again.
"""

import json
from dataclasses import dataclass

from events import Run, Station, StreamName
from store import Log
from sync.runs import Point, StreamKey

_NAME = "whole"
_PLACE = (
    "g.stream_id = (select id from streams where station = %(station)s and source = %(source)s and type = %(type)s "
    "and epoch = %(epoch)s)"
)


@dataclass(frozen=True, slots=True)
class _Looked:
    """What was looked at of a stream, and what was found."""

    after: Point
    """behind which the range begins"""
    sequence: int
    """up to which it goes"""
    whole_after: Point
    """behind which every segment of the range has its payload"""


class Wholeness:
    """Looks through a station's streams in a log. Not for several threads at once."""

    def __init__(self, log: Log, station: Station) -> None:
        self._log = log
        self._name = f"{_NAME}:{station}"
        self._looked = _looked_in(log.checkpoint(self._name).state)
        self._is_new = False

    def after(self, key: StreamKey, run: Run, sequence: int) -> Point:
        """Behind which point of the run every segment up to the sequence has its payload.

        Raises:
            ChainBroken: A segment in a sealed file cannot be read.
            LogUnavailable: The database is away.
        """
        begin = Point(run.after, run.after_hash)
        before = self._looked.get(key)
        if before is None or before.after != begin or before.sequence > sequence or self._is_back(key, before):
            before = _Looked(begin, run.after, begin)
        if before.sequence < sequence:
            found = _last_hollow(self._log, key, before.sequence, sequence)
            self._looked[key] = before = _Looked(begin, sequence, found or before.whole_after)
            self._is_new = True
        return before.whole_after

    def save(self) -> None:
        """Keep what was looked at.

        Raises:
            LogUnavailable: The database is away.
        """
        if self._is_new:
            position = self._log.head()
            with self._log.transaction() as transaction:
                transaction.save_checkpoint(self._name, position, _state(self._looked))

    def _is_back(self, key: StreamKey, looked: _Looked) -> bool:
        """Whether the last segment without payload has it again; in a sealed file it does not come back."""
        if looked.whole_after == looked.after:
            return False
        with self._log.connection() as connection:
            found = connection.execute(
                f"select from segments g where {_PLACE} and g.first_sequence + g.event_count - 1 = %(last)s "
                "and g.first_sequence <= %(last)s and g.payload is not null",
                {**_names(key), "last": looked.whole_after.sequence},
            ).fetchone()
        return found is not None


def _last_hollow(log: Log, key: StreamKey, after: int, until: int) -> Point | None:
    """Where the last segment without payload ends of those that begin behind `after`, up to `until`."""
    with log.connection() as connection:
        row = connection.execute(
            "select coalesce(sum(g.event_count), 0)::bigint, "
            "max(g.first_sequence + g.event_count - 1) filter (where g.payload is null), "
            "(array_agg(g.chain_hash order by g.first_sequence desc) filter (where g.payload is null))[1] "
            f"from segments g where {_PLACE} and g.first_sequence > %(after)s and g.first_sequence <= %(until)s",
            {**_names(key), "after": after, "until": until},
            binary=True,
        ).fetchone()
    assert row is not None, "an aggregate answers in one row"
    events, last, chain_hash = row
    if events < until - after:  # the rest is in sealed files, and need not be below
        return _last_hollow_read(log, key, after, until)
    return None if last is None else Point(last, bytes(chain_hash))


def _last_hollow_read(log: Log, key: StreamKey, after: int, until: int) -> Point | None:
    """The same, read a segment at a time."""
    last: Point | None = None
    for segment in log.read(key.stream, after + 1, epoch=key.epoch, with_hollow=True):
        if segment.header.first_sequence > until:
            break
        if not segment.has_payload:
            last = Point(segment.header.last_sequence, segment.chain_hash)
    return last


def _names(key: StreamKey) -> dict[str, object]:
    stream = key.stream
    return {"station": stream.station, "source": stream.source, "type": stream.type, "epoch": key.epoch}


def _state(looked: dict[StreamKey, _Looked]) -> bytes:
    rows = [
        [str(key.stream), key.epoch, *_point(each.after), each.sequence, *_point(each.whole_after)]
        for key, each in sorted(looked.items())
    ]
    return json.dumps(rows, separators=(",", ":")).encode()


def _point(point: Point) -> tuple[int, str]:
    return point.sequence, point.chain_hash.hex()


def _looked_in(state: bytes) -> dict[StreamKey, _Looked]:
    return {
        StreamKey(StreamName.parse(stream), epoch): _Looked(
            Point(after, bytes.fromhex(after_hash)), sequence, Point(whole_after, bytes.fromhex(whole_hash))
        )
        for stream, epoch, after, after_hash, sequence, whole_after, whole_hash in json.loads(state or b"[]")
    }
