"""Writers that are processes, with a reader that follows."""

from contextlib import ExitStack

from events import Segment, StreamName, decode
from store import Log, Projector, Subscription, verify
from tests.store.samples import GATE, append, on_both, query
from tests.store.writers import SHARED, append_and_wait, append_many, frame, own_stream, started

WRITERS = 4
EVENTS = 400
"""Events that each writer appends to a stream of its own, and again to the shared one."""


def frames_of(log: Log, segments: list[Segment], stream: StreamName) -> list[int]:
    return [
        number
        for segment in segments
        if segment.stream == stream
        for number in decode(segment, log.catalogue).data.column("frame").to_pylist()
    ]


def assert_gapless(segments: list[Segment]) -> None:
    """Positions follow each other from 1, and so do the sequences of each stream."""
    assert [segment.position for segment in segments] == list(range(1, len(segments) + 1))
    heads: dict[StreamName, int] = {}
    for segment in segments:
        assert segment.header.first_sequence == heads.get(segment.stream, 0) + 1
        heads[segment.stream] = segment.header.last_sequence


@on_both
def test_a_following_reader_sees_every_position_once_in_order_while_processes_write(log: Log) -> None:
    seen: list[Segment] = []
    wanted = 2 * WRITERS * EVENTS
    with Subscription(log, "reader", limit=7) as subscription, ExitStack() as running:
        writers = [running.enter_context(started(append_many, log.dsn, n, EVENTS)) for n in range(WRITERS)]
        for writer in writers:
            writer.wait_until_ready()
        for writer in writers:
            writer.go_on()
        while sum(segment.header.event_count for segment in seen) < wanted:
            delivery = subscription.poll(30)
            assert delivery.segments, "no segment within 30 s, and not all are there"
            seen += delivery.segments
        for writer in writers:
            writer.wait_until_done()
        assert subscription.poll().segments == []

    assert_gapless(seen)
    assert seen == list(log.read_all())
    for number in range(WRITERS):
        assert frames_of(log, seen, own_stream(number)) == [frame(number, i) for i in range(1, EVENTS + 1)]
    shared = frames_of(log, seen, SHARED)
    for number in range(WRITERS):
        theirs = [one for one in shared if one // 1_000_000 == number]
        assert theirs == [frame(number, i) for i in range(1, EVENTS + 1)]
    assert len({number // 1_000_000 for number in shared[: len(shared) // 2]}) > 1, "the writers did not overlap"
    recorded = [segment.recorded_at for segment in seen]
    assert recorded == sorted(recorded)
    assert verify(log).broken == []

    projector = Projector(log)
    projector.catch_up()
    projector.close()
    assert query(log, "select count(*), count(distinct id) from events") == [(wanted, wanted)]


def test_a_writer_process_killed_in_its_transaction_leaves_nothing_and_keeps_nobody_waiting(log: Log) -> None:
    append(log, GATE, 1)
    with started(append_and_wait, log.dsn) as writer:
        writer.wait_until_ready()
        writer.kill()
    append(log, GATE, 1)
    assert_gapless(list(log.read_all()))
    assert [head.stream for head in log.streams()] == [GATE]
