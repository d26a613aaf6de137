"""The append function on PostgreSQL: its errors, and what a writer cannot slip into it."""

from datetime import timedelta

import psycopg
import pytest

from store import Log, LogUnavailable, SequenceConflict, StoreError, Transaction
from tests.store.samples import GATE, YARD, append, draft, on_both, owner, query


def test_what_a_column_cannot_hold_is_an_error_of_ours(log: Log) -> None:
    with pytest.raises(StoreError, match="the append failed") as caught:
        log.append([draft(GATE, 1, 1)], epochs=[2**40])
    assert not isinstance(caught.value, LogUnavailable)


def test_an_error_can_be_hashed_and_told_from_another() -> None:
    first, second = (SequenceConflict(GATE, 1, 2) for _ in range(2))
    assert len({first, second}) == 2


@on_both
def test_a_writer_that_is_disconnected_in_its_transaction_leaves_no_hole(log: Log) -> None:

    def lose_the_connection() -> None:
        with log.transaction() as transaction:
            transaction.append([draft(YARD, 1, 5)])
            query(log, "select pg_terminate_backend(%s, 10000)", transaction.connection.info.backend_pid)
            transaction.append([draft(YARD, 6, 6)])

    with pytest.raises(LogUnavailable):
        lose_the_connection()
    append(log, GATE, 1)
    assert [(segment.position, segment.stream) for segment in log.read_all()] == [(1, GATE)]


def test_a_full_disk_is_an_outage_not_a_refusal(log: Log) -> None:
    with owner(log) as connection:
        # What PostgreSQL raises when a table cannot grow; the real thing is in test_outages.py.
        connection.execute(
            "create function full_disk() returns trigger language plpgsql as "
            "$$ begin raise exception 'could not extend file: No space left on device' using errcode = '53100'; end $$"
        )
        connection.execute("create trigger full_disk before insert on segments execute function full_disk()")
        with pytest.raises(LogUnavailable, match="No space left on device"):
            append(log, GATE, 1)
        connection.execute("drop trigger full_disk on segments")
    append(log, GATE, 1)
    assert log.head() == 1


def test_a_temporary_table_of_the_writer_does_not_stand_in_for_the_logs(log: Log) -> None:
    with log.connection() as connection:
        for table in ("log_head", "streams", "segments"):
            connection.execute(
                psycopg.sql.SQL("create temporary table {0} (like public.{0})").format(psycopg.sql.Identifier(table))
            )
        with connection.transaction():
            Transaction(connection, log.epoch, log.archive, log.room).append([draft(GATE, 1, 2)], [0])
        connection.execute("discard temp")
    assert log.stream_head(GATE).sequence == 2


@on_both
def test_recorded_at_does_not_go_back_with_the_clock(log: Log) -> None:
    append(log, GATE, 1)
    with owner(log) as connection:
        # The clock stood a day ahead when the newest segment was recorded, and was then set right.
        connection.execute("update log_head set recorded_at = recorded_at + interval '1 day'")
    ahead = query(log, "select recorded_at from log_head")[0][0]
    append(log, GATE, 1, 1)
    assert [segment.recorded_at for segment in log.read_all(2)] == [ahead, ahead]
    with owner(log) as connection:
        connection.execute("update log_head set recorded_at = recorded_at - interval '2 days'")
    append(log, YARD, 1)
    *_, newest = log.read_all()
    assert ahead - timedelta(days=1) < newest.recorded_at < ahead, "once the clock has caught up it is told again"
    assert query(log, "select recorded_at from log_head") == [(newest.recorded_at,)]
