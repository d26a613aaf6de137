"""Types at positions of their own: new tables, new versions, rebuilding; killed and raced at each step."""

import threading
from collections.abc import Callable
from datetime import UTC, date, datetime, timedelta
from typing import Any

import psycopg
import pyarrow as pa
import pytest

from events import SHIPPED, Catalogue, EventType, StreamName, TrackEnded, batch_of, encode, schema_of
from store import BadRequest, Log, Projector, TableBusy, Transaction, open_log
from store.projector import BEHIND, NAME
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append, draft, on_both, owner, point, query
from tests.store.test_projector import assert_rows_equal_events, project

BEEPS = StreamName.of("brno", "gate", "beep")


class Beep(EventType, type="beep", version=1, subject="tone"):
    """Something beeped."""

    tone: str
    """what it sounded like"""
    pitch: int
    """how high, Hz"""
    echo: str
    """what came back"""


class LouderBeep(EventType, type="beep", version=2, subject="tone", older=Beep):
    """Something beeped, and how loud."""

    tone: str
    """what it sounded like, in words"""
    loudness_db: float
    """how loud, dB"""
    pitch: float | None
    """how high, Hz; null where unheard"""

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Once all were equally loud."""
        loudness = pa.array([60.0] * len(older))
        pitch = older.column("pitch").cast(pa.float64())
        return pa.RecordBatch.from_arrays(
            [older.column("time"), older.column("tone"), loudness, pitch], schema=schema_of(cls)
        )


OLD, NEW = Catalogue([*SHIPPED, Beep]), Catalogue([*SHIPPED, LouderBeep])


def beep(log: Log, *tones: str) -> None:
    for tone in tones:
        log.append([encode(BEEPS, batch_of([Beep(time=NOON, tone=tone, pitch=440, echo="")]), PRODUCER)])


def louder(log: Log, *tones: str) -> None:
    for tone in tones:
        log.append([encode(BEEPS, batch_of([LouderBeep(time=NOON, tone=tone, loudness_db=3, pitch=None)]), PRODUCER)])


def frames(log: Log) -> list[int]:
    return [frame for (frame,) in query(log, "select frame from track_point order by source, sequence")]


@on_both
def test_a_type_that_is_new_here_gets_its_history_projected(make_log: Callable[..., Log]) -> None:
    log = make_log()
    beep(log, "a", "b")
    append(log, GATE, 2)
    assert project(log).segments_skipped == 2
    with open_log(dsn=log.dsn, catalogue=OLD) as knowing:
        made = Projector(knowing)
        assert (made.position, dict(made.behind)) == (0, {"beep": 0})
        beep(knowing, "c")
        assert made.catch_up() == 4
        assert (made.segments_skipped, dict(made.behind)) == (0, {})
        made.close()
        assert query(log, "select tone, pitch from beep order by sequence") == [("a", 440), ("b", 440), ("c", 440)]
        assert_rows_equal_events(knowing)


def test_events_of_a_type_that_is_not_installed_for_a_while_get_their_rows_later(make_log: Callable[..., Log]) -> None:
    log = make_log(OLD)
    beep(log, "a")
    project(log)
    with Log(log.dsn, Catalogue.shipped()) as ignorant:
        beep(ignorant, "b")
        append(ignorant, GATE, 1)
        beep(ignorant, "c")
        made = project(ignorant)
        assert (made.segments_skipped, made.position, dict(made.behind)) == (2, 4, {})
    assert query(log, "select tone from beep") == [("a",)]
    beep(log, "d")
    project(log)
    assert_rows_equal_events(log)


@on_both
def test_a_table_of_an_older_version_gets_the_newer_columns_and_is_filled_anew(make_log: Callable[..., Log]) -> None:
    log = make_log(OLD)
    beep(log, "a")
    project(log)
    with open_log(dsn=log.dsn, catalogue=NEW) as newer:
        assert query(log, "select count(*) from beep") == [(0,)]
        louder(newer, "b")
        made = project(newer)
        assert made.segments_skipped == 0
        assert query(log, "select tone, loudness_db, pitch, echo from beep order by sequence") == [
            ("a", 60.0, 440.0, None),
            ("b", 3.0, None, None),
        ]
        columns = query(
            log,
            "select attname, format_type(atttypid, -1), attnotnull, col_description(attrelid, attnum) "
            "from pg_attribute where attrelid = 'beep'::regclass and attname in "
            "('tone', 'pitch', 'loudness_db', 'echo') order by 1",
        )
        assert columns == [
            ("echo", "text", False, "what came back"),
            ("loudness_db", "double precision", True, "how loud, dB"),
            ("pitch", "double precision", False, "how high, Hz; null where unheard"),
            ("tone", "text", True, "what it sounded like, in words"),
        ]
        assert query(log, "select obj_description('beep'::regclass)") == [("Something beeped, and how loud.",)]
        names = query(
            log, "select attname from pg_attribute where attrelid = 'beep_events'::regclass order by attnum offset 10"
        )
        assert [name for (name,) in names] == ["tone", "pitch", "echo", "loudness_db"], "what is new comes last"


def test_a_view_of_an_analyst_outlives_a_new_version(make_log: Callable[..., Log]) -> None:
    class HigherBeep(EventType, type="beep", version=2, subject="tone", older=Beep):
        """Something beeped."""

        tone: str
        """what it sounded like"""
        above_c: int | None
        """semitones above C"""
        pitch: int
        """how high, Hz"""
        echo: str
        """what came back"""

        @classmethod
        def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
            """Nobody measured it."""
            time, tone, pitch, echo = older.columns
            unknown = pa.nulls(len(older), pa.int64())
            return pa.RecordBatch.from_arrays([time, tone, unknown, pitch, echo], schema=schema_of(cls))

    log = make_log(OLD)
    with owner(log) as connection:
        connection.execute("create view tones as select tone, pitch from beep_events")
    with open_log(dsn=log.dsn, catalogue=Catalogue([*SHIPPED, HigherBeep])) as newer:
        higher = HigherBeep(time=NOON, tone="a", above_c=1, pitch=2, echo="e")
        newer.append([encode(BEEPS, batch_of([higher]), PRODUCER)])
        project(newer)
        assert query(log, "select * from tones") == [("a", 2)]
        assert query(log, "select above_c from beep_events") == [(1,)]


def test_opening_again_changes_a_table_once(make_log: Callable[..., Log]) -> None:
    log = make_log(OLD)
    beep(log, "a")
    with open_log(dsn=log.dsn, catalogue=NEW) as newer:
        louder(newer, "b")
        project(newer)
    with open_log(dsn=log.dsn, catalogue=NEW) as again:
        assert query(again, "select tone from beep order by sequence") == [("a",), ("b",)]
        assert dict(Projector(again).behind) == {}


def test_a_table_newer_than_the_program_is_left_alone_and_the_segments_counted(
    make_log: Callable[..., Log], caplog: pytest.LogCaptureFixture
) -> None:
    log = make_log(NEW)
    with Log(log.dsn, OLD) as older:
        beep(older, "a")
        append(older, GATE, 1)
        made = project(older)
    assert (made.segments_skipped, made.position) == (1, 2)
    assert "the table is of version 2, newer than known here. Next: upgrade ViAn" in caplog.text
    assert query(log, "select type from events") == [("track_point",)]


@on_both
def test_a_rebuilt_table_has_the_same_rows(log: Log) -> None:
    append(log, GATE, 2, 3)
    append(log, YARD, 1)
    project(log)
    before = query(log, "select * from track_point_events order by source, sequence")
    with owner(log) as connection:
        connection.execute("update track_point set x = 99 where frame = 2")
    made = Projector(log)
    made.rebuild("track_point")
    assert frames(log) == []
    made.catch_up()
    made.close()
    assert query(log, "select * from track_point_events order by source, sequence") == before
    assert_rows_equal_events(log)


@on_both
def test_the_other_types_go_on_during_a_rebuild(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = TrackEnded(
        time=NOON, track_id=3, began_at=NOON, first_frame=1, last_frame=2, points=2, path_px=1.5, x_entry=1, y_entry=2,
        x_exit=3, y_exit=4, reason="lost", displacement_px=2.8, duration_s=0, x1_mean=None,
        y1_mean=None, x2_mean=None, y2_mean=None,
    )  # fmt: skip
    endings = StreamName.of("brno", "gate", "track_ended")
    monkeypatch.setattr("store.projector.DELIVERY_SEGMENTS", 2)
    append(log, GATE, *[1] * 9)
    project(log)
    made = Projector(log)
    made.rebuild("track_point")
    log.append([encode(endings, batch_of([ended]), PRODUCER), draft(GATE, 10, 10)])
    delivery = made.step()
    assert not delivery.is_caught_up
    assert (query(log, "select count(*) from track_ended"), frames(log)) == ([(1,)], [1, 2])
    assert (made.position, dict(made.behind), log.checkpoint(NAME).position) == (2, {"track_point": 2}, 11)
    made.catch_up()
    made.close()
    assert frames(log) == list(range(1, 11))
    assert_rows_equal_events(log)


@pytest.mark.parametrize("step", ["_decoded", "_copy", "_copy_what_fits", "save_checkpoint", "step_behind"])
def test_a_rebuild_that_is_cut_short_anywhere_is_finished_by_the_next_projector(
    log: Log, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    monkeypatch.setattr("store.projector.DELIVERY_SEGMENTS", 2)
    append(log, GATE, 1, 2, 3, 1, 1)
    project(log)
    made = Projector(log)
    made.rebuild("track_point")
    where = Transaction if step == "save_checkpoint" else Projector
    original = getattr(where, step)

    def stop_after(self: Any, *arguments: Any) -> Any:
        original(self, *arguments)
        raise KeyboardInterrupt

    for _ in range(2):
        with monkeypatch.context() as patch:
            patch.setattr(where, step, stop_after)
            with pytest.raises(KeyboardInterrupt):
                made.step_behind("track_point")
        append(log, GATE, 1)
    project(log)
    assert_rows_equal_events(log)


def test_a_rebuild_that_joins_waits_for_what_came_in_between(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    append(log, GATE, 1)
    project(log)
    made = Projector(log)
    made.rebuild("track_point")
    decoded = Projector._decoded

    def others_go_on(self: Projector, segments: Any) -> Any:
        monkeypatch.setattr(Projector, "_decoded", decoded)
        append(log, GATE, 1)
        other = Projector(log)
        other._store(other._subscription.poll(), 1)
        return decoded(self, segments)

    monkeypatch.setattr(Projector, "_decoded", others_go_on)
    assert not made.step_behind("track_point")
    assert (frames(log), dict(made.behind)) == ([1], {"track_point": 1})
    assert made.step_behind("track_point")
    assert (frames(log), dict(made.behind)) == ([1, 2], {})


def test_several_projectors_at_once_rebuild_each_row_once(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("store.projector.DELIVERY_SEGMENTS", 3)
    append(log, GATE, *[2] * 12)
    project(log)
    made = [Projector(log) for _ in range(3)]
    made[0].rebuild("track_point")
    append(log, YARD, 1, 1)
    together = threading.Barrier(3, timeout=60)

    def catch_up(one: Projector) -> None:
        together.wait()
        one.catch_up()
        one.close()

    threads = [threading.Thread(target=catch_up, args=(one,)) for one in made]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert [one.position for one in made] == [14] * 3
    assert_rows_equal_events(log)


def test_a_rebuild_passes_over_long_stretches_of_others_segments_step_by_step(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    append(log, GATE, *[1] * 5)
    project(log)
    monkeypatch.setattr("store.projector.BEHIND_POSITIONS", 2)
    made = Projector(log)
    made.rebuild("rule_deployed")
    reached = []
    while not made.step_behind("rule_deployed"):
        reached.append(made.behind["rule_deployed"])
    assert reached == [2, 4]
    assert log.checkpoint(BEHIND + "rule_deployed").position == 0


def test_a_rebuild_of_an_empty_log_leaves_nothing_to_do(log: Log) -> None:
    made = Projector(log)
    made.rebuild("track_point")
    assert (dict(made.behind), log.checkpoints()) == ({}, {})


def test_only_row_tables_are_rebuilt(log: Log) -> None:
    for name in ("segments", "nowhere", "events"):
        with pytest.raises(BadRequest, match=f"no row table '{name}'; known: activity_interval, "):
            Projector(log).rebuild(name)


def test_a_rebuild_waits_a_little_for_readers_and_changes_nothing_then(log: Log) -> None:
    append(log, GATE, 2)
    project(log)
    with owner(log) as connection:
        connection.execute("alter function reset_projection set lock_timeout = '50ms'")
        with connection.transaction():
            connection.execute("select * from track_point")
            with pytest.raises(TableBusy, match="track_point cannot be emptied while queries read it"):
                Projector(log).rebuild("track_point")
    assert frames(log) == [1, 2]
    assert dict(Projector(log).behind) == {}


def test_days_before_the_one_that_is_retained_are_not_made(log: Log) -> None:
    days = [point(day, time=NOON + timedelta(days=day)) for day in range(4)]
    log.append([encode(GATE, batch_of(days), PRODUCER)])
    project(log)
    made = Projector(log)
    made.rebuild("track_point", date(2026, 1, 3))
    made.catch_up()
    assert frames(log) == [2, 3]
    assert query(log, "select count(*) from pg_inherits where inhparent = 'track_point'::regclass") == [(2,)]
    made.rebuild("track_point")
    made.catch_up()
    assert frames(log) == [0, 1, 2, 3]


def test_a_projector_whose_days_another_one_emptied_makes_them_again(log: Log) -> None:
    made = Projector(log)
    append(log, GATE, 1)
    made.catch_up()
    other = Projector(log)
    other.rebuild("track_point")
    with owner(log) as connection:
        connection.execute("delete from checkpoints where name <> 'projector'")
    append(log, GATE, 1)
    made.catch_up()
    assert frames(log) == [2]


@on_both
def test_two_lives_of_a_stream_are_told_apart(log: Log) -> None:
    append(log, GATE, 2)
    log.append([draft(GATE, 7, 8), draft(GATE, 9, 9)], epochs=[2, 3])
    project(log)
    ids = query(log, "select id, epoch, sequence from events order by position, sequence")
    assert ids == [
        ("brno/gate/track_point/1", 1, 1),
        ("brno/gate/track_point/2", 1, 2),
        ("brno/gate/track_point/2:1", 2, 1),
        ("brno/gate/track_point/2:2", 2, 2),
        ("brno/gate/track_point/3:1", 3, 1),
    ]
    assert query(log, "select id, frame from track_point_events where epoch = 3") == [("brno/gate/track_point/3:1", 9)]


def test_rows_and_checkpoint_are_lost_together_or_not_at_all(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    """Commits of the projector do not wait for the disk; those of the log do."""
    seen = []
    saved = Transaction.save_checkpoint

    def look(self: Transaction, *arguments: Any) -> None:
        seen.append(self.connection.execute("show synchronous_commit").fetchone())
        saved(self, *arguments)

    monkeypatch.setattr(Transaction, "save_checkpoint", look)
    append(log, GATE, 1)
    project(log)
    assert seen == [("off",)]
    with log.connection() as connection:
        assert connection.execute("show synchronous_commit").fetchone() == ("on",)


def test_midnight_belongs_to_the_day_that_begins(log: Log) -> None:
    midnight = datetime(2026, 1, 3, tzinfo=UTC)
    log.append(
        [
            encode(
                GATE, batch_of([point(1, time=midnight - timedelta(microseconds=1)), point(2, time=midnight)]), PRODUCER
            )
        ]
    )
    made = Projector(log)
    made.rebuild("track_point", date(2026, 1, 3))
    made.catch_up()
    assert frames(log) == [2]
    with pytest.raises(psycopg.errors.InsufficientPrivilege), log.connection() as connection:
        connection.execute("update projections set retained_from = null")


def test_a_long_delivery_is_stored_in_several_transactions_and_goes_on_after_the_last_of_them(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("store.projector.COPY_EVENTS", 4)
    append(log, GATE, 3, 1, 9, 1, 1)
    made = Projector(log)
    saved, reached = Transaction.save_checkpoint, []

    def stop_at_the_third(self: Transaction, name: str, position: int, *rest: Any) -> None:
        reached.append(position)
        if len(reached) == 3:
            raise KeyboardInterrupt
        saved(self, name, position, *rest)

    with monkeypatch.context() as patch:
        patch.setattr(Transaction, "save_checkpoint", stop_at_the_third)
        with pytest.raises(KeyboardInterrupt):
            made.step()
    assert reached == [2, 3, 5]
    assert (log.checkpoint(NAME).position, frames(log)) == (3, list(range(1, 14)))
    assert made.catch_up() == 5
    made.rebuild("track_point")
    made.step_behind("track_point")
    assert (dict(made.behind), frames(log)) == ({"track_point": 2}, [1, 2, 3, 4])
    made.catch_up()
    assert_rows_equal_events(log)
