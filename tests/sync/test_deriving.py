"""Derived streams are exact: in any steps, through kills, and whatever the plan did in between."""

import contextlib
import re
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import psycopg
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import Catalogue, EventType, LossRecorded, PlateRead, StreamName, batch_of, decode, encode, events_of
from store import Log, LogUnavailable, verify
from store.log import Transaction
from store.payloads import put_back, weights
from sync import FilterFailed, Plan
from sync.keeping.gone import GoneRecorder
from sync.keeping.pruning import Proven, take_off_held, take_off_recorded
from sync.plans.deriving import Deriver, DerivingChore
from sync.plans.entries import derived_name
from sync.plans.planning import plan_stream, set_plan
from sync.protocol.reports import Step
from tests.store.tiered import seal_all
from tests.sync.conftest import BRNO, NOON, PRODUCER, MakeDaemon, append_points, points, stream_of

MakeLog = Callable[..., Log]
GATE, YARD = stream_of("gate"), stream_of("yard")
NOW = datetime.now(UTC) + timedelta(days=1)


def plan_of(*entries: dict[str, Any]) -> Plan:
    return Plan.of({"entries": [*entries, {"stream": "*/*/*"}]})


def filtered(where: str, stream: str = "*/gate/track_point", **more: Any) -> dict[str, Any]:
    return {"stream": stream, "where": where, **more}


def plan(log: Log, *entries: dict[str, Any]) -> Plan:
    return set_plan(log, BRNO, plan_of(*entries), "http://central", NOON + timedelta(days=1)).plan


def run(deriver: Deriver, steps: int = 1000) -> int:
    """Step until nothing is waiting; how often."""
    return next(number for number in range(1, steps + 1) if not deriver.step())


def derived(log: Log, made_of: Plan, base: StreamName = GATE) -> list[Any]:
    """The events of the stream that a plan derives from another, in every epoch."""
    entry = made_of.chosen(base)
    assert entry is not None
    segments = list(log.read_lives(derived_name(base, entry)))
    assert all(segment.header.event_count for segment in segments)
    return [event for segment in segments for event in events_of(decode(segment, log.catalogue))]


def frames(events: list[Any]) -> list[int]:
    return [event.frame for event in events]


def test_a_derived_stream_has_what_its_filter_lets_through_and_its_own_sequence(station_log: Log) -> None:
    append_points(station_log, GATE, [10, 2500, 1])
    append_points(station_log, YARD, [100])
    made = plan(station_log, filtered("track_id = 1"))
    deriver = Deriver(station_log, BRNO)

    run(deriver)

    assert frames(derived(station_log, made)) == [frame for frame in range(2511) if frame % 7 == 0]
    (standing,) = deriver.standing()
    head = station_log.stream_head(standing.stream)
    assert (standing.base, standing.error, head.sequence) == (GATE, None, 359)
    assert made.entry_for(standing.stream) == made.entries[0]
    assert made.entry_for(GATE) is None
    assert made.entry_for(YARD) == made.entries[1]


def test_nothing_is_derived_where_no_plan_asks_for_it(station_log: Log) -> None:
    append_points(station_log, GATE, [10])
    deriver = Deriver(station_log, BRNO)
    assert not deriver.step()
    plan(station_log)
    assert not deriver.step()
    assert (deriver.standing(), len(station_log.streams())) == ([], 2)


def test_what_comes_later_is_derived_and_an_idle_deriver_writes_nothing(station_log: Log) -> None:
    append_points(station_log, GATE, [10])
    made = plan(station_log, filtered("frame >= 8"))
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    append_points(station_log, GATE, [5])
    run(deriver)
    head = station_log.head()
    run(deriver)
    append_points(station_log, YARD, [5])
    run(deriver)

    assert frames(derived(station_log, made)) == list(range(8, 15))
    assert station_log.head() == head + 1


def test_all_filtered_away_is_no_segment(station_log: Log) -> None:
    append_points(station_log, GATE, [10, 10])
    made = plan(station_log, filtered("frame > 100"))
    run(Deriver(station_log, BRNO))
    assert derived(station_log, made) == []
    append_points(station_log, GATE, [90])
    run(Deriver(station_log, BRNO))
    assert frames(derived(station_log, made)) == list(range(101, 110))


