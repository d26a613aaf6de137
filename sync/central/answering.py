"""Central answers questions from the field: who may ask, what it may cost, and the record of it.

Contract: a question that is granted is answered from the rows of the stations that the caller may read, in a
transaction that writes nothing. Whatever comes of it, also a refusal or the end of its time, `query_answered` is
durable in central's log before the caller learns of it; where it cannot be recorded, there is no answer. Memory is
bounded: rows are read a batch at a time, and an answer ends at its limit of rows or of bytes.
"""

import hashlib
import json
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Literal, TypeVar

from events import Draft, Producer, QueryAnswered, Station, StreamName, batch_of, encode, station_name
from store import Log, Transaction
from store.errors import QuestionFailed, QuestionTooDear
from store.field import Cost, FieldSession, field_session, field_tables, read_session, standing
from sync.central.access import EVERY_STATION, Caller
from sync.central.access import FIND as MAY_FIND
from sync.central.access import QUERY as MAY_QUERY
from sync.central.lookup import columns_of, select
from sync.central.pages import Pages
from sync.central.places import Places
from sync.central.selects import COLUMNS_MAX, permitted
from sync.errors import Refusal, SelectRefused, WireError
from sync.keeping.held import held_of
from sync.protocol.questions import Answer, AnswerColumn, FindQuestion, QueryQuestion
from sync.protocol.wire import Message, parse

Q = TypeVar("Q", bound=Message)
Kind = Literal["plate", "situation", "sql"]
Outcome = Literal["answered", "cut", "refused", "timed_out", "failed"]

_PRODUCER = Producer("questions", "1", hashlib.sha256(b"{}").digest())
_REASON_MAX = 1_000
_KNOWN_MAX = 20


@dataclass(frozen=True, slots=True)
class QuestionLimits:
    """What questions may cost central."""

    cost: Cost = field(default_factory=Cost)
    """What each may cost the database."""
    rows_max: int = 1_000
    """Rows of an answer."""
    answer_bytes_max: int = 2 * 1024 * 1024
    """Bytes of an answer's rows."""
    row_bytes_max: int = 256 * 1024
    """Bytes of one row."""
    of_station_max: int = 2
    """Questions of one station at a time."""
    at_once_max: int = 4
    """Questions of all stations at a time; each takes a connection to the database, and replication needs some."""


