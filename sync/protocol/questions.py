"""What a station asks of central, and what it is answered: the messages.

Contract: frozen. A question is one page: with `next` of an answer as `page` it asks for what follows. What was asked
and by whom is recorded at central before the answer leaves.
"""

from collections.abc import Callable
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, JsonValue, model_validator

from sync.protocol.wire import Message, StationText, Text

FIND = "find"
QUERY = "query"
ROWS_MAX = 10_000
"""Most rows that a question may ask for."""
QUESTION_BYTES_MAX = 64 * 1024
"""Most bytes of a question."""
SQL_LENGTH_MAX = 10_000
"""Most characters of a question in SQL."""

PersonText = Annotated[str, Field(max_length=200)]
PatternText = Annotated[str, Field(min_length=1, max_length=100)]
Severity = Literal["info", "warning", "alarm"]


class FindQuestion(Message):
    """Which plates were read, or which situations found: the newest first."""

    kind: Literal["plate", "situation"]
    plate: PatternText | None = None
    """the plate; * stands for any letters, ? for one; capital or small, with or without blanks and dashes"""
    rule: PatternText | None = None
    """the rule; with * and ? likewise; all by default"""
    severity: Severity | None = None
    """of this severity only"""
    station: StationText | None = None
    """recorded by this station only"""
    source: Text | None = None
    """of this camera or sensor only"""
    since: AwareDatetime | None = None
    """at or after this time"""
    until: AwareDatetime | None = None
    """before this time"""
    limit: Annotated[int, Field(ge=1, le=ROWS_MAX)] = 100
    """most rows of a page"""
    page: Text | None = None
    """`next` of the answer before"""
    person: PersonText | None = None
    """account of who asks"""

    @model_validator(mode="after")
    def _is_about_something(self) -> "FindQuestion":
        if self.kind == "plate" and self.plate is None:
            raise ValueError("a question for plates names one")
        if self.kind == "plate" and (self.rule or self.severity):
            raise ValueError("rule and severity are of situations")
        if self.kind == "situation" and self.plate is not None:
            raise ValueError("a plate is not of situations")
        return self

    def asked(self) -> str:
        """What is looked for, as JSON: the question without who asks, and where it goes on."""
        return self.model_dump_json(exclude={"person", "limit", "page"}, exclude_none=True)


class QueryQuestion(Message):
    """A question in SQL: one SELECT over the tables of events."""

    sql: Annotated[str, Field(max_length=SQL_LENGTH_MAX)]
    limit: Annotated[int, Field(ge=1, le=ROWS_MAX)] = 1_000
    """most rows of the answer"""
    person: PersonText | None = None
    """account of who asks"""


class AnswerColumn(Message):
    """A column of an answer."""

    name: str
    type: Text
    """its type in PostgreSQL: text, int8, float4, timestamptz, jsonb, ..."""


class Answer(Message):
    """What central knows."""

    station: StationText
    """central's own name"""
    time: AwareDatetime
    """central's clock"""
    columns: tuple[AnswerColumn, ...]
    rows: tuple[tuple[JsonValue, ...], ...] = ()
    """a value for each column; times in ISO 8601 (UTC), bytes in hexadecimal behind \\\\x, NaN and infinity as text"""
    next: Text | None = None
    """where the question goes on; null where there is no more, or the question cannot go on"""
    cut: Text | None = None
    """which limit cut the answer short; null where it is whole"""
    position: Annotated[int, Field(ge=0)]
    """newest segment of central's log, but for the record of questions"""
    rows_position: Annotated[int, Field(ge=0)]
    """newest segment of which the rows answer"""

    def with_lines(self, lines: list[str]) -> bytes:
        """The answer as JSON, with rows that are JSON already."""
        head = self.model_dump_json(exclude={"rows"})
        return f'{head[:-1]},"rows":[{",".join(lines)}]}}'.encode()

    def values(self) -> list[list[Any]]:
        """The rows; times as such, but for those that Python does not know."""
        readers = [_READERS.get(column.type, _as_is) for column in self.columns]
        return [[read(value) for read, value in zip(readers, row, strict=True)] for row in self.rows]

    def records(self) -> list[dict[str, Any]]:
        """The rows by column name."""
        names = [column.name for column in self.columns]
        return [dict(zip(names, row, strict=True)) for row in self.values()]

    @model_validator(mode="after")
    def _is_whole(self) -> "Answer":
        wanted = len(self.columns)
        if any(len(row) != wanted for row in self.rows):
            raise ValueError(f"each row must have {wanted} values, one for each column")
        return self


def _as_is(value: JsonValue) -> Any:
    return value


def _time(value: JsonValue) -> Any:
    try:
        return datetime.fromisoformat(value) if isinstance(value, str) else value
    except ValueError:
        return value


_READERS: dict[str, Callable[[JsonValue], Any]] = {"timestamptz": _time}
