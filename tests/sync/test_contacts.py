"""What central keeps of the stations that it hears of."""

from datetime import UTC, datetime, timedelta

from store import Log
from sync.central.contacts import Contacts, contacts_of
from sync.protocol.wire import Hello, StreamState
from sync.runs import StreamKey
from tests.sync.conftest import BRNO, NOON, MakeDaemon, append_points, stream_of

ZEROS = "00" * 32


def hello(sequence: int, time: datetime = NOON) -> Hello:
    state = StreamState(stream=str(stream_of()), epoch=1, sequence=sequence, chain_hash=ZEROS)
    return Hello(protocols=(2,), program="vian/1\n", station=BRNO, epoch=1, time=time, streams=(state,))


def test_the_newest_hello_is_kept_with_the_clock_and_the_heads_that_it_said(log: Log) -> None:
    contacts = Contacts(log, lambda: 0.0)
    contacts.greeted(hello(3), 2, NOON)
    contacts.greeted(hello(5, NOON - timedelta(hours=1)), 2, NOON + timedelta(seconds=1))
    (found,) = contacts_of(log).values()
    assert (found.station, found.program, found.protocol, found.epoch) == (BRNO, "vian/1?", 2, 1)
    assert found.last_contact_at == found.hello_at == NOON + timedelta(seconds=1)
    assert found.clock_offset_s == 3601.0
    assert found.heads == {StreamKey(stream_of(), 1): 5}


def test_segments_move_the_last_contact_at_most_every_five_seconds(log: Log) -> None:
    clock = [0.0]
    contacts = Contacts(log, lambda: clock[0])
    contacts.greeted(hello(1), 2, NOON)
    seen = []
    for at in (4.9, 5.0, 9.9, 10.0):
        clock[0] = at
        contacts.heard(BRNO, NOON + timedelta(seconds=at))
        seen.append((contacts_of(log)[BRNO].last_contact_at - NOON).total_seconds())
    assert seen == [0.0, 5.0, 5.0, 10.0]


def test_a_daemon_that_says_hello_is_heard_of(station_log: Log, central_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, stream_of(), [3])
    make_daemon().catch_up()
    found = contacts_of(central_log)[BRNO]
    assert found.heads[StreamKey(stream_of(), 1)] == 3
    assert found.last_contact_at.tzinfo == UTC
