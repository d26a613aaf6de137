"""The plan: which streams a station sends to central, from when on, in which order and how fast.

Contract: a plan is an ordered list of entries; the first entry whose pattern fits a stream decides
what becomes of it, a stream that fits none stays at the station. Its hash is that of its canonical
form, so two files that say the same are the same plan, in YAML or in TOML. A plan of the first version
(stream, from, priority) reads, and has the hash that it always had.

An entry with a row filter or with fields to leave out does not send the stream itself: a stream derived
from it is sent instead (`sync.deriving`). The name of a derived stream says by which filter it was made.

It reads no log and sends nothing.
"""

import hashlib
import json
import re
from collections.abc import Hashable, Mapping
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PlainSerializer,
    ValidationError,
    field_validator,
    model_validator,
)

from events import InvalidName, Source, Station, StreamName
from sync.errors import PlanError
from sync.plan_files import FILE_BYTES_MAX, document
from sync.plan_values import duration, no_text, rate, time_text, truth, whole_seconds
from sync.where import parse as parse_condition

LANES: Mapping[str, int] = {"alerts": 0, "situations": 10, "tracks": 20, "points": 30, "media": 40}
"""Names of priorities; a smaller number goes first, and there is room between them."""
PRIORITY_MAX = 99
ENTRIES_MAX = 1000
LEAVE_OUT_MAX = 100
WHERE_CHARACTERS_MAX = 4000
BACKLOG_SHARE_MAX = 0.9
HASH_DIGITS = 8
"""Hexadecimal digits of a filter's hash in the name of a derived stream."""

_PART = re.compile(r"(?:[A-Za-z0-9._*?-]|\[!?[A-Za-z0-9._-]+\]){1,64}")


