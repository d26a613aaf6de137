"""The transaction in which a question from the field is answered: what it may read, and what it may cost.

Contract: within the block the connection is the role `vian_field`, read-only. It reads the views `field_<type>`,
`field_events` and `field_streams`, which show the rows of the stations that were named and of no others; and it
cannot change which those are: they were written, before it became that role, where only the views look. The
transaction never commits. It does not judge what is asked: that is the caller's work, before.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NoReturn

import psycopg

from store.errors import LogUnavailable, QuestionFailed, QuestionTooDear
from store.log import Log
from store.projector import BEHIND
from store.projector import NAME as PROJECTOR

VIEW_PREFIX = "field_"
"""Begins the name of the view of a table for questions from the field."""


@dataclass(frozen=True, slots=True)
class Cost:
    """What one question may cost central."""

    seconds: float = 10.0
    """From its beginning to its last row."""
    memory_mb: int = 16
    """Memory of each sort or hash table, MB; beyond it PostgreSQL goes to its disk."""
    disk_mb: int = 256
    """Room on that disk, MB, where the database's owner may bound it."""
    lock_seconds: float = 2.0
    """How long it waits for a table that is being changed."""


class FieldSession:
    """What a question may do within its transaction: ask once or more, until its time is up."""

    def __init__(self, connection: psycopg.Connection[Any], cost: Cost, monotonic: Callable[[], float]) -> None:
        self._connection = connection
        self._cost = cost
        self._monotonic = monotonic
        self._end = monotonic() + cost.seconds

    def columns(self, select: str) -> list[tuple[str, str]]:
        """Name and PostgreSQL type of each column of the SELECT, which is not run.

        Raises:
            QuestionFailed: PostgreSQL does not take it.
            QuestionTooDear: The time is up.
        """
        with self._told():
            cursor = self._connection.execute(f"select * from ({select}) as asked limit 0".encode())
            return [(column.name, column.type_display) for column in cursor.description or ()]

    def lines(
        self,
        select: str,
        columns: int,
        parameters: dict[str, Any] | None = None,
        *,
        rows_max: int,
        bytes_max: int,
        batch: int = 100,
    ) -> Iterator[str | None]:
        """Each row of the SELECT as a JSON array, read a batch at a time; None for one of more than `bytes_max` bytes.

        Args:
            select: The SELECT; with parameters, as psycopg takes them.
            columns: How many columns it has.
            parameters: Values for it.
            rows_max: Rows that it ends with, however many there are.
            bytes_max: Most bytes of a row.
            batch: Rows that are read at a time.

        Raises:
            QuestionFailed: PostgreSQL cannot answer it.
            QuestionTooDear: It would cost more than it may.
        """
        names = ", ".join(f"c{number}" for number in range(columns))
        # Offset 0 keeps PostgreSQL from making each line twice.
        query = (
            f"select case when octet_length(line) <= {bytes_max} then line end from "
            f"(select cast(json_build_array({names}) as text) as line from ({select}) as asked ({names}) "
            f"offset 0 limit {rows_max}) as t"
        )
        with self._told():
            self._connection.execute(f"declare question no scroll cursor for {query}".encode(), parameters)
        while True:
            with self._told():
                rows = self._connection.execute(f"fetch forward {batch} from question".encode()).fetchall()
            for (line,) in rows:
                yield line
            if len(rows) < batch:
                return

    @contextmanager
    def _told(self) -> Iterator[None]:
        """Give the statement the time that is left, and say what its failure means."""
        left_ms = int((self._end - self._monotonic()) * 1000)
        if left_ms <= 0:
            raise self._timed_out()
        try:
            self._connection.execute(f"set local statement_timeout = {left_ms}".encode())
            yield
        except psycopg.errors.QueryCanceled as error:
            raise self._timed_out() from error
        except psycopg.Error as error:
            self._tell(error)

    def _timed_out(self) -> QuestionTooDear:
        return QuestionTooDear(f"it took longer than {self._cost.seconds:g} s", is_time=True)

    def _tell(self, error: psycopg.Error) -> NoReturn:
        said = error.diag.message_primary or str(error).strip()
        if isinstance(error, psycopg.errors.LockNotAvailable):
            raise QuestionTooDear(f"a table was being changed for {self._cost.lock_seconds:g} s") from error
        if error.sqlstate is not None and error.sqlstate.startswith("53"):
            raise QuestionTooDear(f"it needs too much memory or disk: {said}") from error
        if error.sqlstate is None or error.sqlstate.startswith(("08", "57", "58", "XX")):
            raise error  # the database's own trouble, which the log's connection tells
        raise QuestionFailed(said) from error


