"""Payloads that leave the log: what stays, what is read, what verifies, and what may come back."""

from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import psycopg
import pytest

from events import Draft, PayloadGone, Segment, SegmentsPruned, decode
from store import BadRequest, Log, Projector, Sealer, StoreError, Subscription, back_up, open_log, restore, verify
from store.payloads import may_leave, put_back, reclaim, repair, take_off, weights
from tests.conftest import Server
from tests.store.samples import GATE, NOON, YARD, append, draft_of, on_both, owner, query
from tests.store.tiered import seal_all

FUTURE = datetime.now(UTC) + timedelta(days=9)


@pytest.fixture
def empty(server: Server) -> Iterator[str]:
    """Address of another log, an empty one."""
    name = server.create_database()
    yield server.dsn(name)
    server.drop_database(name)


def hollow(log: Log, *positions: int) -> None:
    """Take the payloads off, and record it."""
    with log.transaction() as transaction:
        take_off(transaction, positions)
        gone = [each for each in log.read_all(with_hollow=True) if each.position in positions]
        transaction.append([draft_of(pruned(each), "sync") for each in gone])


def points_of(log: Log, *, with_hollow: bool = False) -> list[Segment]:
    return list(log.read_all(types=["track_point"], with_hollow=with_hollow))


def pruned(segment: Segment) -> SegmentsPruned:
    return SegmentsPruned(
        time=NOON,
        stream=str(segment.stream),
        stream_epoch=segment.header.epoch,
        first_sequence=segment.header.first_sequence,
        last_sequence=segment.header.last_sequence,
        segments=1,
        payload_bytes=len(segment.payload),
        statement_hash="ab" * 32,
    )


@on_both
def test_header_hashes_position_and_time_of_recording_stay(log: Log) -> None:
    append(log, GATE, 3, 2)
    before = list(log.read_all())
    with log.transaction() as transaction:
        freed = take_off(transaction, [1, 77])
    assert (freed.segments, freed.payload_bytes) == (1, len(before[0].payload))
    after = list(log.read_all(with_hollow=True))
    assert [each.has_payload for each in after] == [False, True]
    kept = [(each.header, each.payload_hash, each.chain_hash, each.position, each.recorded_at) for each in before]
    assert [(s.header, s.payload_hash, s.chain_hash, s.position, s.recorded_at) for s in after] == kept


def test_who_decodes_passes_it_over_and_who_asks_for_it_is_told(log: Log) -> None:
    append(log, GATE, 3, 2, 4)
    hollow(log, 1, 2)
    assert [each.position for each in points_of(log)] == [3]
    assert [each.header.first_sequence for each in log.read(GATE)] == [6]
    assert [each.header.first_sequence for each in log.read(GATE, 4, with_hollow=True)] == [4, 6]
    with Subscription(log, "someone", types=["track_point"]) as subscription:
        assert [each.position for each in subscription.poll().segments] == [3]
        assert subscription.position == log.head()
    projector = Projector(log)
    projector.catch_up()
    projector.close()
    assert query(log, "select count(*) from track_point") == [(4,)]
    with pytest.raises(PayloadGone, match=r"brno/gate/track_point from sequence 1: .*Next: vian sync repair"):
        decode(next(log.read(GATE, with_hollow=True)), log.catalogue)


def test_a_stream_goes_on_behind_it_and_a_repeated_append_is_recognised(log: Log) -> None:
    append(log, GATE, 3)
    sent = next(log.read(GATE))
    hollow(log, 1)
    append(log, GATE, 2)
    assert verify(log).is_sound
    assert log.stream_head(GATE).sequence == 5
    assert log.stream_head(GATE, at_position=1).chain_hash == sent.chain_hash


def test_only_the_bytes_that_its_hash_names_come_back(log: Log) -> None:
    append(log, GATE, 3, 2)
    first, second = points_of(log)
    hollow(log, 1)
    with pytest.raises(BadRequest, match="the payload was not put back"), log.transaction() as transaction:
        put_back(transaction, 1, second.payload)
    with log.transaction() as transaction:
        put_back(transaction, 1, first.payload)
    assert points_of(log) == [first, second]


def test_what_was_sealed_meanwhile_is_not_said_to_be_repaired(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 3)
    (segment,) = points_of(log)
    seal_all(log, tmp_path)
    with pytest.raises(BadRequest, match="only 0 are here"), log.transaction() as transaction:
        repair(transaction, {1: segment})


def test_what_comes_back_while_it_is_sealed_is_not_lost_again(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 3, 2)
    first, second = points_of(log)
    hollow(log, 1)

    def bring_back(step: str) -> None:
        if step == "written":
            with log.transaction() as transaction:
                put_back(transaction, 1, first.payload)

    sealer = Sealer(log, str(tmp_path), on_step=bring_back)
    with pytest.raises(StoreError, match="came back"):
        list(sealer.seal(FUTURE))
    assert points_of(log) == [first, second]
    seal_all(log, tmp_path)
    assert points_of(log) == [first, second]


