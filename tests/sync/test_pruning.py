"""Pruning below what central countersigned: what goes, what stays, and what the log says of it."""

import json
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from events import CheckpointCountersigned, SegmentsPruned, Station, StreamName, decode, events_of
from store import ArchiveUnavailable, Log, Sealer, StoreError, verify
from store.coldtier import ArchiveHead
from store.locks import ARCHIVE, tried_lock
from store.payloads import take_off
from store.resealing import Resealer
from sync.keeping.countersigning import VOID
from sync.keeping.pruning import Pruner
from sync.plans.deriving import Deriver
from sync.plans.plan import Plan
from sync.plans.planning import set_plan
from tests.store.samples import GATE, NOON, YARD, append, draft_of, owner, query
from tests.store.tiered import seal_all
from tests.sync.conftest import MakeDaemon

BRNO = Station("brno")
LATER = datetime.now(UTC) + timedelta(days=40)
DAYS_30 = timedelta(days=30)
Countersign = Callable[..., None]


def signed(_: CheckpointCountersigned) -> bool:
    return True


def countersign(log: Log, *heads: tuple[StreamName, int], of: str = "brno") -> None:
    """What the daemon appends when central has signed that it holds the streams up to these sequences."""
    held = []
    for stream, sequence in heads:
        ends = [each for each in log.read(stream, with_hollow=True) if each.header.last_sequence == sequence]
        held.append([*str(stream).split("/")[:1], 1, stream.source, stream.type, sequence, ends[0].chain_hash.hex()])
    event = CheckpointCountersigned(
        time=NOON,
        of_station=of,
        checkpoint_sequence=1,
        statement_hash=f"{log.head():064x}",
        held=json.dumps(held),
        key_id="central",
        algorithm="ed25519",
        signature=bytes(64),
    )
    log.append([draft_of(event, "sync")])


def pruned_of(log: Log) -> list[tuple[str, int, int, int]]:
    segments = log.read_all(types=[SegmentsPruned.type_name])
    events = [event for segment in segments for event in events_of(decode(segment, log.catalogue))]
    return [
        (each.stream, each.first_sequence, each.last_sequence, each.segments)
        for each in events
        if isinstance(each, SegmentsPruned)
    ]


def whole(log: Log, stream: StreamName) -> list[bool]:
    return [each.has_payload for each in log.read(stream, with_hollow=True)]


def run(pruner: Pruner, now: datetime = LATER) -> None:
    while pruner.step(now):
        pass


def test_what_central_holds_and_is_old_goes_and_is_recorded(log: Log) -> None:
    append(log, GATE, 3, 2, 4)
    append(log, YARD, 2)
    countersign(log, (GATE, 5))
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert (whole(log, GATE), whole(log, YARD)) == ([False, False, True], [True])
    assert pruned_of(log) == [(str(GATE), 1, 5, 2)]
    found = verify(log, station="brno")
    assert (found.is_sound, found.hollow) == (True, 2)


def test_what_is_young_stays(log: Log) -> None:
    append(log, GATE, 3)
    countersign(log, (GATE, 3))
    run(Pruner(log, BRNO, DAYS_30, signed), datetime.now(UTC))
    assert whole(log, GATE) == [True]


def test_a_signature_that_does_not_hold_and_another_history_prove_nothing(log: Log) -> None:
    append(log, GATE, 3)
    countersign(log, (GATE, 3))
    run(Pruner(log, BRNO, DAYS_30, lambda _: False))
    assert whole(log, GATE) == [True]
    log.append([draft_of(other_history(), "sync")])
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert whole(log, GATE) == [True]


def other_history() -> CheckpointCountersigned:
    return CheckpointCountersigned(
        time=NOON,
        of_station="brno",
        checkpoint_sequence=1,
        statement_hash="ab" * 32,
        held=json.dumps([["brno", 1, "gate", "track_point", 3, "cd" * 32], ["brno", 1, "gate", "pose", 9, "cd" * 32]]),
        key_id="central",
        algorithm="ed25519",
        signature=bytes(64),
    )


def test_a_pruner_that_runs_takes_up_the_next_checkpoint(log: Log) -> None:
    append(log, GATE, 3, 2)
    pruner = Pruner(log, BRNO, DAYS_30, signed)
    run(pruner)
    countersign(log, (GATE, 3))
    run(pruner)
    assert whole(log, GATE) == [False, True]
    countersign(log, (GATE, 5))
    run(pruner)
    assert whole(log, GATE) == [False, False]
    assert pruned_of(log) == [(str(GATE), 1, 3, 1), (str(GATE), 4, 5, 1)]


