from collections.abc import Iterator

import psycopg
import pytest

from events import Segment, StreamName
from store import ChainBroken, Log, Verification, verify
from tests.store.samples import GATE, YARD, append, draft, on_both, owner

ROOF = StreamName.of("plzen", "roof", "track_point")


@pytest.fixture
def filled(log: Log) -> Log:
    """Positions 1 to 9: three streams in turn, of 2, 3 and 4 events a segment."""
    for _ in range(3):
        for stream, count in ((GATE, 2), (YARD, 3), (ROOF, 4)):
            append(log, stream, count)
    return log


@pytest.fixture
def tampering(filled: Log) -> "Iterator[psycopg.Connection[object]]":
    """What the database's owner can do who has disabled the trigger."""
    with owner(filled) as connection:
        connection.execute("alter table segments disable trigger user")
        yield connection


def the_break(log: Log) -> ChainBroken:
    """The one break of the log."""
    found = verify(log)
    assert not found.is_sound
    assert len(found.broken) == 1, [str(broken) for broken in found.broken]
    return found.broken[0]


@on_both
def test_a_sound_log_verifies(filled: Log) -> None:
    seen: list[Segment] = []
    assert verify(filled, seen.append) == Verification(segments=9, events=27, streams=3, position=9, broken=[])
    assert [segment.position for segment in seen] == list(range(1, 10))


@on_both
def test_an_empty_log_verifies(log: Log) -> None:
    assert verify(log) == Verification(0, 0, 0, 0, [])


def test_what_is_appended_meanwhile_is_left_for_the_next_time(filled: Log) -> None:
    found = verify(filled, lambda segment: append(filled, GATE, 1) if segment.position == 5 else None)
    assert (found.segments, found.broken) == (9, [])
    assert verify(filled).segments == 10


FLIPS = {
    "payload": "set_byte(payload, 9, get_byte(payload, 9) # 1)",
    "payload_hash": "set_byte(payload_hash, 31, get_byte(payload_hash, 31) # 128)",
    "chain_hash": "set_byte(chain_hash, 0, get_byte(chain_hash, 0) # 1)",
    "configuration_hash": "set_byte(configuration_hash, 5, get_byte(configuration_hash, 5) # 16)",
    "first_sequence": "first_sequence # 256",
    "event_count": "event_count # 1",
    "schema_version": "schema_version # 2",
    "time_min": "time_min - interval '1 microsecond'",
    "time_max": "time_max + interval '1 microsecond'",
    "producer": "overlay(producer placing 'n' from 1)",
    "producer_version": "'1.1'",
}
STRANGE = {
    "time_min": ["time_max + interval '1 second'", "'infinity'", "'-infinity'", "'20000-01-01Z'", "'0002-01-01Z BC'"],
    "time_max": ["'infinity'", "'294000-01-01Z'"],
    "recorded_at": ["'infinity'"],
    "schema_version": ["0", "-1"],
    "producer": ["E'a\\nb'", "repeat('x', 70000)"],
    "first_sequence": ["-4", "9223372036854775807"],
}


