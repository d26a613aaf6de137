import threading

import pytest

from events import InvalidEvent, StreamName, TrackPoint, batch_of_type, decode
from store import Appended, Appender, Log, LogUnavailable, SequenceConflict
from tests.store.samples import GATE, PRODUCER, YARD, append, points


class Outage:
    """Makes a log unavailable for so many calls, before or after it has done what it was asked."""

    def __init__(self, log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
        self._append, self._revive = log.append, log.revive
        self.calls: list[str] = []
        self.before = self.after = self.dead = 0
        monkeypatch.setattr(log, "append", self.append)
        monkeypatch.setattr(log, "revive", self.revive)

    def append(self, *arguments: object, **named: object) -> list[Appended]:
        self.calls.append("append")
        if self.before:
            self.before -= 1
            raise LogUnavailable("away before")
        appended = self._append(*arguments, **named)  # type: ignore[arg-type]
        if self.after:
            self.after -= 1
            raise LogUnavailable("away after")
        return appended

    def revive(self) -> None:
        self.calls.append("revive")
        if self.dead:
            self.dead -= 1
            raise LogUnavailable("still dead")
        self._revive()


def frames(log: Log, stream: StreamName) -> list[int]:
    return [n for s in log.read(stream) for n in decode(s, log.catalogue).data.column("frame").to_pylist()]


def test_batches_of_many_streams_are_stored_in_the_order_of_the_calls(log: Log) -> None:
    appender = Appender(log, PRODUCER)
    appender.append([(GATE, points(1, 2)), (YARD, points(1, 1)), (GATE, points(3, 4))])
    appended = appender.append([(GATE, points(5, 5)), (YARD, points(2, 2))])
    assert [(a.position, a.first_sequence) for a in appended] == [(4, 5), (5, 2)]
    assert (frames(log, GATE), frames(log, YARD)) == ([1, 2, 3, 4, 5], [1, 2])
    assert {segment.header.producer for segment in log.read_all()} == {PRODUCER}


def test_it_goes_on_where_the_stream_stands(log: Log) -> None:
    append(log, GATE, 3)
    Appender(log, PRODUCER).append([(GATE, points(4, 5))])
    assert frames(log, GATE) == [1, 2, 3, 4, 5]


def test_a_restart_from_the_beginning_stores_only_what_is_missing(log: Log) -> None:
    Appender(log, PRODUCER).append([(GATE, points(1, 5)), (YARD, points(1, 2))])
    again = Appender(log, PRODUCER)
    again.resume_at(GATE, 0)
    again.resume_at(YARD, 0)
    assert again.append([(GATE, points(1, 2)), (YARD, points(1, 2))]) == []
    (straddling,) = again.append([(GATE, points(3, 7))])
    assert (straddling.first_sequence, straddling.was_there) == (6, False)
    again.append([(GATE, points(8, 8)), (YARD, points(3, 3))])
    assert (frames(log, GATE), frames(log, YARD)) == (list(range(1, 9)), [1, 2, 3])


def test_a_restart_skips_within_a_call_that_holds_the_stream_more_than_once(log: Log) -> None:
    append(log, GATE, 3)
    appender = Appender(log, PRODUCER)
    appender.resume_at(GATE, 0)
    appended = appender.append([(GATE, points(1, 2)), (GATE, points(3, 4)), (GATE, points(5, 5))])
    assert [a.first_sequence for a in appended] == [4, 5]
    assert frames(log, GATE) == [1, 2, 3, 4, 5]


def test_going_back_in_midlife_skips_what_it_has_appended_itself(log: Log) -> None:
    appender = Appender(log, PRODUCER)
    appender.append([(GATE, points(1, 4))])
    appender.resume_at(GATE, 2)
    appender.append([(GATE, points(3, 6))])
    assert frames(log, GATE) == [1, 2, 3, 4, 5, 6]


def test_resuming_behind_the_end_of_the_stream_is_refused(log: Log) -> None:
    appender = Appender(log, PRODUCER)
    appender.resume_at(GATE, 5)
    with pytest.raises(SequenceConflict):
        appender.append([(GATE, points(6, 6))])


def test_an_append_of_somebody_else_is_noticed(log: Log) -> None:
    appender = Appender(log, PRODUCER)
    appender.append([(GATE, points(1, 1))])
    append(log, GATE, 1)
    with pytest.raises(SequenceConflict) as caught:
        appender.append([(GATE, points(2, 3))])
    assert (caught.value.stream, caught.value.expected) == (GATE, 1)


def test_a_batch_that_cannot_be_encoded_leaves_everything_as_it_was(log: Log) -> None:
    appender = Appender(log, PRODUCER)
    wrong = StreamName.of("brno", "gate", "track_ended")
    with pytest.raises(InvalidEvent):
        appender.append([(GATE, points(1, 2)), (wrong, points(1, 2))])
    assert log.head() == 0
    appender.append([(GATE, points(1, 2))])
    assert frames(log, GATE) == [1, 2]


def test_a_batch_without_events_is_refused_with_all_of_its_call(log: Log) -> None:
    with pytest.raises(InvalidEvent, match=f"{GATE}: an append holds one event or more, got an empty batch"):
        Appender(log, PRODUCER).append([(YARD, points(1, 2)), (GATE, batch_of_type(TrackPoint, []))])
    assert log.head() == 0


@pytest.mark.parametrize("moment", ["before", "after"])
def test_an_append_whose_fate_is_unknown_is_made_again_and_stored_once(
    log: Log, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    outage = Outage(log, monkeypatch)
    pauses: list[float] = []
    told: list[str] = []
    appender = Appender(log, PRODUCER, sleep=pauses.append, on_wait=lambda error: told.append(str(error)))
    setattr(outage, moment, 3)
    (appended,) = appender.append([(GATE, points(1, 3))])
    assert appended.was_there == (moment == "after")
    assert outage.calls == ["append", "revive", "append", "revive", "append", "revive", "append"]
    assert told == [f"away {moment}"]
    assert pauses == [0.1, 0.2, 0.4]
    appender.append([(GATE, points(4, 4))])
    assert frames(log, GATE) == [1, 2, 3, 4]


def test_it_does_not_append_to_a_database_that_did_not_come_up(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    outage = Outage(log, monkeypatch)
    outage.before, outage.dead = 1, 2
    told: list[LogUnavailable] = []
    Appender(log, PRODUCER, sleep=lambda _: None, on_wait=told.append).append([(GATE, points(1, 1))])
    assert outage.calls == ["append", "revive", "revive", "revive", "append"]
    assert len(told) == 1


def test_pauses_grow_to_a_limit(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    outage = Outage(log, monkeypatch)
    outage.before = 9
    pauses: list[float] = []
    Appender(log, PRODUCER, sleep=pauses.append).append([(GATE, points(1, 1))])
    assert pauses == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0, 5.0]


def test_it_gives_up_with_the_reason_and_the_next_step(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    outage = Outage(log, monkeypatch)
    appender = Appender(log, PRODUCER, wait_s=0, sleep=lambda _: None)
    outage.before = 1
    with pytest.raises(LogUnavailable) as caught:
        appender.append([(GATE, points(1, 2)), (YARD, points(1, 1))])
    assert str(caught.value) == (
        "away before; waited 0 s for it. Nothing acknowledged is lost. "
        "Next: vian doctor, then run the same command again: it goes on where the log stands"
    )


@pytest.mark.parametrize("moment", ["before", "after"])
def test_after_giving_up_the_same_call_can_be_made_again(
    log: Log, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    outage = Outage(log, monkeypatch)
    appender = Appender(log, PRODUCER, wait_s=0, sleep=lambda _: None)
    batches = [(GATE, points(1, 2)), (YARD, points(1, 1))]
    setattr(outage, moment, 1)
    with pytest.raises(LogUnavailable):
        appender.append(batches)
    appended = appender.append(batches)
    assert [a.was_there for a in appended] == [moment == "after"] * 2
    appender.append([(GATE, points(3, 3))])
    assert (frames(log, GATE), frames(log, YARD)) == ([1, 2, 3], [1])


def test_it_waits_for_the_head_of_a_stream_too(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, GATE, 2)
    heads = [LogUnavailable("away"), log.stream_head(GATE)]

    def head(_: StreamName) -> object:
        found = heads.pop(0)
        if isinstance(found, LogUnavailable):
            raise found
        return found

    monkeypatch.setattr(log, "stream_head", head)
    Appender(log, PRODUCER, sleep=lambda _: None).append([(GATE, points(3, 3))])
    assert frames(log, GATE) == [1, 2, 3]


def test_appenders_of_different_streams_do_not_disturb_each_other(log: Log) -> None:
    streams = [StreamName.of("brno", f"cam-{number}", "track_point") for number in range(6)]

    def fill(stream: StreamName) -> None:
        appender = Appender(log, PRODUCER)
        for first in range(1, 40, 4):
            appender.append([(stream, points(first, first + 3))])

    threads = [threading.Thread(target=fill, args=(stream,)) for stream in streams]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for stream in streams:
        assert frames(log, stream) == list(range(1, 41))
    assert [segment.position for segment in log.read_all()] == list(range(1, 61))