def test_proofs_and_what_programs_read_back_stay(log: Log) -> None:
    append(log, GATE, 3)
    countersign(log, (GATE, 3))
    countersigned = StreamName.of("brno", "sync", "checkpoint_countersigned")
    countersign(log, (GATE, 3), (countersigned, 1))
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert whole(log, countersigned) == [True, True]


def test_the_outlook_says_what_would_go_and_takes_nothing(log: Log) -> None:
    append(log, GATE, 3, 2, 4)
    countersign(log, (GATE, 5))
    pruner = Pruner(log, BRNO, DAYS_30, signed)
    (span,) = pruner.outlook(LATER)
    assert (span.stream, span.first_sequence, span.last_sequence, span.segments) == (GATE, 1, 5, 2)
    assert whole(log, GATE) == [True, True, True]
    run(pruner)
    assert pruner.outlook(LATER) == []


def test_two_pruners_record_everything_once(log: Log) -> None:
    append(log, GATE, 3, 2, 4)
    countersign(log, (GATE, 9))
    first, second = (Pruner(log, BRNO, DAYS_30, signed) for _ in range(2))
    first.step(LATER)
    run(second)
    run(first)
    assert pruned_of(log) == [(str(GATE), 1, 9, 3)]


@pytest.mark.parametrize("most", [1, 2])
def test_lots_are_bounded(log: Log, monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    append(log, GATE, 3, 3, 3)
    countersign(log, (GATE, 9))
    size = len(next(log.read(GATE)).payload)
    monkeypatch.setattr("sync.keeping.pruning.BYTES_MAX", most * size + 5)
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert whole(log, GATE) == [False] * 3
    assert [segments for *_, segments in pruned_of(log)] == ([1, 1, 1] if most == 1 else [2, 1])
    assert query(log, "select count(*) from segments where payload is null") == [(3,)]


def test_of_sealed_files_what_central_holds_goes_too(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 30, 20)
    append(log, YARD, 2, 40)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    append(log, GATE, 10)
    countersign(log, (GATE, 60))
    before = list(log.read(YARD))
    sizes = [file.bytes for file in log.archive.files()]
    pruner = Pruner(log, BRNO, DAYS_30, signed)
    outlook = [(each.stream, each.first_sequence, each.last_sequence) for each in pruner.outlook(LATER)]
    assert outlook == [(GATE, 1, 60)]
    run(pruner)
    assert (whole(log, GATE), whole(log, YARD)) == ([False] * 3, [True] * 2)
    assert list(log.read(YARD)) == before
    assert pruned_of(log) == [(str(GATE), 51, 60, 1), (str(GATE), 1, 50, 2)]
    found = verify(log, station="brno")
    assert (found.is_sound, found.hollow) == (True, 3)
    (file,) = log.archive.files()
    assert file.bytes < sizes[0]
    assert [path.name for path in (tmp_path / "_sealed").iterdir()] == [file.path.split("/")[1]]
    countersign(log, (GATE, 60), (YARD, 42))
    run(pruner)
    assert whole(log, YARD) == [False] * 2
    assert verify(log, station="brno").is_sound


@pytest.mark.parametrize("between", ["a newer signature", "central lost it for a while"])
def test_sealed_files_that_wait_are_not_forgotten_when_what_is_signed_changes(
    log: Log, tmp_path: Path, between: str
) -> None:
    append(log, GATE, *[5] * 8)
    seal_all(log, tmp_path, file_bytes=2_000)
    assert len(log.archive.files()) > 1
    countersign(log, (GATE, 40))
    pruner = Pruner(log, BRNO, DAYS_30, signed)
    while all(whole(log, GATE)):
        assert pruner.step(LATER)
    assert any(whole(log, GATE))
    if between == "central lost it for a while":
        position = log.head()
        with log.transaction() as transaction:
            transaction.save_checkpoint(VOID, position)
        run(pruner)
        assert any(whole(log, GATE))
    countersign(log, (GATE, 40))
    run(pruner)
    assert not any(whole(log, GATE))


def test_who_reads_a_sealed_file_while_it_is_written_anew_goes_on(log: Log, tmp_path: Path) -> None:
    append(log, GATE, *[5] * 8)
    append(log, YARD, *[5] * 2)
    seal_all(log, tmp_path, file_bytes=2_000)
    countersign(log, (GATE, 40))
    with Log(log.dsn, log.catalogue) as other:
        reading = other.read(YARD)
        next(reading)
        waiting = other.read_all(types=["track_point"], with_hollow=True)
        next(waiting)
        run(Pruner(log, BRNO, DAYS_30, signed))
        assert len(list(reading)) == 1
        assert len(list(waiting)) == 9
        assert verify(other, station="brno").is_sound


@pytest.mark.parametrize("who", ["sealer", "pruner"])
@pytest.mark.parametrize("step", ["plan_resealing", "reseal_file", "forget_sealing"])
def test_a_file_whose_rewriting_was_interrupted_is_whole_and_cleared_away(
    log: Log, tmp_path: Path, step: str, who: str
) -> None:
    append(log, GATE, 30, 20)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    countersign(log, (GATE, 50))
    with owner(log) as connection:
        connection.execute(f"alter function {step} rename to {step}_away")  # type: ignore[call-overload]
        with pytest.raises(StoreError):
            run(Pruner(log, BRNO, DAYS_30, signed))
        connection.execute(f"alter function {step}_away rename to {step}")  # type: ignore[call-overload]
    assert verify(log, station="brno").is_sound
    if who == "sealer":
        Sealer(log, str(tmp_path)).resume()
        assert len(list((tmp_path / "_sealed").iterdir())) == 1
    run(Pruner(log, BRNO, DAYS_30, signed))
    found = verify(log, station="brno")
    assert (found.is_sound, found.hollow) == (True, 2)
    assert len(list((tmp_path / "_sealed").iterdir())) == 1


def test_while_another_is_at_work_on_the_archive_a_file_waits_and_is_not_forgotten(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 30)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    countersign(log, (GATE, 30))
    pruner = Pruner(log, BRNO, DAYS_30, signed)
    with tried_lock(log, ARCHIVE) as is_mine:
        assert is_mine
        with pytest.raises(ArchiveUnavailable, match="another command is at work on the archive"):
            run(pruner)
    run(pruner)
    assert whole(log, GATE) == [False]


def test_what_a_derived_stream_waits_for_is_not_pruned(log: Log) -> None:
    append(log, GATE, 3, 3)
    countersign(log, (GATE, 6))
    since = (NOON + timedelta(seconds=0.16)).isoformat()
    set_plan(log, BRNO, Plan.of({"entries": [{"stream": "*/gate/*", "where": "true", "from": since}]}), "", LATER)
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert whole(log, GATE) == [False, True]
    deriver = Deriver(log, BRNO)
    while deriver.step():
        pass
    run(Pruner(log, BRNO, DAYS_30, signed))
    assert whole(log, GATE) == [False, False]


@pytest.mark.parametrize("protocol", [1, 2])
def test_a_segment_whose_payload_was_gone_before_it_was_sent_reaches_central_as_it_is(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon, protocol: int
) -> None:
    gate, yard = (StreamName.of("brno-2", source, "track_point") for source in ("gate", "yard"))
    append(station_log, gate, 3, 2)
    append(station_log, yard, 4)
    with station_log.transaction() as transaction:
        take_off(transaction, [1])
    daemon = make_daemon(protocol=protocol)
    while daemon.step().did != "nothing":
        pass
    assert whole(central_log, yard) == [True]
    if protocol == 2:
        assert whole(central_log, gate) == [False, True]
        assert verify(central_log, station="central").is_sound
        return
    (stopped,) = [each for each in daemon.status().streams if each.error is not None]
    assert stopped.stream == gate
    assert "its payload left the disk, which protocol 1 cannot say" in str(stopped.error)


def test_who_clears_away_beside_a_rewriting_does_not_take_the_new_file(log: Log, tmp_path: Path) -> None:
    append(log, GATE, 30, 20)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    is_entered, may_commit = threading.Event(), threading.Event()

    def record(*_: object) -> None:
        is_entered.set()
        assert may_commit.wait(30)

    (file,) = log.archive.files()
    with ThreadPoolExecutor(1) as threads:
        rewriting = threads.submit(Resealer(log, file).take_off, {1}, record)

        class Between(Sealer):
            """Looks what is pending just before the other one ends."""

            def _head(self) -> ArchiveHead:
                assert is_entered.wait(30)
                head = super()._head()
                may_commit.set()
                rewriting.result()
                return head

        Between(log, str(tmp_path)).resume()
    assert len(list((tmp_path / "_sealed").iterdir())) == 1
    assert [each.has_payload for each in log.read(GATE, with_hollow=True)] == [False, True]
