"""Writers that are processes, with readers that follow."""

from contextlib import ExitStack

from events import Segment, StreamName, decode
from store import Log, verify
from tests.contracts.writers import SHARED, append_and_wait, append_many, follow, frame, own_stream, started
from tests.store.samples import GATE, append
from tests.store.tiered import sealing_meanwhile

WRITERS = 8
READERS = 3
EVENTS = 6_300
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


def test_readers_see_every_position_once_in_order_while_processes_write(log: Log) -> None:
    wanted = 2 * WRITERS * EVENTS
    with sealing_meanwhile(log), ExitStack() as running:
        readers = [running.enter_context(started(follow, log.dsn, f"reader-{n}", wanted)) for n in range(READERS)]
        writers = [running.enter_context(started(append_many, log.dsn, n, EVENTS)) for n in range(WRITERS)]
        for process in (*readers, *writers):
            process.wait_until_ready()
        for process in (*readers, *writers):
            process.go_on()
        seen = [reader.said() for reader in readers]
        for process in (*readers, *writers):
            process.wait_until_done()

    segments = list(log.read_all())
    assert_gapless(segments)
    for each in seen:
        assert each == [(segment.position, segment.chain_hash) for segment in segments]
    for number in range(WRITERS):
        assert frames_of(log, segments, own_stream(number)) == [frame(number, i) for i in range(1, EVENTS + 1)]
    shared = frames_of(log, segments, SHARED)
    for number in range(WRITERS):
        theirs = [one for one in shared if one // 1_000_000 == number]
        assert theirs == [frame(number, i) for i in range(1, EVENTS + 1)]
    assert len({number // 1_000_000 for number in shared[: len(shared) // 2]}) > 1, "the writers did not overlap"
    recorded = [segment.recorded_at for segment in segments]
    assert recorded == sorted(recorded)
    assert verify(log).broken == []


def test_a_writer_process_killed_in_its_transaction_leaves_nothing_and_keeps_nobody_waiting(log: Log) -> None:
    append(log, GATE, 1)
    with started(append_and_wait, log.dsn) as writer:
        writer.wait_until_ready()
        writer.kill()
    append(log, GATE, 1)
    assert_gapless(list(log.read_all()))
    assert [head.stream for head in log.streams()] == [GATE]
