"""The entries of a plan: patterns over streams, and what becomes of those that they fit.

Contract: frozen data. An entry with a row filter or with fields to leave out does not send the stream itself: a stream
derived from it is sent instead (`sync.plans.deriving`). The name of a derived stream says by which filter it was made.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PlainSerializer, field_validator, model_validator

from events import InvalidName, Source, Station, StreamName
from sync.errors import PlanError
from sync.plans.plan_values import duration, rate, time_text, truth, whole_seconds
from sync.plans.where import parse as parse_condition

LANES: Mapping[str, int] = {"alerts": 0, "situations": 10, "tracks": 20, "points": 30, "media": 40}
"""Names of priorities; a smaller number goes first, and there is room between them."""
PRIORITY_MAX = 99
LEAVE_OUT_MAX = 100
WHERE_CHARACTERS_MAX = 4000
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


def _names(value: object) -> object:
    if not isinstance(value, list | tuple):
        raise ValueError("must be a list of fields, such as [vx, vy]")
    return tuple(value)


Rate = Annotated[
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
    rate_bps: Annotated[Rate, Field(alias="rate")] = None
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


def words_of(entry: Entry) -> str:
    """What the entry says, however it is spelled, as it was before it was set."""
    return json.dumps(said_by(entry.model_copy(update={"now": None})), sort_keys=True)


def resolved(entry: Entry, now: datetime, known: datetime | None) -> Entry:
    """The entry as it is set: `now` has become the time that is known of it, or this one."""
    if entry.begin != "now" or entry.now is not None:
        return entry
    return entry.model_copy(update={"now": known or now.astimezone(UTC)})


def said_by(entry: Entry) -> dict[str, Any]:
    """The entry as plain data: what differs from the defaults, and from and priority in any case."""
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