def test_from_a_time_on_is_exact_and_another_from_is_another_stream(station_log: Log) -> None:
    append_points(station_log, GATE, [10, 10, 10])
    first = plan(station_log, filtered("frame <> 25", **{"from": (NOON + timedelta(milliseconds=14)).isoformat()}))
    run(Deriver(station_log, BRNO))
    second = plan(station_log, filtered("frame <> 25"))
    run(Deriver(station_log, BRNO))

    assert frames(derived(station_log, first)) == [*range(14, 25), *range(26, 30)]
    assert frames(derived(station_log, second)) == [*range(25), *range(26, 30)]


def test_fields_are_left_out(station_log: Log) -> None:
    stream = StreamName.of("brno-2", "gate", "plate_read")
    box = {"x1": 0, "y1": 0, "x2": 1, "y2": 1}
    plates = [
        PlateRead(time=NOON, plate=text, confidence=1, frame=n, country="CZ", region="B", candidates="[]", **box)
        for n, text in enumerate("abc")
    ]
    station_log.append([encode(stream, batch_of(plates), PRODUCER)])
    made = plan(station_log, {"stream": "*/*/plate_read", "leave_out": ["candidates", "region"]})
    run(Deriver(station_log, BRNO))
    assert derived(station_log, made, stream) == [
        plate.model_copy(update={"candidates": None, "region": None}) for plate in plates
    ]


def test_streams_that_begin_late_and_entries_that_go_and_come_back_are_complete(station_log: Log) -> None:
    entry = filtered("frame % 2 = 0", "*/*/track_point")
    append_points(station_log, GATE, [5])
    made = plan(station_log, entry)
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    plan(station_log)
    append_points(station_log, GATE, [5])
    append_points(station_log, YARD, [4])
    run(deriver)
    assert frames(derived(station_log, made)) == [0, 2, 4]
    plan(station_log, filtered("frame = 1"))
    run(deriver)
    plan(station_log, entry)
    append_points(station_log, YARD, [4])
    run(deriver)

    assert frames(derived(station_log, made)) == [0, 2, 4, 6, 8]
    assert frames(derived(station_log, made, YARD)) == [0, 2, 4, 6]


def test_a_derived_stream_is_not_derived_from(station_log: Log) -> None:
    append_points(station_log, GATE, [5])
    plan(station_log, filtered("frame > 1", "*/*/track_point"))
    for _ in range(3):
        run(Deriver(station_log, BRNO))
    assert [str(head.stream.source) for head in station_log.streams() if "~" in head.stream.source] == [
        f"gate~{plan_of(filtered('frame > 1')).entries[0].filter_hash}"
    ]


def test_who_reads_the_stations_log_gets_each_event_once_and_central_gets_what_was_sent(
    station_log: Log, make_log: MakeLog, tmp_path: Path
) -> None:
    append_points(station_log, GATE, [5])
    made = plan(station_log, filtered("frame > 1"))
    run(Deriver(station_log, BRNO))
    name = derived_name(GATE, made.entries[0])

    def read(log: Log, **wanted: Any) -> list[StreamName]:
        return [segment.stream for segment in log.read_all(types=["track_point"], **wanted)]

    for _ in ("in PostgreSQL", "sealed"):
        assert read(station_log) == [GATE]
        assert read(station_log, stations=["brno-2"]) == [GATE]
        assert read(station_log, sources=[name.source]) == [name]
        assert read(station_log, with_hollow=True) == [GATE, name]
        assert [segment.stream for segment in station_log.read(name)] == [name]
        seal_all(station_log, tmp_path)
    central = make_log()
    central.append([encode(name, batch_of(points(0, 3)), PRODUCER)])
    assert read(central) == [name]


def test_central_gets_the_derived_stream_in_place_of_its_base(
    station_log: Log, central_log: Log, make_daemon: MakeDaemon
) -> None:
    append_points(station_log, GATE, [50])
    append_points(station_log, YARD, [5])
    made = plan(station_log, filtered("track_id = 2"))
    run(Deriver(station_log, BRNO))
    make_daemon(plan=made).catch_up()
    append_points(station_log, GATE, [50])
    run(Deriver(station_log, BRNO))
    make_daemon(plan=made).catch_up()

    name = derived_name(GATE, made.entries[0])
    assert frames(derived(central_log, made)) == [frame for frame in range(100) if frame % 7 == 1]
    assert central_log.stream_head(name) == station_log.stream_head(name)
    got = {head.stream for head in central_log.streams() if head.stream.station == BRNO}
    assert got == {name, YARD, plan_stream(BRNO)}
    assert verify(central_log).broken == []


class Killed(Exception):
    """The process died here."""


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
@given(st.data())
def test_any_steps_kills_and_plans_give_what_filtering_at_once_gives(make_log: MakeLog, data: st.DataObject) -> None:
    with make_log() as log:
        _any_steps(log, data)


