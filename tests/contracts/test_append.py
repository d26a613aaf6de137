"""Appends: all or nothing, gapless, refused by name, and harmless when repeated."""

import hashlib
from dataclasses import replace

import pytest

from events import GENESIS, InvalidEvent, TrackPoint, batch_of, batch_of_type, chain, encode
from store import BadRequest, ChainBroken, Log, SequenceConflict
from tests.events.examples import unchecked
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append, draft, point


def test_an_empty_log_has_no_streams_and_stands_at_position_zero(log: Log) -> None:
    assert (log.head(), log.streams(), list(log.read_all())) == (0, [], [])


def test_segments_take_the_next_positions_and_sequences(log: Log) -> None:
    appended = log.append([draft(GATE, 1, 3), draft(YARD, 1, 2), draft(GATE, 4, 4)])
    assert [(a.position, a.first_sequence, a.was_there) for a in appended] == [
        (1, 1, False),
        (2, 1, False),
        (3, 4, False),
    ]
    assert [(head.stream, head.sequence) for head in log.streams()] == [(GATE, 4), (YARD, 2)]


def test_what_is_read_is_what_was_sent(log: Log) -> None:
    sent = draft(GATE, 1, 5)
    (appended,) = log.append([sent], [0])
    (segment,) = log.read_all()
    assert (segment.payload, segment.payload_hash) == (sent.payload, sent.payload_hash)
    assert segment.header.producer == sent.producer
    assert (segment.header.time_min, segment.header.time_max) == (sent.time_min, sent.time_max)
    assert (segment.header.event_count, segment.header.schema_version) == (5, 1)
    assert segment.chain_hash == appended.chain_hash == chain(GENESIS, segment.header, segment.payload_hash)
    assert segment.recorded_at.utcoffset() is not None


def test_the_database_chains_like_the_language_at_any_time_and_in_any_script(log: Log) -> None:
    previous = GENESIS
    for year in (1, 1969, 1970, 9999):
        time = NOON.replace(year=year, microsecond=999_999)
        sent = replace(
            unchecked(GATE, batch_of([point(1, time=time)])),
            producer=replace(PRODUCER, name="détecteur 検出", version="1 β"),
        )
        log.append([sent])
        segment = list(log.read(GATE))[-1]
        previous = chain(previous, segment.header, sent.payload_hash)
        assert (segment.chain_hash, segment.header.time_min) == (previous, time)


def test_an_append_at_the_expected_sequence_is_taken(log: Log) -> None:
    log.append([draft(GATE, 1, 3)], [0])
    log.append([draft(GATE, 4, 5)], [3])
    assert log.stream_head(GATE).sequence == 5


def test_an_append_that_expects_another_head_is_refused_by_name(log: Log) -> None:
    log.append([draft(GATE, 1, 2)], [0])
    for expected in (3, 4, 1000):
        with pytest.raises(SequenceConflict) as caught:
            log.append([draft(GATE, 4, 5)], [expected])
        assert (caught.value.stream, caught.value.expected, caught.value.actual) == (GATE, expected, 2)
        assert str(caught.value) == f"stream {GATE} stands at sequence 2, the append expected {expected}"
    assert log.head() == 1


def test_an_append_behind_the_end_of_a_stream_that_is_not_there_is_refused(log: Log) -> None:
    with pytest.raises(SequenceConflict) as caught:
        log.append([draft(GATE, 6, 7)], [5])
    assert (caught.value.expected, caught.value.actual) == (5, 0)
    assert log.streams() == []


def test_a_sent_segment_sent_again_is_acknowledged_and_not_stored(log: Log) -> None:
    drafts = [draft(GATE, 1, 3), draft(GATE, 4, 6), draft(YARD, 1, 1)]
    first = log.append(drafts, [0, 3, 0])
    again = log.append(drafts, [0, 3, 0])
    assert again == [replace(a, was_there=True) for a in first]
    assert log.head() == 3


def test_known_and_new_segments_may_come_in_one_call(log: Log) -> None:
    (known,) = log.append([draft(GATE, 1, 3)], [0])
    again, new = log.append([draft(GATE, 1, 3), draft(GATE, 4, 6)], [0, 3])
    assert again == replace(known, was_there=True)
    assert (new.position, new.first_sequence, new.was_there) == (2, 4, False)


def test_other_bytes_in_the_place_of_stored_ones_are_refused_with_both_hashes(log: Log) -> None:
    stored, sent = draft(GATE, 1, 3), draft(GATE, 11, 13)
    log.append([stored], [0])
    with pytest.raises(SequenceConflict) as caught:
        log.append([sent], [0])
    assert caught.value.stored_hash == stored.payload_hash.hex()
    assert caught.value.sent_hash == sent.payload_hash.hex()
    assert caught.value.stored_hash in str(caught.value)
    assert caught.value.sent_hash in str(caught.value)


def test_a_range_that_overlaps_a_stored_one_in_part_is_refused(log: Log) -> None:
    log.append([draft(GATE, 1, 3), draft(GATE, 4, 5)], [0, 3])
    for expected, first, last in ((0, 1, 2), (0, 1, 4), (1, 2, 3), (2, 3, 5), (3, 4, 4)):
        with pytest.raises(SequenceConflict, match=f"already holds other bytes after sequence {expected}"):
            log.append([draft(GATE, first, last)], [expected])
    assert log.stream_head(GATE).sequence == 5


