"""Questions of this station to central, and to itself where central cannot be reached.

Contract: an answer says who gave it. What this station holds by itself is partial: it bears the age of the last
contact with central, and why central did not answer. A refusal of central is an error, never a partial answer.
"""

import getpass
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Protocol

import pyarrow as pa
import sqlglot
from sqlglot.errors import SqlglotError

from store import Log
from sync.central.lookup import columns_of
from sync.errors import BadAnswer, CentralError, CentralFailed, CentralUnreachable, Refused
from sync.protocol.questions import Answer, FindQuestion, QueryQuestion
from sync.protocol.reports import saved_status
from vian.errors import WorldFailed, WrongUsage
from vian.lookup import look_up
from vian.options import check_known
from vian.output import counted, printable, to_json
from vian.querying import Scope
from vian.querying import query as answer_here

_AWAY = (CentralUnreachable, CentralFailed, BadAnswer)
"""Central did not say anything; what it would say is not known."""


class Desk(Protocol):
    """Central, as one who asks sees it."""

    def find(self, question: FindQuestion) -> Answer:
        """One page of what central knows; may be asked again.

        Raises:
            CentralError: There is no answer.
        """

    def query(self, question: QueryQuestion) -> Answer:
        """Central's answer to SQL; may be asked again.

        Raises:
            CentralError: There is no answer.
        """


@dataclass(frozen=True, slots=True)
class Source:
    """Who gave an answer, and how far it reaches."""

    by: str
    """station or central that answered, by name"""
    is_partial: bool = False
    """whether central could not be asked, so that it is what this station holds"""
    why: str | None = None
    """why central did not answer"""
    last_contact: datetime | None = None
    """when central last answered this station; None for never, or where it is not known"""
    behind: int = 0
    """segments that central holds and that its rows do not answer for yet"""
    cut: str | None = None
    """which limit cut the answer short"""
    next: str | None = None
    """where it goes on"""

    def remarks(self, now: datetime) -> list[str]:
        """What a reader must know of the answer, in sentences."""
        told = []
        if self.is_partial:
            told.append(
                f"PARTIAL: this is what station {self.by} itself holds; central did not answer. "
                f"Last contact with central: {_ago(self.last_contact, now)}. {self.why}"
            )
        if self.behind:
            newest = counted(self.behind, "segment")
            told.append(f"central is still making rows of its newest {newest}, which may hold more")
        if self.cut:
            told.append(f"cut short by {self.cut}; ask for less at a time, or for more rows with --limit")
        if self.next:
            told.append("there is more: add --all, or go on with --page and what --json tells as next")
        return told

    def summary(self, rows: int, now: datetime) -> dict[str, Any]:
        """The same for machines."""
        age = None if self.last_contact is None else round((now - self.last_contact).total_seconds(), 3)
        contact = {"why": self.why, "last_contact": self.last_contact, "last_contact_age_s": age}
        return {
            "answered_by": self.by,
            "partial": self.is_partial,
            **(contact if self.is_partial else {}),
            "rows": rows,
            "rows_behind": self.behind,
            "cut": self.cut,
            "next": self.next,
        }


@dataclass(frozen=True, slots=True)
class Found:
    """What was found, the newest first."""

    source: Source
    columns: tuple[str, ...]
    rows: list[list[Any]] = field(default_factory=list)


def person() -> str:
    """The account that asks, as this machine knows it; central records it."""
    return getpass.getuser()[:200]


def find_at_central(desk: Desk, log: Log, station: str, question: FindQuestion, *, is_all: bool) -> Found:
    """What central finds; what this station finds where central does not answer.

    Raises:
        CentralError: Central refuses.
        WrongUsage: The question is not right.
    """
    rows: list[list[Any]] = []
    while True:
        try:
            answer = desk.find(question)
        except Refused as error:
            raise _wrong(error) from error
        except _AWAY as error:
            if rows:
                raise WorldFailed(
                    f"{error}. {len(rows)} rows had come by then; none is shown, because they are not all. "
                    "Next: give the command again, or without --all"
                ) from error
            return find_here(log, station, question, is_all=is_all, away=error)
        rows += answer.values()
        if answer.next is None or not is_all:
            return Found(_source_of(answer), tuple(column.name for column in answer.columns), rows)
        question = question.model_copy(update={"page": answer.next})


def find_here(
    log: Log, station: str, question: FindQuestion, *, is_all: bool, away: CentralError | None = None
) -> Found:
    """What this station finds in its own log; partial where central was asked and did not answer.

    Raises:
        WrongUsage: It was asked of a station or a source that this log does not know.
    """
    if away is None:
        _check_known(log, question)
    found = look_up(log, question, None if is_all else question.limit + 1)
    more = not is_all and len(found) > question.limit
    rows = [list(row.values()) for row in found][: None if is_all else question.limit]
    names = tuple(column.name for column in columns_of(question.kind))
    cut = f"the limit of {question.limit} rows" if more else None
    return Found(_here(log, station, away, cut), names, rows)