@contextmanager
def read_session(
    log: Log, cost: Cost | None = None, monotonic: Callable[[], float] = time.monotonic
) -> Iterator[FieldSession]:
    """A session that reads, as the log's own role, for a SELECT of our own that says itself whose rows it wants.

    Raises:
        LogUnavailable: The database is away.
    """
    most = cost or Cost()
    with _transaction(log) as connection:
        connection.execute(_limits(most, has_disk=_may_bound_disk(connection)).encode())
        connection.execute("set transaction read only")
        yield FieldSession(connection, most, monotonic)


@contextmanager
def field_session(
    log: Log,
    stations: Sequence[str] | None,
    cost: Cost | None = None,
    monotonic: Callable[[], float] = time.monotonic,
) -> Iterator[FieldSession]:
    """A session for what others ask: it reads what these stations recorded, all stations for None.

    Raises:
        LogUnavailable: The database is away, or this account may not act as `vian_field`.
    """
    most = cost or Cost()
    with _transaction(log) as connection:
        connection.execute(
            "insert into field_callers (transaction, stations) "
            "values (cast(cast(pg_current_xact_id() as text) as bigint), %s)",
            (None if stations is None else list(stations),),
        )
        connection.execute(_limits(most, has_disk=_may_bound_disk(connection)).encode())
        try:
            connection.execute("set local role vian_field")
        except psycopg.errors.InsufficientPrivilege as error:
            raise LogUnavailable(
                f"this account of the database may not answer questions from the field: {error}. "
                "Next: as the database's owner, grant vian_field to this account"
            ) from error
        connection.execute("set transaction read only")
        yield FieldSession(connection, most, monotonic)


@contextmanager
def _transaction(log: Log) -> Iterator[psycopg.Connection[Any]]:
    with log.connection() as connection, connection.transaction(force_rollback=True):
        yield connection


def field_tables(log: Log) -> dict[str, tuple[str, ...]]:
    """The tables that a question may name, each with its columns; the view that answers has `VIEW_PREFIX` before.

    Raises:
        LogUnavailable: The database is away.
    """
    with log.connection() as connection:
        rows = connection.execute(
            "select n.name, array_agg(cast(a.attname as text) order by a.attnum) "
            "from (select name from projections union all values ('events'), ('streams'), ('track_ground')) as n "
            "join pg_attribute a on a.attrelid = to_regclass(quote_ident(%s || n.name)) "
            "where a.attnum > 0 and not a.attisdropped group by n.name order by n.name",
            (VIEW_PREFIX,),
        ).fetchall()
    return {name: tuple(columns) for name, columns in rows}


def standing(log: Log, leave_out: str) -> tuple[int, int]:
    """Newest position of the log, and position up to which all rows are there: what is behind does not answer yet.

    Args:
        log: The log.
        leave_out: Event type that does not count: the record of questions, which grows with each.

    Raises:
        LogUnavailable: The database is away.
    """
    with log.connection() as connection:
        row = connection.execute(
            "with projected as (select coalesce(min(position), 0) as position from checkpoints "
            "where name = %(projector)s or starts_with(name, %(behind)s)) "
            "select coalesce((select s.position from segments s join streams t on t.id = s.stream_id "
            "where s.position > p.position and t.type <> %(leave_out)s order by s.position desc limit 1), p.position), "
            "p.position from projected p",
            {"projector": PROJECTOR, "behind": BEHIND, "leave_out": leave_out},
        ).fetchone()
    assert row is not None, "an aggregate has one row"
    return int(row[0]), int(row[1])


def _may_bound_disk(connection: psycopg.Connection[Any]) -> bool:
    row = connection.execute("select has_parameter_privilege('temp_file_limit', 'set')").fetchone()
    assert row is not None, "a function answers"
    return bool(row[0])


def _limits(cost: Cost, *, has_disk: bool) -> str:
    """What bounds the rest of the transaction."""
    disk = [f"set local temp_file_limit = '{cost.disk_mb}MB'"] if has_disk else []
    return "; ".join(
        [
            *disk,
            f"set local work_mem = '{cost.memory_mb}MB'",
            "set local hash_mem_multiplier = 1",
            f"set local lock_timeout = {int(cost.lock_seconds * 1000)}",
            "set local max_parallel_workers_per_gather = 0",  # one question, one processor
            "set local jit = off",
        ]
    )