def _any_steps(log: Log, data: st.DataObject) -> None:
    entries = [filtered("track_id in (1, 4)"), filtered("frame % 3 = 1", "*/*/track_point")]
    plans = {}
    derivers = [Deriver(log, BRNO), Deriver(log, BRNO)]
    moves = st.sampled_from(["append gate", "append yard", "step", "step", "other steps", "kill", "plan", "page"])
    with pytest.MonkeyPatch.context() as patch:
        for _ in range(data.draw(st.integers(3, 25))):
            move = data.draw(moves)
            if move.startswith("append"):
                append_points(log, stream_of(move.split()[1]), data.draw(st.lists(st.integers(1, 9), max_size=3)))
            elif move == "plan":
                chosen = data.draw(st.sampled_from(range(3)))
                plans[chosen] = plan(log, *entries[chosen : chosen + 1])
            elif move == "page":
                patch.setattr("sync.plans.deriving.PAGE_SEGMENTS", data.draw(st.integers(1, 4)))
                patch.setattr("sync.plans.deriving.PAGE_POSITIONS", data.draw(st.integers(1, 9)))
                patch.setattr("sync.plans.deriving.UNSAVED_POSITIONS", data.draw(st.integers(1, 9)))
            elif move == "kill":
                _kill(derivers[0], patch, is_before=data.draw(st.booleans()))
                derivers[0] = Deriver(log, BRNO)
            else:
                derivers[move != "step"].step()
        for number, entry in enumerate(entries):
            plans[number] = plan(log, entry)
            run(derivers[0])
            run(derivers[1])

    _check_exact(log, plans)


def _kill(deriver: Deriver, patch: pytest.MonkeyPatch, *, is_before: bool) -> None:
    """Step, and die before or behind the append, but before the commit."""
    append = Transaction.append

    def dies(transaction: Transaction, *given: Any, **more: Any) -> Any:
        if not is_before:
            append(transaction, *given, **more)
        raise Killed

    with patch.context() as inner:
        inner.setattr(Transaction, "append", dies)
        with contextlib.suppress(Killed):
            deriver.step()


def _check_exact(log: Log, plans: dict[int, Plan]) -> None:
    for number, base in [(0, GATE), (1, GATE), (1, YARD)]:
        count = log.stream_head(base).sequence
        wanted = [
            event for event in points(0, count) if (event.track_id in (1, 4) if number == 0 else event.frame % 3 == 1)
        ]
        assert derived(log, plans[number], base) == wanted


def test_what_was_committed_without_an_answer_is_not_derived_again(
    station_log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    append_points(station_log, GATE, [10])
    made = plan(station_log, filtered("true"))
    deriver = Deriver(station_log, BRNO)
    exited = type(station_log.transaction()).__exit__

    def lost(context: Any, *given: Any) -> Any:
        exited(context, *given)
        raise LogUnavailable("the connection was lost at the commit")

    with monkeypatch.context() as patch:
        patch.setattr(type(station_log.transaction()), "__exit__", lost)
        with pytest.raises(LogUnavailable):
            deriver.step()
    run(deriver)
    assert frames(derived(station_log, made)) == list(range(10))


def test_every_epoch_of_a_base_stream_is_derived(station_log: Log, server: Any) -> None:
    append_points(station_log, GATE, [10])
    with station_log.connection() as connection:
        connection.execute("reset role")
        connection.execute("update log_head set epoch = 2")
    log = Log(station_log.dsn, Catalogue.shipped())
    append_points(log, GATE, [4])
    made = plan(log, filtered("frame < 3"))
    run(Deriver(log, BRNO))
    assert frames(derived(log, made)) == [0, 1, 2, 0, 1, 2]
    log.close()


def test_what_cannot_be_filtered_is_told_and_the_others_go_on(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3])
    append_points(station_log, YARD, [3])
    made = plan(
        station_log,
        filtered("frame * 9223372036854775807 < 9 or frame < 3"),
        filtered("frame = 1", "*/yard/track_point"),
    )
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    gate, yard = deriver.standing()
    with pytest.raises(FilterFailed, match="is stopped before position"):
        DerivingChore(deriver).step(NOON)

    assert (yard.error, frames(derived(station_log, made, YARD))) == (None, [1])
    assert gate.error is not None
    assert gate.error.startswith(f"{gate.stream} is stopped before position ")
    assert "Out of Range" in gate.error
    made = plan(station_log, filtered("frame < 4"), filtered("frame = 1", "*/yard/track_point"))
    run(deriver)
    assert [each.error for each in deriver.standing()] == [None, None]
    assert not DerivingChore(deriver).step(NOON)
    assert frames(derived(station_log, made)) == [0, 1, 2, 3]


