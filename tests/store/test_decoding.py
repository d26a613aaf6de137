import pytest

from events import Catalogue, CorruptSegment, EventBatch, UnknownType, VideoAdded, decode
from store import Log
from store.decoding import decoded
from tests.store.samples import GATE, ONE_OF_EACH, YARD, append, draft_of, owner


@pytest.mark.parametrize("threads", [1, 3])
def test_each_segment_comes_with_its_events_in_the_order_of_the_log(log: Log, threads: int) -> None:
    for stream in (GATE, YARD, GATE):
        append(log, stream, *[2] * 70)
    segments = list(log.read_all())
    found = list(decoded(segments, log.catalogue, threads))
    assert [segment for segment, _ in found] == segments
    for segment, events in found:
        assert isinstance(events, EventBatch)
        assert events.data.equals(decode(segment, log.catalogue).data)


def test_what_is_not_known_comes_with_the_reason_and_the_rest_goes_on(log: Log) -> None:
    log.append([draft_of(event) for event in ONE_OF_EACH])
    found = {segment.stream.type: events for segment, events in decoded(log.read_all(), Catalogue([VideoAdded]))}
    assert isinstance(found.pop("video_added"), EventBatch)
    assert {type(events) for events in found.values()} == {UnknownType}


def test_bytes_that_do_not_decode_are_an_error(log: Log) -> None:
    append(log, GATE, *[1] * 120)
    with owner(log) as connection:
        connection.execute("alter table segments disable trigger user")
        connection.execute("update segments set payload = 'nothing' where position = 117")
    with pytest.raises(CorruptSegment, match="from sequence 117"):
        list(decoded(log.read_all(), log.catalogue))


def test_nothing_gives_nothing(log: Log) -> None:
    assert list(decoded([], log.catalogue)) == []