def test_one_refused_segment_refuses_the_whole_call(log: Log) -> None:
    append(log, GATE, 2)
    with pytest.raises(SequenceConflict) as caught:
        log.append([draft(YARD, 1, 9), draft(GATE, 3, 3), draft(GATE, 4, 4)], [0, 2, 7])
    assert (caught.value.stream, caught.value.expected, caught.value.actual) == (GATE, 7, 3)
    assert log.head() == 1
    assert [head.stream for head in log.streams()] == [GATE]


def test_without_an_expected_sequence_a_segment_goes_where_the_stream_stands(log: Log) -> None:
    log.append([draft(GATE, 1, 3)])
    (appended,) = log.append([draft(GATE, 1, 3)], [None])
    assert (appended.first_sequence, appended.was_there) == (4, False)


def test_a_hundred_segments_of_many_streams_in_one_call_keep_their_order(log: Log) -> None:
    streams = [replace(GATE, source=f"cam-{i % 7}") for i in range(100)]
    appended = log.append([draft(stream, i, i) for i, stream in enumerate(streams)])
    assert [a.position for a in appended] == list(range(1, 101))
    assert [segment.stream for segment in log.read_all()] == streams


def test_an_append_of_nothing_does_nothing(log: Log) -> None:
    assert log.append([]) == []
    assert log.head() == 0


@pytest.mark.parametrize("name", ["expected", "epochs", "chain_hashes"])
def test_lists_of_another_length_than_the_drafts_are_refused(log: Log, name: str) -> None:
    with pytest.raises(BadRequest, match=f"{name} must have one entry a draft: got 2 for 1 drafts"):
        log.append([draft(GATE, 1, 1)], **{name: [1, 2]})


def test_a_replica_keeps_epoch_and_chain_of_its_origin(log: Log, make_log) -> None:
    origin = make_log()
    append(origin, GATE, 2, 3)
    segments = list(origin.read_all())
    drafts = [draft(GATE, 1, 2), draft(GATE, 3, 5)]
    log.append(drafts, [0, 2], epochs=[1, 1], chain_hashes=[s.chain_hash for s in segments])
    assert [s.chain_hash for s in log.read_all()] == [s.chain_hash for s in segments]

    log.append([drafts[0]], [0], epochs=[7])
    assert [(head.epoch, head.sequence) for head in log.streams()] == [(1, 5), (7, 2)]
    assert log.stream_head(GATE, epoch=7).sequence == 2


def test_a_chain_hash_that_comes_out_different_is_refused(log: Log) -> None:
    wrong = hashlib.sha256(b"").digest()
    with pytest.raises(ChainBroken) as caught:
        log.append([draft(YARD, 1, 1), draft(GATE, 1, 2)], chain_hashes=[None, wrong])  # type: ignore[list-item]
    assert (caught.value.stream, caught.value.position, caught.value.first_sequence) == (GATE, None, 1)
    assert "differs from the one that was sent" in str(caught.value)
    assert log.head() == 0


def test_a_known_segment_with_another_chain_hash_is_refused(log: Log) -> None:
    append(log, GATE, 2)
    with pytest.raises(ChainBroken):
        log.append([draft(GATE, 1, 2)], [0], chain_hashes=[bytes(32)])


def test_a_transaction_that_raises_leaves_no_trace_and_no_hole(log: Log) -> None:
    append(log, GATE, 1)

    def write_and_stop() -> None:
        with log.transaction() as transaction:
            transaction.append([draft(YARD, 1, 5)])
            transaction.save_checkpoint("me", 9, b"state")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        write_and_stop()
    append(log, GATE, 1)
    assert [segment.position for segment in log.read_all()] == [1, 2]
    assert log.checkpoints() == {}
    assert [head.stream for head in log.streams()] == [GATE]


def test_two_appends_in_one_transaction_see_each_other(log: Log) -> None:
    with log.transaction() as transaction:
        transaction.append([draft(GATE, 1, 2)], [0])
        (second,) = transaction.append([draft(GATE, 3, 3)], [2])
    assert (second.position, second.first_sequence) == (2, 3)


def test_recorded_at_follows_the_order_of_positions(log: Log) -> None:
    append(log, GATE, 1, 1, 1)
    times = [segment.recorded_at for segment in log.read_all()]
    assert times == sorted(times)


def test_a_stream_stood_somewhere_at_an_earlier_position(log: Log) -> None:
    append(log, GATE, 2)
    append(log, YARD, 4)
    append(log, GATE, 3)
    first, _, last = log.read_all()
    assert log.stream_head(GATE) == log.stream_head(GATE, at_position=3)
    assert (log.stream_head(GATE).sequence, log.stream_head(GATE).chain_hash) == (5, last.chain_hash)
    assert (log.stream_head(GATE, at_position=2).sequence, log.stream_head(GATE, at_position=2).chain_hash) == (
        2,
        first.chain_hash,
    )
    assert log.stream_head(GATE, at_position=0).sequence == 0


def test_an_empty_batch_is_refused_before_the_log_is_asked(log: Log) -> None:
    with pytest.raises(InvalidEvent, match="empty batch"):
        log.append([encode(GATE, batch_of_type(TrackPoint, []), PRODUCER)])
