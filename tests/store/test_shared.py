"""The shared appender: many threads, one commit, and a database that comes and goes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import psycopg
import pytest

from events import EventType, InvalidEvent, Producer, StreamName, TrackPoint, UnknownType, batch_of_type, decode
from store import Log, LogUnavailable, SharedAppender, StoreError, verify
from store.journal import Journal
from store.shared import Limits, Receipt
from tests.conftest import Server
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append, draft, on_both, owner, point, points
from tests.store.tiered import seal_all

WAIT_S = 60
QUICK = Limits(window_s=0.01)
PATIENT = Limits(window_s=60, events_max=1000)
"""Commits only when it is flushed, full or closed."""


def frames(log: Log, stream: StreamName = GATE) -> list[int]:
    return [n for s in log.read(stream) for n in decode(s, log.catalogue).data.column("frame").to_pylist()]


class Ping(EventType, type="shared_ping", version=1):
    """A type that nobody registered."""


class Outages:
    """Takes the database away and brings it back."""

    def __init__(self, log: Log, server: Server) -> None:
        self._name = psycopg.conninfo.conninfo_to_dict(log.dsn)["dbname"]
        self._server = server

    def begin(self) -> None:
        self._server.execute(
            f"alter database {self._name} allow_connections false",
            f"select pg_terminate_backend(pid, 10000) from pg_stat_activity where datname = '{self._name}'",
        )

    def end(self) -> None:
        self._server.execute(f"alter database {self._name} allow_connections true")


@pytest.fixture
def outages(log: Log, server: Server) -> Iterator[Outages]:
    outages = Outages(log, server)
    yield outages
    outages.end()


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    opened = Journal(tmp_path / "journal.sqlite")
    yield opened
    opened.close()


@contextmanager
def blocked(log: Log) -> Iterator[None]:
    """Nobody's append comes to its end."""
    with owner(log) as connection, connection.transaction():
        connection.execute("select from log_head for update")
        yield


# Order, merging, receipts.


@on_both
def test_what_shares_a_commit_is_one_segment_a_stream(log: Log) -> None:
    with SharedAppender(log, limits=PATIENT) as appender:
        first = appender.submit(GATE, point(1), PRODUCER)
        other = appender.submit(YARD, points(1, 2), PRODUCER)
        second = appender.submit(GATE, points(2, 4), PRODUCER)
        third = appender.submit(GATE, point(5), PRODUCER)
        appender.flush()
        assert [(r.result().position, r.result().first_sequence) for r in (first, second, third)] == [
            (1, 1),
            (1, 2),
            (1, 5),
        ]
        assert (other.result().position, other.result().event_count) == (2, 2)
    assert (frames(log), frames(log, YARD)) == ([1, 2, 3, 4, 5], [1, 2])
    assert [s.header.event_count for s in log.read_all()] == [5, 2]
    assert verify(log).is_sound


def test_another_producer_is_another_segment_and_the_order_stays(log: Log) -> None:
    other = Producer("other", "2", bytes(32))
    with SharedAppender(log, limits=PATIENT) as appender:
        for number, producer in enumerate([PRODUCER, other, other, PRODUCER], 1):
            appender.submit(GATE, point(number), producer)
    assert frames(log) == [1, 2, 3, 4]
    assert [(s.header.producer, s.header.event_count) for s in log.read(GATE)] == [
        (PRODUCER, 1),
        (other, 2),
        (PRODUCER, 1),
    ]


