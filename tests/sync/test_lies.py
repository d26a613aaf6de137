"""A station that lies harms nobody but itself: what central takes of it, central can go on with."""

import asyncio
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

import pytest

from events import GENESIS, Header, Position, Segment, Sequence, Station, chain
from store import Log, verify
from sync.central.apply import checked_2, store_2
from sync.central.turns import WAITING_MAX, Turns
from sync.errors import Refusal
from sync.protocol.wire import RUNS_MAX, Record, encode_records
from tests.store.tiered import seal_all
from tests.sync.conftest import BRNO, NOON, PRODUCER, append_points, stream_of

OSLO = stream_of(station="oslo-1")
MAX = 2**63 - 1


@dataclass(frozen=True)
class Speaker:
    station: Station = BRNO


def hollow(
    first: int, count: int, previous: bytes = GENESIS, *, begins_run: bool = True, source: str = "gate"
) -> Record:
    """A segment without payload, of which nothing can be checked but that its hashes fit each other."""
    header = Header(stream_of(source), 1, Sequence(first), count, 1, NOON, NOON, PRODUCER)
    payload_hash = sha256(b"nothing").digest()
    chain_hash = chain(previous, header, payload_hash)
    return Record(Segment(header, b"", payload_hash, chain_hash, Position(0), NOON), previous, begins_run)


def send(log: Log, *records: Record) -> None:
    body = encode_records(records)
    store_2(log, checked_2(log, Speaker(), body, body_bytes_max=10**6, segments_max=100))


@pytest.mark.parametrize(("first", "count"), [(0, 1), (MAX, 1), (MAX - 2, 3)])
def test_sequences_that_no_log_can_hold_are_refused(central_log: Log, first: int, count: int) -> None:
    with pytest.raises(Refusal, match="wanted sequences from 1 to"):
        send(central_log, hollow(first, count))
    assert central_log.head() == 0


def test_the_last_sequences_of_all_stop_nobody(central_log: Log, tmp_path: Path) -> None:
    append_points(central_log, OSLO, [3, 2])
    send(central_log, hollow(MAX - 3, 3))
    append_points(central_log, OSLO, [3, 2])
    seal_all(central_log, tmp_path)
    append_points(central_log, OSLO, [1])
    assert [each.header.first_sequence for each in central_log.read(OSLO)] == [1, 4, 6, 9, 11]
    assert verify(central_log, station="oslo-1").is_sound


def test_no_more_runs_are_taken_than_an_answer_to_hello_can_name(central_log: Log) -> None:
    jumps = [hollow(2 * number, 1) for number in range(1, RUNS_MAX + 1)]
    send(central_log, *jumps)
    send(central_log, *jumps)  # what is there already begins no run
    with pytest.raises(Refusal, match="got 100 runs of it here and 1 more, wanted at most 100") as refused:
        send(central_log, hollow(2 * RUNS_MAX + 2, 1))
    assert refused.value.code == "too_many_runs"
    assert len(central_log.runs(stream_of(), 1)) == RUNS_MAX
    (last,) = (run for run in central_log.runs(stream_of(), 1) if run.sequence == 2 * RUNS_MAX)
    send(central_log, hollow(2 * RUNS_MAX + 1, 1, last.chain_hash, begins_run=False))


def test_no_more_streams_are_taken_than_an_answer_to_hello_can_name(
    central_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sync.central.apply.CURSORS_MAX", 2)
    append_points(central_log, OSLO, [3])
    for source in ("gate", "yard"):
        append_points(central_log, stream_of(source), [3])
    with pytest.raises(Refusal, match="got 2 streams here and 1 more, wanted at most 2") as refused:
        send(central_log, hollow(1, 1, source="door"))
    assert refused.value.code == "too_many_streams"
    assert central_log.head() == 3


def test_requests_that_follow_none_keep_no_more_than_a_few_bodies() -> None:
    turns = Turns(60.0, 60.0)

    async def many() -> None:
        waiting = [asyncio.create_task(turns.wait_until_come(BRNO, "never")) for _ in range(WAITING_MAX + 1)]
        let_on, still = await asyncio.wait(waiting, timeout=30, return_when=asyncio.FIRST_COMPLETED)
        assert (len(let_on), len(still)) == (1, WAITING_MAX)
        with turns.under_way(BRNO, "never"):
            pass
        await asyncio.wait_for(asyncio.gather(*still), 30)
        assert not turns._noted

    asyncio.run(many())
