"""How events become the data of a COPY, without a database."""

from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta

import pytest

from events import (
    SHIPPED,
    Catalogue,
    EventType,
    Header,
    Position,
    Segment,
    StreamName,
    TrackPoint,
    batch_of,
    decode,
    encode,
)
from events import Sequence as SequenceNumber
from store.rows import CHUNK_ROWS, Part, RowFormat, days_of
from tests.store.samples import GATE, NOON, PRODUCER, YARD, point

CATALOGUE = Catalogue(SHIPPED)


def part(events: Sequence[EventType], stream: StreamName = GATE, *, first: int = 1, epoch: int = 1) -> Part:
    """The events as a part of a log, at the position of their first sequence."""
    named = StreamName.of(stream.station, stream.source, type(events[0]).type_name)
    drafted = encode(named, batch_of(events), PRODUCER)
    header = Header(
        named,
        epoch,
        SequenceNumber(first),
        len(events),
        drafted.schema_version,
        drafted.time_min,
        drafted.time_max,
        PRODUCER,
    )
    segment = Segment(header, drafted.payload, drafted.payload_hash, bytes(32), Position(first), NOON)
    return Part(segment, decode(segment, CATALOGUE))


def test_rows_of_many_segments_keep_each_events_own_place() -> None:
    parts = [
        part([point(1), point(2)], first=11),
        part([point(3)], YARD, first=5, epoch=2),
        part([point(4), point(5)], first=13),
    ]
    rows = RowFormat(TrackPoint).rows(parts).to_pylist()
    places = [(row["source"], row["epoch"], row["sequence"], row["position"], row["frame"]) for row in rows]
    assert places == [
        ("gate", 1, 11, 11, 1),
        ("gate", 1, 12, 11, 2),
        ("yard", 2, 5, 5, 3),
        ("gate", 1, 13, 13, 4),
        ("gate", 1, 14, 13, 5),
    ]
    assert {row["recorded_at"] for row in rows} == {NOON}
    assert {row["subject"] for row in rows} == {"1"}


@pytest.mark.parametrize("count", [1, CHUNK_ROWS - 1, CHUNK_ROWS, 2 * CHUNK_ROWS + 1])
def test_every_event_is_in_the_data_once_however_it_is_cut_into_pieces(count: int) -> None:
    events = [point(frame) for frame in range(count)]
    data = b"".join(RowFormat(TrackPoint).copy_data([part(events)], None))
    one = b"".join(RowFormat(TrackPoint).copy_data([part(events[:1])], None))
    envelope = 19 + 2
    assert len(data) - envelope == count * (len(one) - envelope)
    half = count // 2
    if half:
        two_parts = [part(events[:half]), part(events[half:], first=half + 1)]
        assert len(b"".join(RowFormat(TrackPoint).copy_data(two_parts, None))) == len(data)


def test_only_days_that_are_retained_are_copied() -> None:
    midnight = datetime(2026, 1, 2, tzinfo=UTC)
    events = [point(max(frame, 0), time=midnight + timedelta(microseconds=frame)) for frame in (-1, 0, 1)]
    written = {
        day: len(b"".join(RowFormat(TrackPoint).copy_data([part(events)], date(2026, 1, day)))) for day in (1, 2, 3)
    }
    nothing = 19 + 2
    row = (written[1] - nothing) // 3
    assert written == {1: nothing + 3 * row, 2: nothing + 2 * row, 3: nothing}


def test_the_days_of_a_part_are_those_of_its_events() -> None:
    day = timedelta(days=1)
    assert days_of(part([point(0, time=NOON)])) == {date(2026, 1, 1)}
    assert days_of(part([point(0, time=NOON), point(1, time=NOON + day)])) == {date(2026, 1, 1), date(2026, 1, 2)}
    far = [point(0, time=NOON + 9 * day), point(1, time=NOON), point(2, time=NOON - 15_000 * day)]
    assert days_of(part(far)) == {date(2026, 1, 10), date(2026, 1, 1), (NOON - 15_000 * day).date()}