def test_threads_that_share_it_keep_each_its_order(log: Log) -> None:
    receipts: dict[int, list[Receipt]] = {}

    def fill(number: int) -> None:
        stream = replace(GATE, source=f"cam-{number}")
        receipts[number] = [appender.submit(stream, point(frame), PRODUCER) for frame in range(1, 301)]

    with SharedAppender(log, limits=Limits(window_s=0.005, events_max=100, waiting_events_max=500)) as appender:
        threads = [threading.Thread(target=fill, args=(number,)) for number in range(6)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for number in range(6):
            results = [receipt.result(WAIT_S) for receipt in receipts[number]]
            assert [result.first_sequence for result in results] == list(range(1, 301))
    for number in range(6):
        assert frames(log, replace(GATE, source=f"cam-{number}")) == list(range(1, 301))
    assert verify(log).is_sound


def test_a_commit_comes_when_the_window_is_over_or_enough_is_there(log: Log) -> None:
    with SharedAppender(log, limits=QUICK) as appender:
        assert appender.submit(GATE, point(1), PRODUCER).result(WAIT_S).is_in_log
    with SharedAppender(log, limits=Limits(window_s=600, events_max=3)) as appender:
        receipts = [appender.submit(GATE, point(number), PRODUCER) for number in range(2, 5)]
        assert [receipt.result(WAIT_S).first_sequence for receipt in receipts] == [2, 3, 4]


def test_a_receipt_that_is_not_done_says_so(log: Log) -> None:
    with SharedAppender(log, limits=PATIENT) as appender:
        receipt = appender.submit(GATE, point(1), PRODUCER)
        assert not receipt.done()
        with pytest.raises(TimeoutError, match=r"1 events for brno/gate/track_point are not durable after 0\.01 s"):
            receipt.result(0.01)
    assert receipt.result().position == 1


def test_an_extractor_appends_to_its_source_by_type(log: Log) -> None:
    with SharedAppender(log, limits=QUICK) as appender:
        gate = appender.of("brno", "gate", PRODUCER)
        gate.append(point(1))
        gate.append(points(2, 3))
    assert frames(log) == [1, 2, 3]


# What cannot be stored.


def test_what_cannot_be_a_segment_is_told_to_its_own_and_the_others_are_stored(log: Log) -> None:
    with SharedAppender(log, limits=PATIENT) as appender:
        good = [appender.submit(GATE, point(1), PRODUCER)]
        bad = appender.submit(GATE, point(2).model_copy(update={"frame": 2**70}), PRODUCER)
        good += [appender.submit(GATE, points(3, 4), PRODUCER), appender.submit(YARD, point(1), PRODUCER)]
        appender.flush()
        assert all(receipt.result().is_in_log for receipt in good)
        with pytest.raises(InvalidEvent, match=r"track_point\.frame"):
            bad.result(WAIT_S)
    assert frames(log) == [1, 3, 4]


def test_what_does_not_belong_to_the_stream_is_refused_at_once(log: Log) -> None:
    with SharedAppender(log, limits=QUICK) as appender:
        with pytest.raises(InvalidEvent, match="takes track_ended, got track_point"):
            appender.submit(replace(GATE, type="track_ended"), point(1), PRODUCER)  # type: ignore[arg-type]
        with pytest.raises(InvalidEvent, match="got an empty batch"):
            appender.submit(GATE, batch_of_type(TrackPoint, []), PRODUCER)
    assert log.head() == 0


def test_a_closed_appender_takes_no_more(log: Log) -> None:
    appender = SharedAppender(log)
    appender.close()
    with pytest.raises(StoreError, match="takes no more: it is closed"):
        appender.submit(GATE, point(1), PRODUCER)


def test_somebody_else_on_the_stream_is_gone_behind(log: Log) -> None:
    with SharedAppender(log, limits=QUICK) as appender:
        appender.submit(GATE, points(1, 2), PRODUCER).result(WAIT_S)
        append(log, GATE, 3)
        behind = appender.submit(GATE, points(6, 7), PRODUCER).result(WAIT_S)
    assert behind.first_sequence == 6
    assert frames(log) == [1, 2, 3, 4, 5, 6, 7]


def test_what_nobody_expected_ends_it_and_everybody_is_told(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    appender = SharedAppender(log, limits=PATIENT)
    monkeypatch.setattr(log, "append", lambda *_: 1 / 0)
    receipt = appender.submit(GATE, point(1), PRODUCER)
    appender.submit(YARD, points(1, 1000), PRODUCER)
    with pytest.raises(StoreError, match="the appender failed: ZeroDivisionError"):
        receipt.result(WAIT_S)
    with pytest.raises(StoreError, match="takes no more: the appender failed"):
        appender.submit(GATE, point(2), PRODUCER)
    with pytest.raises(StoreError, match="ZeroDivisionError"):
        appender.close()


# Back-pressure and outages.


def test_submissions_wait_while_too_much_is_on_its_way(log: Log) -> None:
    limits = Limits(window_s=0.001, events_max=10, waiting_events_max=30)
    done = threading.Event()

    def fill() -> None:
        for number in range(1, 101):
            appender.submit(GATE, point(number), PRODUCER)
        done.set()

    with SharedAppender(log, limits=limits) as appender:
        with blocked(log):
            filling = threading.Thread(target=fill)
            filling.start()
            while appender.standing().events_waiting < 30:
                assert filling.is_alive()
            assert not done.wait(0.2)
            assert appender.standing().events_waiting == 30
        assert done.wait(WAIT_S)
        filling.join()
    assert frames(log) == list(range(1, 101))


def test_bytes_on_their_way_are_bounded_too_but_one_alone_passes(log: Log) -> None:
    limits = Limits(window_s=0.001, waiting_bytes_max=1000)
    with SharedAppender(log, limits=limits) as appender:
        with blocked(log):
            appender.submit(GATE, points(1, 500), PRODUCER)
            waiting = threading.Thread(target=appender.submit, args=(GATE, points(501, 502), PRODUCER))
            waiting.start()
            waiting.join(0.1)
            assert waiting.is_alive()
        waiting.join(WAIT_S)
    assert frames(log) == list(range(1, 503))


def test_without_a_journal_events_wait_for_the_database(log: Log, outages: Outages) -> None:
    with SharedAppender(log, limits=QUICK) as appender:
        appender.submit(GATE, points(1, 2), PRODUCER).result(WAIT_S)
        outages.begin()
        receipt = appender.submit(GATE, points(3, 4), PRODUCER)
        while appender.standing().away is None:
            assert not receipt.done()
        outages.end()
        assert receipt.result(WAIT_S).first_sequence == 3
        assert appender.standing().away is None
    assert frames(log) == [1, 2, 3, 4]


def test_closed_without_a_database_and_a_journal_it_says_what_is_not_stored(log: Log, outages: Outages) -> None:
    appender = SharedAppender(log, limits=replace(QUICK, close_wait_s=0.1))
    outages.begin()
    receipt = appender.submit(GATE, points(1, 2), PRODUCER)
    with pytest.raises(LogUnavailable, match="not all events are stored, their receipts say which"):
        appender.close()
    with pytest.raises(LogUnavailable):
        receipt.result(WAIT_S)
    outages.end()
    assert log.head() == 0


@on_both
def test_while_the_database_is_away_the_journal_keeps_and_then_gives_back_in_order(
    log: Log, outages: Outages, journal: Journal
) -> None:
    with SharedAppender(log, limits=QUICK, journal=journal) as appender:
        appender.submit(GATE, points(1, 2), PRODUCER).result(WAIT_S)
        outages.begin()
        for number in range(3, 13):
            kept = appender.submit(GATE, point(number), PRODUCER).result(WAIT_S)
            assert not kept.is_in_log
        assert appender.standing().drafts_in_journal > 0
        outages.end()
        while appender.standing().drafts_in_journal:
            assert appender.standing().events_waiting == 0
        appender.submit(GATE, point(13), PRODUCER).result(WAIT_S)
    assert frames(log) == list(range(1, 14))
    assert journal.drafts_kept == 0
    assert verify(log).is_sound


def test_what_a_killed_program_left_in_the_journal_goes_first(
    log: Log, outages: Outages, journal: Journal, tmp_path: Path
) -> None:
    outages.begin()
    # Ended with the database away: as after a kill, the journal alone has the events.
    with SharedAppender(log, limits=QUICK, journal=journal) as appender:
        appender.submit(GATE, points(1, 3), PRODUCER).result(WAIT_S)
        appender.submit(YARD, points(1, 1), PRODUCER).result(WAIT_S)
    journal.close()
    outages.end()
    assert log.head() == 0
    again = Journal(journal.path)
    with SharedAppender(log, limits=QUICK, journal=again) as appender:
        appender.submit(GATE, points(4, 5), PRODUCER).result(WAIT_S)
    assert (frames(log), frames(log, YARD)) == ([1, 2, 3, 4, 5], [1])
    again.close()


def test_a_kill_between_log_and_journal_stores_nothing_twice(
    log: Log, outages: Outages, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    outages.begin()
    with SharedAppender(log, limits=QUICK, journal=journal) as appender:
        for number in range(1, 6):
            appender.submit(GATE, point(number), PRODUCER).result(WAIT_S)
    outages.end()
    kept = journal.oldest(100)
    with monkeypatch.context() as patched:
        patched.setattr(journal, "remove", lambda _: 1 / 0)
        broken = SharedAppender(log, limits=QUICK, journal=journal)
        with pytest.raises(StoreError, match="ZeroDivisionError"):
            broken.close()
    assert frames(log) == [1, 2, 3, 4, 5], "the log holds them"
    assert [each.draft for each in journal.oldest(len(kept))] == [each.draft for each in kept], "the journal too"
    with SharedAppender(log, limits=QUICK, journal=journal):
        pass
    assert frames(log) == [1, 2, 3, 4, 5]
    assert journal.drafts_kept == 0


def test_a_journal_that_outlives_a_restore_stores_what_the_backup_lacks_and_nothing_twice(
    log: Log, journal: Journal
) -> None:
    held, lacking = draft(GATE, 1, 3), draft(GATE, 4, 5)
    log.append([held], [0])
    journal.add([held, lacking, draft(YARD, 1, 1)], [0, 3, None], log.epoch)
    with owner(log) as connection:
        connection.execute("update log_head set epoch = 2")  # as a restore does
    with Log(log.dsn, log.catalogue) as restored, SharedAppender(restored, limits=QUICK, journal=journal):
        pass
    lives = [(head.stream, head.epoch, head.sequence) for head in log.streams()]
    assert lives == [(GATE, 1, 3), (GATE, 2, 2), (YARD, 2, 1)]
    assert journal.drafts_kept == 0


def test_a_sealed_file_that_cannot_be_read_keeps_the_journal_waiting(
    log: Log, journal: Journal, tmp_path: Path
) -> None:
    log.append([draft(GATE, 1, 3)], [0])
    seal_all(log, tmp_path / "archive")
    (sealed,) = (tmp_path / "archive").rglob("*.parquet")
    sealed.rename(tmp_path / "away")
    journal.add([draft(GATE, 1, 3)], [0], log.epoch)
    with SharedAppender(log, limits=QUICK, journal=journal) as appender:
        assert not appender.submit(GATE, points(4, 5), PRODUCER).result(WAIT_S).is_in_log
        while appender.standing().away is None:
            pass
        assert "cannot be compared" in str(appender.standing().away)
        (tmp_path / "away").rename(sealed)
    with SharedAppender(log, limits=QUICK, journal=journal):
        pass
    assert frames(log) == [1, 2, 3, 4, 5]


def test_an_event_of_a_type_that_is_not_registered_is_refused(log: Log) -> None:
    stream = StreamName.of("brno", "gate", Ping.type_name)
    with SharedAppender(log, limits=QUICK) as appender, pytest.raises(UnknownType, match="is not registered here"):
        appender.submit(stream, Ping(time=NOON), PRODUCER)
    assert log.streams() == []


def test_a_journal_that_is_full_makes_submissions_wait(log: Log, outages: Outages, journal: Journal) -> None:
    limits = Limits(window_s=0.001, events_max=10, waiting_events_max=20, journal_bytes_max=journal.size_bytes + 8192)
    outages.begin()
    done = threading.Event()

    def fill() -> None:
        for number in range(1, 301):
            appender.submit(GATE, point(number), PRODUCER)
        done.set()

    with SharedAppender(log, limits=limits, journal=journal) as appender:
        filling = threading.Thread(target=fill)
        filling.start()
        while journal.size_bytes <= limits.journal_bytes_max:
            assert filling.is_alive()
        assert not done.wait(0.2)
        outages.end()
        assert done.wait(WAIT_S)
        filling.join()
    assert frames(log) == list(range(1, 301))


def test_a_commit_whose_fate_is_unknown_is_made_again_and_stored_once(
    log: Log, journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, calls = log.append, []

    def lose_the_answer(*arguments: object) -> object:
        appended = whole(*arguments)  # type: ignore[arg-type]
        calls.append(appended)
        if len(calls) == 1:
            raise LogUnavailable("away after it was done")
        return appended

    monkeypatch.setattr(log, "append", lose_the_answer)
    with SharedAppender(log, limits=QUICK, journal=journal) as appender:
        assert not appender.submit(GATE, points(1, 3), PRODUCER).result(WAIT_S).is_in_log
        appender.submit(GATE, points(4, 4), PRODUCER).result(WAIT_S)
    assert frames(log) == [1, 2, 3, 4]
    assert calls[1][0].was_there  # type: ignore[index]