def _check_known(log: Log, question: FindQuestion) -> None:
    """Refuse a station or a source of which the log has nothing: an empty answer would hide the slip."""
    streams = [head.stream for head in log.streams()]
    check_known("station", question.station and [question.station], {stream.station for stream in streams})
    check_known("source", question.source and [question.source], {stream.source for stream in streams})


def query_at_central(desk: Desk, log: Log, station: str, question: QueryQuestion) -> tuple[Source, pa.Table]:
    """Central's answer to SQL; this station's, in DuckDB, where central does not answer.

    Raises:
        CentralError: Central refuses.
        WrongUsage: The question is not right.
        WorldFailed: Central does not answer, and this station cannot answer that either.
    """
    try:
        answer = desk.query(question)
    except Refused as error:
        raise _wrong(error) from error
    except _AWAY as error:
        try:
            table = answer_here(log, _for_duckdb(question.sql), Scope(is_as_at_central=True))
        except (WrongUsage, SqlglotError) as cause:
            raise WorldFailed(f"{error}. Nor can this station answer it by itself: {cause}") from cause
        cut = f"the limit of {question.limit} rows" if table.num_rows > question.limit else None
        return _here(log, station, error, cut), table.slice(0, question.limit)
    return _source_of(answer), table_of(answer)


def table_of(answer: Answer) -> pa.Table:
    """An answer as a table; what Arrow has no type for here becomes text."""
    rows = answer.values()
    arrays = []
    for place, column in enumerate(answer.columns):
        type_, convert = _ARROW.get(column.type, (pa.string(), _text))
        arrays.append(pa.array([convert(row[place]) for row in rows], type_))
    return pa.Table.from_arrays(arrays, names=[column.name for column in answer.columns])


def _wrong(error: Refused) -> Exception:
    """What a refusal is for who asked: wrong usage, with the place in the question, where the question is not right."""
    if error.code not in ("bad_question", "unknown_page"):
        return error
    return WrongUsage(f"central cannot answer that: {printable(error.got)}")


def _for_duckdb(sql: str) -> str:
    statements = sqlglot.transpile(sql, read="postgres", write="duckdb")
    if len(statements) != 1:
        raise WrongUsage(f"a question is one SELECT, got {len(statements)} statements")
    return statements[0]


def _source_of(answer: Answer) -> Source:
    behind = max(answer.position - answer.rows_position, 0)
    return Source(answer.station, behind=behind, cut=answer.cut, next=answer.next)


def _here(log: Log, station: str, away: CentralError | None, cut: str | None) -> Source:
    if away is None:
        return Source(station, cut=cut)
    status = saved_status(log)
    return Source(station, True, str(away), status.last_contact if status else None, cut=cut)


def _ago(then: datetime | None, now: datetime) -> str:
    """How long ago, in the two largest units.

    >>> from datetime import UTC
    >>> _ago(datetime(2026, 1, 1, tzinfo=UTC), datetime(2026, 1, 3, 4, 5, tzinfo=UTC))
    '2 d 4 h ago (2026-01-01 00:00:00 UTC)'
    """
    if then is None:
        return "never, or not by a daemon of this ViAn"
    seconds = max(int((now - then) / timedelta(seconds=1)), 0)
    parts = [(seconds // 86_400, "d"), (seconds // 3_600 % 24, "h"), (seconds // 60 % 60, "min"), (seconds % 60, "s")]
    first = next((place for place, (number, _) in enumerate(parts) if number), len(parts) - 1)
    shown = " ".join(f"{number} {unit}" for number, unit in parts[first : first + 2])
    return f"{shown} ago ({then:%Y-%m-%d %H:%M:%S} UTC)"


def _same(value: Any) -> Any:
    return value


def _float(value: Any) -> float | None:
    return None if value is None else float(value)  # NaN and infinity come as text


def _text(value: Any) -> str | None:
    return value if value is None or isinstance(value, str) else to_json(value)


def _moment(value: Any) -> datetime | None:
    return value if isinstance(value, datetime) else None


_ARROW: dict[str, tuple[pa.DataType, Callable[[Any], Any]]] = {
    "bool": (pa.bool_(), _same),
    "int2": (pa.int64(), _same),
    "int4": (pa.int64(), _same),
    "int8": (pa.int64(), _same),
    "float4": (pa.float64(), _float),
    "float8": (pa.float64(), _float),
    "numeric": (pa.float64(), _float),
    "timestamptz": (pa.timestamp("us", tz="UTC"), _moment),
}