class Answering:
    """Answers the questions of stations.

    Args:
        log: Central's log.
        station: Central's own name.
        pages: Seals where a question goes on.
        limits: What questions may cost.
        now: Central's clock.
        monotonic: Measures how long a question takes, s.
        still_allowed: Asked in the transaction that records an answer, before it leaves; raises if the caller may no
            longer ask, such as `Access.check_again`.
    """

    def __init__(
        self,
        log: Log,
        station: Station,
        pages: Pages,
        limits: QuestionLimits,
        now: Callable[[], datetime],
        monotonic: Callable[[], float],
        still_allowed: Callable[[Transaction, Caller], None] = lambda transaction, caller: None,
    ) -> None:
        self._log = log
        self._station = station
        self._pages = pages
        self._limits = limits
        self._now = now
        self._monotonic = monotonic
        self._still_allowed = still_allowed
        self._places = Places(
            "too_many_questions",
            "other questions are being answered",
            "ask again in a moment",
            of_station_max=limits.of_station_max,
            in_all_max=limits.at_once_max,
        )

    def find(self, caller: Caller, body: bytes) -> bytes:
        """The answer to a FindQuestion, as JSON.

        Raises:
            Refusal: It is not granted, not right, or would cost too much.
            LogUnavailable: The database is away.
        """
        question = _question(FindQuestion, body)
        with self._recorded(caller, question.kind, question.asked(), question.person) as record:
            _check_granted(caller, MAY_FIND)
            return self._found(caller, question, record)

    def query(self, caller: Caller, body: bytes) -> bytes:
        """The answer to a QueryQuestion, as JSON.

        Raises:
            Refusal: It is not granted, not right, or would cost too much.
            LogUnavailable: The database is away.
        """
        question = _question(QueryQuestion, body)
        with self._recorded(caller, "sql", question.sql, question.person) as record:
            _check_granted(caller, MAY_QUERY)
            return self._selected(caller, question, record)

    def _found(self, caller: Caller, question: FindQuestion, record: "_Record") -> bytes:
        if question.station is not None and not caller.may_read(question.station):
            raise _not_granted(f"events of station {question.station}", caller)
        self._check_known(caller, question.station)
        asked = question.asked()
        after = None if question.page is None else self._pages.opened(caller.station, asked, question.page)
        columns, limit = columns_of(question.kind), min(question.limit, self._limits.rows_max)
        text, parameters = select(question, _stations(caller), after, limit + 1)
        stands = standing(self._log, QueryAnswered.type_name)
        with self._answered(read_session(self._log, self._limits.cost, self._monotonic)) as session:
            lines = session.lines(
                text, len(columns) + 1, parameters, rows_max=limit + 1, bytes_max=self._limits.row_bytes_max
            )
            told, key = _page(self._told(lines, limit))
        record.note(told)
        more = None if key is None else self._pages.sealed(caller.station, asked, key)
        return self._answer(columns, told, stands, more)

    def _check_known(self, caller: Caller, station: str | None) -> None:
        """Refuse a station that nobody knows here, to who may know all: an empty answer would hide the slip.

        Raises:
            Refusal: It is not known.
        """
        if station is None or EVERY_STATION not in caller.reads or held_of(self._log, station_name(station)):
            return
        known = sorted({str(head.stream.station) for head in self._log.streams()})
        shown = f"{', '.join(known[:_KNOWN_MAX])}{', ...' if len(known) > _KNOWN_MAX else ''}" or "none yet"
        raise _bad_question(f"no station {station!r} in central's log; known: {shown}", "a station that is known")

    def _selected(self, caller: Caller, question: QueryQuestion, record: "_Record") -> bytes:
        try:
            text = permitted(question.sql, field_tables(self._log))
        except SelectRefused as error:
            raise _bad_question(str(error), "one SELECT over the tables of events") from error
        limits, stands = self._limits, standing(self._log, QueryAnswered.type_name)
        with self._answered(field_session(self._log, _stations(caller), limits.cost, self._monotonic)) as session:
            columns = tuple(AnswerColumn(name=name, type=kind) for name, kind in session.columns(text))
            if not 1 <= len(columns) <= COLUMNS_MAX:
                raise _bad_question(f"{len(columns)} columns", f"1 to {COLUMNS_MAX} columns")
            rows_max = min(question.limit, limits.rows_max)
            lines = session.lines(text, len(columns), rows_max=rows_max + 1, bytes_max=limits.row_bytes_max)
            told = self._told(lines, rows_max)
        record.note(told)
        return self._answer(columns, told, stands, None)

    def _answer(
        self, columns: tuple[AnswerColumn, ...], told: "_Told", stands: tuple[int, int], more: str | None
    ) -> bytes:
        position, rows = stands
        answer = Answer(
            station=self._station,
            time=self._now(),
            columns=columns,
            next=more,
            cut=told.cut,
            position=position,
            rows_position=rows,
        )
        return answer.with_lines(told.lines)

    def _told(self, lines: Iterator[str | None], rows_max: int) -> "_Told":
        """As many of the rows as an answer may hold.

        Raises:
            Refusal: One row is too large for any answer.
        """
        told: list[str] = []
        size = 0
        for line in lines:
            if line is None:
                raise _bad_question(
                    f"a row of more than {self._limits.row_bytes_max} bytes",
                    f"rows of at most {self._limits.row_bytes_max} bytes",
                )
            if len(told) == rows_max:
                return _Told(told, f"the limit of {rows_max} rows")
            size += len(line.encode()) + 1
            if size > self._limits.answer_bytes_max:
                return _Told(told, f"the limit of {self._limits.answer_bytes_max} bytes")
            told.append(line)
        return _Told(told)

    @contextmanager
    def _answered(self, opened: AbstractContextManager[FieldSession]) -> Iterator[FieldSession]:
        """The session, with what goes wrong in it as a refusal."""
        try:
            with opened as session:
                yield session
        except QuestionFailed as error:
            raise _bad_question(str(error), "a question that PostgreSQL can answer") from error
        except QuestionTooDear as error:
            raise Refusal(
                422,
                "timed_out" if error.is_time else "too_dear",
                "the question would cost central too much",
                str(error),
                f"at most {self._limits.cost.seconds:g} s and {self._limits.cost.disk_mb} MB",
                "ask for less: a span of time, one station, one source, fewer rows",
            ) from error

    @contextmanager
    def _recorded(self, caller: Caller, kind: Kind, question: str, person: str | None) -> Iterator["_Record"]:
        """Whatever comes of the question in the block is in the log when the block ends."""
        record, began = _Record(), self._monotonic()

        def event() -> QueryAnswered:
            return QueryAnswered(
                time=self._now(),
                asked_by=caller.station,
                person=person,
                kind=kind,
                question=question,
                outcome=record.outcome,
                row_count=record.rows,
                duration_s=max(self._monotonic() - began, 0.0),
                reason=record.reason,
            )

        try:
            with self._places.taken(caller.station):
                yield record
            with self._log.transaction() as transaction:
                self._still_allowed(transaction, caller)
                transaction.append([self._draft(event())])
        except BaseException as error:
            record.came_to_nothing(error)
            self._log.append([self._draft(event())])
            raise

    def _draft(self, event: QueryAnswered) -> Draft:
        return encode(StreamName.of(self._station, "sync", QueryAnswered.type_name), batch_of([event]), _PRODUCER)