def _priority(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value.isdecimal() and len(value) <= 3:
        return int(value)
    if value not in LANES:
        raise ValueError(f"must be one of {', '.join(LANES)}, or a number from 0 (first) to {PRIORITY_MAX}")
    return LANES[value]


def _begin(value: object) -> object:
    if value in ("beginning", "now"):
        return value
    return _time(value, "must be beginning, now, or a time with its zone such as 2026-11-01T00:00:00Z")


def _time(value: object, wanted: str = "must be a time with its zone such as 2026-11-01T00:00:00Z") -> datetime:
    try:
        time = datetime.fromisoformat(value) if isinstance(value, str) else value
        if not isinstance(time, datetime) or time.tzinfo is None:
            raise ValueError(wanted)
        return time.astimezone(UTC)
    except (ValueError, OverflowError) as error:
        raise ValueError(wanted) from error


def _pattern(text: str) -> str:
    parts = text.split("/")
    if len(parts) != 3:
        raise ValueError("must be a pattern station/source/type, such as */*/situation_detected")
    for part in parts:
        if not _PART.fullmatch(part):
            raise ValueError(
                f"the part {part[:64]!r} must be 1 to 64 of A-Z a-z 0-9 . _ - * ? or a set such as [abc] or [!abc]"
            )
    return text


def _share(value: object) -> object:
    try:
        return float(value) if isinstance(value, str | int) and not isinstance(value, bool) else value
    except ValueError as error:
        raise ValueError(f"must be a number from 0 to {BACKLOG_SHARE_MAX}, such as 0.2") from error


def _names(value: object) -> object:
    if not isinstance(value, list | tuple):
        raise ValueError("must be a list of fields, such as [vx, vy]")
    return tuple(value)


_Rate = Annotated[
    int | None,
    BeforeValidator(rate),
    PlainSerializer(lambda bps: None if bps is None else f"{bps} bit/s", return_type=str | None),
]
_Time = Annotated[datetime | None, BeforeValidator(_time), PlainSerializer(time_text, return_type=str | None)]
_Begin = Annotated[
    Literal["beginning", "now"] | datetime,
    BeforeValidator(_begin),
    PlainSerializer(lambda begin: time_text(begin) if isinstance(begin, datetime) else begin, return_type=str),
]


class Pattern(BaseModel):
    """What chooses streams."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    stream: str
    """Pattern `station/source/type`, with `*`, `?`, `[abc]` and `[!abc]` in each part."""

    @field_validator("stream")
    @classmethod
    def _is_pattern(cls, text: str) -> str:
        return _pattern(text)

    def fits(self, stream: StreamName) -> bool:
        """Whether the pattern fits the stream's name, part by part and case by case."""
        patterns = self.stream.split("/")
        return all(map(fnmatchcase, (stream.station, stream.source, stream.type), patterns))

    def fits_station(self, station: Station) -> bool:
        """Whether the pattern can fit a stream of the station."""
        return fnmatchcase(station, self.stream.split("/")[0])


class Entry(Pattern):
    """One line of a plan."""

    begin: Annotated[_Begin, Field(alias="from")] = "beginning"
    """From where on: `beginning`, `now`, or a time."""
    now: _Time = None
    """The time that `now` stands for; it is filled in when the plan is set."""
    priority: Annotated[int, BeforeValidator(_priority), Field(ge=0, le=PRIORITY_MAX)] = LANES["points"]
    """Place in the order, 0 first, or the name of a lane."""
    chosen_order: Annotated[Literal["live", "oldest"] | None, Field(alias="order")] = None
    """As the plan says it; `order` is what counts."""
    rate_bps: Annotated[_Rate, Field(alias="rate")] = None
    """Most bits in a second that the streams of this entry take together; None: no limit of their own."""
    where: Annotated[str | None, Field(min_length=1, max_length=WHERE_CHARACTERS_MAX)] = None
    """Condition in SQL that an event must fulfil to be sent."""
    leave_out: Annotated[tuple[str, ...], BeforeValidator(_names), Field(max_length=LEAVE_OUT_MAX)] = ()
    """Fields that are null in what is sent."""
    sends: Annotated[bool, BeforeValidator(truth), Field(alias="send")] = True
    """Whether its streams are sent at all."""

    @field_validator("where")
    @classmethod
    def _is_condition(cls, text: str | None) -> str | None:
        if text is not None:
            parse_condition(text)
        return text

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if self.now is not None and self.begin != "now":
            raise ValueError("now says which time `from: now` stands for; it needs from: now")
        given = self.model_fields_set - {"stream", "sends", "priority"}
        if not self.sends and given:
            raise ValueError("an entry with send: false has a stream and nothing else")
        return self

    @property
    def since(self) -> datetime | None:
        """The time from which on events are sent; None from the beginning.

        Raises:
            PlanError: It is `now`, and the plan was not set yet.
        """
        if self.begin == "now" and self.now is None:
            raise PlanError(f"the entry {self.stream} is from: now, which has a time once the plan is set")
        return self.now if self.begin == "now" else None if self.begin == "beginning" else self.begin

    @property
    def order(self) -> Literal["live", "oldest"]:
        """`live`: what is new goes before what is old; `oldest`: in order of sequence."""
        return self.chosen_order or _order_of(self.priority)

    @property
    def is_derived(self) -> bool:
        """Whether a derived stream is sent in place of the stream itself."""
        return self.sends and (self.where is not None or bool(self.leave_out))

    @property
    def filter_hash(self) -> str:
        """What names the filter in the names of derived streams: 8 hexadecimal digits; the pattern is no part of it."""
        return self.filter_digest.hex()[:HASH_DIGITS]

    @property
    def filter_digest(self) -> bytes:
        """SHA-256 of the filter's canonical form: from, leave_out, where."""
        return _filter_digest(self.where, tuple(sorted(set(self.leave_out))), self.since)


class GiveUp(Pattern):
    """What may go first when the station's disk is full."""

    older_than: Annotated[timedelta, BeforeValidator(duration), PlainSerializer(whole_seconds, return_type=str)] = (
        timedelta(0)
    )
    """Only what happened longer ago."""


class Plan(BaseModel):
    """Which streams a station sends, from when on, in which order and how fast."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    entries: Annotated[tuple[Entry, ...], Field(max_length=ENTRIES_MAX)]
    paused: Annotated[bool, BeforeValidator(truth)] = False
    """Nothing is sent while it is."""
    rate_bps: Annotated[_Rate, Field(alias="rate")] = None
    """Most bits in a second that the station sends; None: no limit."""
    backlog_share: Annotated[float, BeforeValidator(_share), Field(ge=0, le=BACKLOG_SHARE_MAX)] = 0.2
    """Least share of the bytes that backlog gets while live traffic goes on."""
    give_up: Annotated[tuple[GiveUp, ...], Field(max_length=ENTRIES_MAX)] = ()
    """What may go when the disk is full, the first first; empty: nothing may, and recording stops."""

    @field_validator("entries", mode="before")
    @classmethod
    def _is_list(cls, entries: object) -> object:
        if not isinstance(entries, list | tuple):
            raise ValueError("must be a list of entries, each with a stream")
        if not entries:
            raise ValueError("the plan names no stream; add an entry such as {stream: '*/*/situation_detected'}")
        return tuple(entries)

    @field_validator("give_up", mode="before")
    @classmethod
    def _is_list_of_streams(cls, given: object) -> object:
        if not isinstance(given, list | tuple):
            raise ValueError("must be a list of {stream, older_than}, what goes first first")
        return tuple(given)

    @classmethod
    def of(cls, data: object, name: str = "plan") -> Self:
        """The plan that plain data say: `{"entries": [{"stream": ..., "priority": ...}]}`.

        Raises:
            PlanError: They say none.
        """
        return cls._of(data, name, {})

    @classmethod
    def parse(cls, text: str, name: str = "plan") -> Self:
        """The plan that a text says, in TOML where its name ends in `.toml`, else in YAML.

        Args:
            text: The text.
            name: What to call it in messages: its file.

        Raises:
            PlanError: It says none; with the line.
        """
        if len(text) > FILE_BYTES_MAX:
            raise PlanError(f"{name}: a plan has at most {FILE_BYTES_MAX} characters, got {len(text)}")
        data, lines = document(text, name)
        return cls._of(data, name, lines)

    @classmethod
    def load(cls, path: Path) -> Self:
        """The plan in a YAML or TOML file.

        Raises:
            PlanError: The file cannot be read or says no plan.
        """
        try:
            with path.open("rb") as file:
                data = file.read(FILE_BYTES_MAX + 1)
            text = data.decode()
        except OSError as error:
            raise PlanError(f"{path}: cannot be read: {error.strerror}") from error
        except UnicodeDecodeError as error:
            raise PlanError(f"{path}: is not UTF-8: {error.reason} at byte {error.start}") from error
        return cls.parse(text, str(path))

    @classmethod
    def _of(cls, data: object, name: str, lines: Mapping[tuple[Hashable, ...], int]) -> Self:
        if not isinstance(data, dict):
            raise PlanError(f"{name}: a plan is a mapping with entries, got a {type(data).__name__}")
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            raise PlanError(_reason(name, error, lines)) from error

    def entry_for(self, stream: StreamName) -> Entry | None:
        """The entry by which this very stream is sent; None if it stays at the station.

        A stream of which only a filtered one is sent stays; the stream derived from it is sent, as long as
        the filter is the plan's.
        """
        base = base_of(stream)
        entry = self.chosen(stream if base is None else base)
        if entry is None or not entry.sends:
            return None
        is_it = stream == derived_name(base, entry) if base is not None and entry.is_derived else base is None
        return entry if is_it and entry.is_derived == (base is not None) else None

    def chosen(self, stream: StreamName) -> Entry | None:
        """The first entry whose pattern fits the name of a stream that is not derived."""
        return next((entry for entry in self.entries if entry.fits(stream)), None)

    def priority_of(self, stream: StreamName) -> int | None:
        """The stream's priority, 0 first; None if the plan leaves it at the station."""
        entry = self.entry_for(stream)
        return None if entry is None else entry.priority

    def resolved(self, now: datetime, present: "Plan | None" = None) -> "Plan":
        """The plan as it is set at a time: `from: now` has become one.

        An entry that stands in the present plan with the same words keeps the time that it got then, so that
        setting a plan again changes nothing. A plan that does not say whether it is paused stays as it is.

        Raises:
            PlanError: A `from` lies ahead of the station's clock.
        """
        known = {} if present is None else {_unresolved(entry): entry.now for entry in present.entries}
        entries = tuple(_resolved(entry, now, known.get(_unresolved(entry))) for entry in self.entries)
        for number, entry in enumerate(entries):
            if (since := entry.since) is not None and since > now:
                raise PlanError(
                    f"entries[{number}] ({entry.stream}): from {time_text(since)} lies ahead of this station's clock, "
                    f"which says {time_text(now)}. Next: write from: now, or correct the time or the clock"
                )
        kept = {} if present is None or "paused" in self.model_fields_set else {"paused": present.paused}
        return self.model_copy(update={"entries": entries, **kept})

    def said(self) -> dict[str, Any]:
        """The plan as plain data: what differs from the defaults, and of each entry from and priority in any case."""
        data = self.model_dump(mode="json", by_alias=True, exclude_defaults=True, exclude={"entries"})
        return data | {"entries": [_said(entry) for entry in self.entries]}

    def canonical(self) -> str:
        """The plan in its canonical form: what it says as JSON, keys sorted, no spaces."""
        return json.dumps(self.said(), sort_keys=True, separators=(",", ":"), ensure_ascii=False)

    @property
    def plan_hash(self) -> bytes:
        """SHA-256 of the canonical form."""
        return hashlib.sha256(self.canonical().encode()).digest()


def derived_name(base: StreamName, entry: Entry) -> StreamName:
    """The name of the stream that an entry's filter makes of another.

    Raises:
        PlanError: The source's name is too long to bear the hash as well.
    """
    try:
        return StreamName.of(base.station, f"{base.source}~{entry.filter_hash}", base.type)
    except InvalidName as error:
        longest = 64 - 1 - HASH_DIGITS
        raise PlanError(
            f"{base} cannot be filtered: the name of its source has {len(base.source)} characters, a stream derived "
            f"from it leaves room for {longest}. Next: send it whole, or name the source shorter"
        ) from error


def base_of(stream: StreamName) -> StreamName | None:
    """The stream from which a derived one was made; None for any other stream."""
    source, is_derived, _ = stream.source.partition("~")
    return StreamName(stream.station, Source(source), stream.type) if is_derived else None


def _order_of(priority: int) -> Literal["live", "oldest"]:
    """What is told people at once goes before what is old; what rules read goes in order, or it comes late to them."""
    return "live" if priority <= LANES["situations"] else "oldest"


def _unresolved(entry: Entry) -> Entry:
    return entry.model_copy(update={"now": None})


def _resolved(entry: Entry, now: datetime, known: datetime | None) -> Entry:
    if entry.begin != "now" or entry.now is not None:
        return entry
    return entry.model_copy(update={"now": known or now.astimezone(UTC)})


def _said(entry: Entry) -> dict[str, Any]:
    data = entry.model_dump(mode="json", by_alias=True, exclude_defaults=True)
    if data.get("order") == _order_of(entry.priority):
        del data["order"]
    if entry.leave_out:
        data["leave_out"] = sorted(set(entry.leave_out))
    whole = entry.model_dump(mode="json", by_alias=True, include={"begin", "priority"})
    return whole | data if entry.sends else data


@lru_cache(maxsize=4096)
def _filter_digest(where: str | None, leave_out: tuple[str, ...], since: datetime | None) -> bytes:
    data = {"from": "beginning" if since is None else time_text(since), "leave_out": leave_out, "where": where}
    text = json.dumps(data, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
    return hashlib.sha256(text.encode()).digest()


def _reason(name: str, error: ValidationError, lines: Mapping[tuple[Hashable, ...], int]) -> str:
    reasons = []
    for each in error.errors(include_url=False, include_context=False):
        where = tuple(each["loc"])
        known = next((where[:n] for n in range(len(where), -1, -1) if where[:n] in lines), None)
        line = f", line {lines[known]}" if known is not None else ""
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).lstrip(".")
        message = each["msg"].removeprefix("Value error, ")
        if each["type"] == "extra_forbidden":
            message = f"unknown key; known: {', '.join(_known_keys(where))}"
        given = each["input"]
        got = f"; got {no_text(given)}" if isinstance(given, str | int | float | bool) else ""
        reasons.append(f"{name}{line}: {place}: {message}{got}")
    return "\n".join(reasons[:10])


def _known_keys(where: tuple[int | str, ...]) -> list[str]:
    model = Plan if len(where) < 2 else GiveUp if where[0] == "give_up" else Entry
    return [field.alias or name for name, field in model.model_fields.items()]