@on_both
def test_one_changed_byte_of_any_column_is_found_and_named(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("create table saved as select * from segments")
    for column, change in FLIPS.items():
        for position in (2, 5, 8):
            tampering.execute(f"update segments set {column} = {change} where position = {position}")
            broken = the_break(filled)
            assert (broken.stream.station, broken.stream, broken.position) == ("brno", YARD, position), column
            assert str(broken).startswith(f"station brno: stream {YARD}, position {position}, from sequence")
            restore(tampering, column)
    assert verify(filled).is_sound


def test_a_segment_that_moved_to_another_stream_is_found_in_both(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("insert into streams (station, epoch, source, type) values ('brno', 1, 'attic', 'track_point')")
    tampering.execute(
        "update segments set stream_id = (select id from streams where source = 'attic') where position = 5"
    )
    found = {str(broken.stream): broken.position for broken in verify(filled).broken}
    assert found == {"brno/attic/track_point": 5, str(YARD): 8}


@on_both
def test_a_value_that_no_segment_can_have_is_found_and_named(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("create table saved as select * from segments")
    for column, values in STRANGE.items():
        for value in values:
            tampering.execute(f"update segments set {column} = {value} where position = 5")
            broken = the_break(filled)
            assert (broken.stream, broken.position) == (YARD, 5), f"{column} = {value}"
            restore(tampering, column)
    assert verify(filled).is_sound


def restore(tampering: "psycopg.Connection[object]", column: str) -> None:
    tampering.execute(f"update segments g set {column} = s.{column} from saved s where s.position = g.position")


def test_two_segments_that_cannot_be_read_are_both_named(filled: Log, tampering: "psycopg.Connection[object]") -> None:
    tampering.execute("update segments set schema_version = 0 where position = 4")
    tampering.execute("update segments set time_max = 'infinity' where position = 5")
    tampering.execute("update segments set payload = '' where position = 9")
    found = verify(filled)
    assert [(broken.stream, broken.position) for broken in found.broken] == [(GATE, 4), (YARD, 5), (ROOF, 9)]
    assert found.segments == 7


def test_readers_are_told_of_a_segment_that_cannot_be_read(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("update segments set time_max = 'infinity' where position = 5")
    for reading in (filled.read_all(), filled.read(YARD)):
        with pytest.raises(ChainBroken, match="position 5"):
            list(reading)
    assert len(list(filled.read(GATE))) == 3


def test_every_byte_of_a_payload_counts(filled: Log, tampering: "psycopg.Connection[object]") -> None:
    size = len(next(iter(filled.read(YARD))).payload)
    flip = "update segments set payload = set_byte(payload, %(at)s, get_byte(payload, %(at)s) # 1) where position = 5"
    for at in (*range(0, size, 23), size - 1):
        tampering.execute(flip, {"at": at})
        assert (the_break(filled).stream, the_break(filled).position) == (YARD, 5)
        tampering.execute(flip, {"at": at})
    assert verify(filled).is_sound


@pytest.mark.parametrize("position", [2, 5, 8])
def test_a_segment_that_is_missing_is_named_by_its_own_stream_and_position(
    filled: Log, tampering: "psycopg.Connection[object]", position: int
) -> None:
    tampering.execute(f"delete from segments where position = {position}")
    broken = the_break(filled)
    assert (broken.stream, broken.position, broken.first_sequence) == (YARD, position, position - 1)
    assert f"sequences {position - 1} to {position + 1} are missing" in str(broken)


def test_a_missing_newest_segment_of_the_log_is_found(filled: Log, tampering: "psycopg.Connection[object]") -> None:
    tampering.execute("delete from segments where position = 9")
    broken = the_break(filled)
    assert (broken.stream, broken.position) == (ROOF, 9)
    assert verify(filled).position == 9


def test_a_missing_segment_whose_head_was_put_back_leaves_a_hole_that_is_found(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("delete from segments where position = 8")
    tampering.execute(
        "update streams set sequence = 6, chain_hash = "
        "(select chain_hash from segments where position = 5) where source = 'yard'"
    )
    assert "positions 8 to 8 are missing, and no stream misses them" in str(the_break(filled))
    assert the_break(filled).position == 8


def test_two_segments_of_a_stream_that_changed_places_are_found(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("update segments set position = -2 where position = 2")
    tampering.execute("update segments set position = 2 where position = 5")
    tampering.execute("update segments set position = 5 where position = -2")
    broken = the_break(filled)
    assert (broken.stream, broken.position) == (YARD, 2)


def test_two_payloads_that_changed_places_with_their_hashes_are_found(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute(
        "update segments a set payload = b.payload, payload_hash = b.payload_hash from segments b "
        "where (a.position, b.position) in ((2, 5), (5, 2))"
    )
    broken = the_break(filled)
    assert (broken.stream, broken.position) == (YARD, 2)
    assert "its header was changed" in str(broken)


def test_a_forged_segment_with_right_hashes_of_its_own_breaks_the_chain(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    forged = draft(YARD, 100, 102)
    tampering.execute(
        "update segments set payload = %s, payload_hash = %s, time_min = %s, time_max = %s where position = 5",
        (forged.payload, forged.payload_hash, forged.time_min, forged.time_max),
    )
    assert the_break(filled).position == 5


@pytest.mark.parametrize(
    "change, stream, position",
    [
        ("sequence = 100", YARD, None),
        ("sequence = 8", YARD, 8),
        ("chain_hash = set_byte(chain_hash, 3, get_byte(chain_hash, 3) # 1)", YARD, 8),
        ("station = 'praha'", StreamName.of("praha", "yard", "track_point"), 2),
        ("source = 'yarn'", StreamName.of("brno", "yarn", "track_point"), 2),
        ("type = 'track_pint'", StreamName.of("brno", "yard", "track_pint"), 2),
        ("epoch = 2", YARD, 2),
    ],
)
def test_a_changed_head_of_a_stream_is_found(
    filled: Log, tampering: "psycopg.Connection[object]", change: str, stream: StreamName, position: int | None
) -> None:
    tampering.execute(f"update streams set {change} where source = 'yard'")
    broken = the_break(filled)
    assert (broken.stream, broken.position) == (stream, position)


def test_a_head_of_a_stream_without_segments_is_found(filled: Log, tampering: "psycopg.Connection[object]") -> None:
    tampering.execute("insert into streams (station, epoch, source, type, sequence) values ('a', 1, 'b', 'c', 7)")
    broken = the_break(filled)
    assert (str(broken.stream), broken.position, broken.first_sequence) == ("a/b/c", None, 1)
    assert "position" not in str(broken)


def test_a_head_of_the_log_that_was_put_back_is_found_by_every_stream_behind_it(
    filled: Log, tampering: "psycopg.Connection[object]"
) -> None:
    tampering.execute("update log_head set position = 4")
    found = verify(filled)
    assert {broken.stream for broken in found.broken} == {GATE, YARD, ROOF}