@dataclass(slots=True)
class _Record:
    """What is recorded of one question; failed until it is known better."""

    outcome: Outcome = "failed"
    rows: int = 0
    reason: str | None = None

    def note(self, told: "_Told") -> None:
        """It was answered."""
        self.outcome, self.rows = "cut" if told.cut else "answered", len(told.lines)

    def came_to_nothing(self, error: BaseException) -> None:
        """It was not."""
        self.outcome, self.rows = "failed", 0
        self.reason = str(error)[:_REASON_MAX] or type(error).__name__
        if isinstance(error, Refusal):
            self.outcome = "timed_out" if error.code == "timed_out" else "refused"
            self.reason = f"{error.code}: {error.got}"[:_REASON_MAX]


@dataclass(frozen=True, slots=True)
class _Told:
    """An answer's rows, and what cut them short."""

    lines: list[str]
    cut: str | None = None


def _page(told: _Told) -> tuple[_Told, list[Any] | None]:
    """The rows without their keys, and the key of the last one where there are more: a page is no cut."""
    rows = [json.loads(line) for line in told.lines]
    keys = [row.pop() for row in rows]
    lines = [json.dumps(row, ensure_ascii=False, separators=(",", ":")) for row in rows]
    return _Told(lines), keys[-1] if told.cut and keys else None


def _stations(caller: Caller) -> list[str] | None:
    """The stations that the caller may read; None for all."""
    return None if EVERY_STATION in caller.reads else sorted(caller.reads)


def _question(kind: type[Q], body: bytes) -> Q:
    try:
        return parse(kind, body)
    except WireError as error:
        raise Refusal(
            400,
            "bad_question",
            "the body is no question",
            str(error),
            f"a {kind.__name__} in JSON",
            "upgrade ViAn on the older side",
        ) from error


def _check_granted(caller: Caller, operation: str) -> None:
    if operation not in caller.operations:
        raise _not_granted(f"to {operation}", caller)


def _not_granted(wanted: str, caller: Caller) -> Refusal:
    reads = ", ".join(sorted(caller.reads)) or "none"
    return Refusal(
        403,
        "not_granted",
        f"station {caller.station} is not granted that",
        wanted,
        f"operations: {', '.join(sorted(caller.operations)) or 'none'}; events of stations: {reads}",
        f"on central: vian station invite {caller.station} --operations find,query --reads NAMES, "
        "then vian station enrol here",
    )


def _bad_question(got: str, wanted: str) -> Refusal:
    return Refusal(
        422,
        "bad_question",
        "the question cannot be answered",
        got,
        wanted,
        "correct it; docs/reference/sync.md says what a question may use",
    )