class Newer(EventType, type="track_point", version=9):
    """A track point of a version that this program does not know."""

    frame: int


class Newest(EventType, type="of_tomorrow", version=1):
    """A type that this program does not know."""

    frame: int


def test_a_type_or_version_that_is_not_known_stops_its_stream_and_no_other(station_log: Log) -> None:
    tomorrow = StreamName.of("brno-2", "gate", "of_tomorrow")
    append_points(station_log, GATE, [3])
    station_log.append([encode(GATE, batch_of([Newer(time=NOON, frame=7)]), PRODUCER)])
    station_log.append([encode(tomorrow, batch_of([Newest(time=NOON, frame=7)]), PRODUCER)])
    append_points(station_log, YARD, [3])
    made = plan(station_log, filtered("frame > 0", "*/*/*"))
    deriver = Deriver(station_log, BRNO)
    run(deriver)

    errors = {standing.base: standing.error for standing in deriver.standing()}
    assert errors[YARD] is None
    assert frames(derived(station_log, made)) == [1, 2]
    assert frames(derived(station_log, made, YARD)) == [1, 2]
    assert "track_point version 9 is not known here" in str(errors[GATE])
    assert f"{tomorrow} cannot be filtered: no event type 'of_tomorrow'" in str(errors[tomorrow])


def test_a_source_with_a_name_too_long_is_told(station_log: Log) -> None:
    long = stream_of("s" * 60)
    append_points(station_log, long, [3])
    plan(station_log, filtered("frame > 0", "*/*/track_point"))
    deriver = Deriver(station_log, BRNO)
    assert not deriver.step()
    (standing,) = deriver.standing()
    assert "the name of its source has 60 characters" in str(standing.error)


def test_segments_that_were_given_up_are_passed_over(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3, 3])
    give_up(station_log, 2)
    made = plan(station_log, filtered("true"))
    run(Deriver(station_log, BRNO))
    assert frames(derived(station_log, made)) == [0, 1, 2, 6, 7, 8]


def test_what_was_gone_at_both_sides_stays_out_when_it_is_back_and_another_filter_has_it(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3])
    first = next(station_log.read(GATE))
    prune(station_log, 1)
    GoneRecorder(station_log, BRNO, lambda: NOON).record(station_log.read(GATE, with_hollow=True))
    made = plan(station_log, filtered("true"))
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    with station_log.transaction() as transaction:
        put_back(transaction, 1, first.payload)
    append_points(station_log, YARD, [1])
    run(deriver)
    assert frames(derived(station_log, made)) == [3, 4, 5]
    made = plan(station_log, filtered("frame >= 0"))
    run(deriver)
    assert frames(derived(station_log, made)) == list(range(6))


def test_a_pruned_segment_stops_the_stream_and_it_goes_on_by_itself_when_it_is_back(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3, 3, 3])
    payloads = {segment.position: segment.payload for segment in station_log.read(GATE)}
    prune(station_log, 2, 3)
    made = plan(station_log, filtered("true"))
    deriver = Deriver(station_log, BRNO)
    run(deriver)

    assert frames(derived(station_log, made)) == [0, 1, 2]
    name = derived_name(GATE, made.entries[0])
    said = f"{GATE} was pruned from sequence 4 to 9 of epoch 1: {name} is stopped there until they are back. Next: "
    command = f"vian sync repair --stream {GATE} --epoch 1 --from 4 --to 9"
    with pytest.raises(FilterFailed, match=re.escape(said + command)):
        deriver.check()

    for position in (2, 3):
        with station_log.transaction() as transaction:
            put_back(transaction, position, payloads[position])
        append_points(station_log, YARD, [1])  # as repair does, which records what it put back
        run(deriver)
    assert frames(derived(station_log, made)) == list(range(12))
    deriver.check()


def test_what_was_pruned_before_the_time_from_which_a_stream_is_wanted_is_not_missed(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3])
    prune(station_log, 1)
    made = plan(station_log, filtered("true", **{"from": (NOON + timedelta(milliseconds=3)).isoformat()}))
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    deriver.check()
    assert frames(derived(station_log, made)) == [3, 4, 5]


def prune(log: Log, *positions: int) -> None:
    """Take payloads off as what central holds."""
    found = [each for each in weights(log, 0, NOW, 1000) if each.position in positions]
    take_off_held(log, BRNO, found, Proven("", {}), NOW)