@on_both
def test_what_nobody_recorded_is_a_fault_and_what_is_recorded_is_counted(log: Log) -> None:
    append(log, GATE, 3, 2, 4)
    hollow(log, 1)
    found = verify(log)
    assert (found.is_sound, found.hollow, found.unrecorded) == (True, 1, 0)
    with log.transaction() as transaction:
        take_off(transaction, [2])
    (broken,) = verify(log, station="brno").broken
    assert (broken.stream, broken.first_sequence) == (GATE, 4)
    assert broken.reason.startswith("sequences 4 to 5 of epoch 1 have no payload, and no event says")
    found = verify(log, station="central")  # there the station's record may be on its way
    assert (found.is_sound, found.hollow, found.unrecorded) == (True, 2, 1)


def test_a_record_of_another_station_excuses_nothing(log: Log) -> None:
    append(log, GATE, 3)
    with log.transaction() as transaction:
        transaction.append([draft_of(pruned(next(log.read(GATE))), "sync", "praha")])
        take_off(transaction, [1])
    assert not verify(log).is_sound


def test_the_weights_of_what_could_go_end_at_the_first_that_is_too_young(log: Log) -> None:
    append(log, GATE, 3)
    append(log, YARD, 2)
    hollow(log, 1)
    (weight,) = [each for each in weights(log, 0, FUTURE, 10) if may_leave(each.stream)]
    assert (weight.stream, weight.first_sequence, weight.last_sequence) == (YARD, 1, 2)
    assert weight.payload_bytes == len(next(log.read(YARD)).payload)
    assert weights(log, 0, weight.recorded_at, 10) == []
    assert [each.stream.source for each in weights(log, weight.position, FUTURE, 10)] == ["sync"]


@on_both
def test_nobody_but_the_pruner_takes_off_or_puts_back(log: Log) -> None:
    append(log, GATE, 3)
    for role in ("vian_writer", "vian_reader", "vian_archiver"):
        for call in ("prune_segments('{1}')", "restore_payload(1, '')", "plan_resealing('x')"):
            with owner(log) as connection:
                connection.execute(f"set role {role}")
                with pytest.raises(psycopg.errors.InsufficientPrivilege):
                    connection.execute(f"select {call}")
    assert len(list(log.read_all())) == 1


def test_the_flag_of_the_functions_does_not_outlive_their_transaction(log: Log) -> None:
    append(log, GATE, 3)
    hollow(log, 1)
    with owner(log) as connection, pytest.raises(psycopg.Error, match="the log is append-only"):
        connection.execute("update segments set payload = 'x'")


def test_the_room_of_what_went_is_used_again(log: Log) -> None:
    append(log, GATE, *[400] * 40)
    (before,) = query(log, "select pg_total_relation_size('segments')")
    hollow(log, *range(1, 41))
    reclaim(log)
    (after,) = query(log, "select pg_total_relation_size('segments')")
    assert after < before  # all of it went, so the end of the table did, and that goes back to the disk
    append(log, GATE, *[400] * 40)
    (again,) = query(log, "select pg_total_relation_size('segments')")
    assert again[0] < before[0] * 1.3


def test_it_is_sealed_and_read_from_the_sealed_file_as_it_is(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 3, 2, 4)
    hollow(log, 2)
    seal_all(log, tmp_path)
    assert verify(log).is_sound
    assert [each.position for each in points_of(log)] == [1, 3]
    assert [each.header.first_sequence for each in log.read(GATE)] == [1, 6]
    assert [each.has_payload for each in points_of(log, with_hollow=True)] == [True, False, True]


def test_a_backup_holds_it_and_a_restored_log_too(log: Log, empty: str, tmp_path: Path) -> None:
    append(log, GATE, 3, 2, 4)
    hollow(log, 2)
    back_up(log, tmp_path / "backup")
    restore(empty, tmp_path / "backup")
    with open_log(dsn=empty) as restored:
        assert verify(restored).is_sound
        assert [each.has_payload for each in points_of(restored, with_hollow=True)] == [True, False, True]


@on_both
def test_a_replica_takes_a_segment_whose_payload_was_gone_before_it_came(log: Log, make_log: Callable[[], Log]) -> None:
    append(log, GATE, 3, 2)
    hollow(log, 1)
    replica = make_log()
    for segment in log.read_all(with_hollow=True):
        header = segment.header
        times = (header.time_min, header.time_max)
        draft = Draft(
            header.stream, header.event_count, header.schema_version, *times, header.producer, segment.payload,
            segment.payload_hash,
        )  # fmt: skip
        replica.append([draft], [header.first_sequence - 1], chain_hashes=[segment.chain_hash])
    assert [each.has_payload for each in points_of(replica, with_hollow=True)] == [False, True]
    assert query(replica, "select count(*) from segments where payload is null") == [(1,)]
    found = verify(replica, station="central")
    assert (found.is_sound, found.hollow, found.unrecorded) == (True, 1, 1), (
        "that it was pruned there is no reason here"
    )