def give_up(log: Log, position: int) -> None:
    """Take a payload off as a loss."""
    (lost,) = weights(log, position - 1, NOW, 1)
    event = LossRecorded(
        time=NOON,
        stream=str(lost.stream),
        what="segments",
        count=1,
        first_sequence=lost.first_sequence,
        last_sequence=lost.last_sequence,
        lost_from_at=lost.time_min,
        lost_until_at=lost.time_max,
        reason="a test",
        policy="a test",
    )
    take_off_recorded(log, BRNO, [lost], [event])


def damage_records(log: Log) -> None:
    """Change the bytes of what is recorded of losses, past the log's guards."""
    with psycopg.connect(log.dsn) as connection:
        connection.execute("set session_replication_role = replica")
        connection.execute(
            "update segments set payload = '\\x00' "
            "where stream_id in (select id from streams where type = 'loss_recorded')"
        )


def test_where_what_is_recorded_of_a_gap_cannot_be_read_that_stream_stops_alone(station_log: Log) -> None:
    append_points(station_log, GATE, [3, 3])
    append_points(station_log, YARD, [3])
    made = plan(station_log, filtered("true", "*/*/track_point"))
    give_up(station_log, 1)
    damage_records(station_log)
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    assert (frames(derived(station_log, made)), frames(derived(station_log, made, YARD))) == ([], [0, 1, 2])
    with pytest.raises(FilterFailed, match=r"is stopped before position 1 of .*loss_recorded.*Next: .*vian verify"):
        deriver.check()


def test_who_is_stopped_at_a_gap_stays_so_while_what_is_recorded_cannot_be_read(station_log: Log) -> None:
    append_points(station_log, GATE, [3])
    append_points(station_log, YARD, [3, 3])
    made = plan(station_log, filtered("true", "*/*/track_point"))
    (gone, *_) = weights(station_log, 0, NOW, 1)
    take_off_held(station_log, BRNO, [gone], Proven("", {}), NOW)
    deriver = Deriver(station_log, BRNO)
    run(deriver)
    give_up(station_log, 3)
    damage_records(station_log)
    append_points(station_log, YARD, [2])
    run(deriver)
    assert frames(derived(station_log, made, YARD)) == [0, 1, 2, 3, 4, 5, 6, 7]
    with pytest.raises(FilterFailed, match=f"is stopped before position 1 of {GATE}"):
        deriver.check()


NOWHERE = "http://127.0.0.1:9"


def test_without_central_it_is_derived_too(station_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, GATE, [3, 3])
    made = plan_of(filtered("frame > 0"))
    daemon = make_daemon(address=NOWHERE, plan=made, chores=(DerivingChore(Deriver(station_log, BRNO)),))
    assert [daemon.step().did for _ in range(2)] == ["planned", "failed"]
    while daemon.meanwhile():
        pass
    assert frames(derived(station_log, made)) == [1, 2, 3, 4, 5]
    append_points(station_log, GATE, [2])
    while daemon.meanwhile():
        pass
    assert frames(derived(station_log, made)) == [1, 2, 3, 4, 5, 6, 7]
    assert derived_name(GATE, made.entries[0]) in [each.stream for each in daemon.status().streams]


def test_a_daemon_that_runs_derives_while_it_waits_for_central(station_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, GATE, [3])
    made = plan_of(filtered("true"))
    daemon = make_daemon(address=NOWHERE, plan=made, chores=(DerivingChore(Deriver(station_log, BRNO)),))
    stop, failed = threading.Event(), []

    def tell(step: Step) -> None:
        failed.append(step.did == "failed")
        if sum(failed) == 5:
            stop.set()

    daemon.run(stop, tell)
    assert frames(derived(station_log, made)) == [0, 1, 2]


def test_while_the_plan_is_paused_it_is_derived(station_log: Log, make_daemon: MakeDaemon) -> None:
    append_points(station_log, GATE, [3])
    made = Plan.of({"entries": [filtered("true")], "paused": True})
    make_daemon(address=NOWHERE, plan=made, chores=(DerivingChore(Deriver(station_log, BRNO)),)).catch_up()
    assert frames(derived(station_log, made)) == [0, 1, 2]


def test_large_events_are_cut_into_segments(station_log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sync.plans.deriving.SEGMENT_BYTES", 1000)
    append_points(station_log, GATE, [100])
    made = plan(station_log, filtered("true"))
    run(Deriver(station_log, BRNO))
    assert frames(derived(station_log, made)) == list(range(100))
    name = derived_name(GATE, made.entries[0])
    assert len(list(station_log.read(name))) == 8
