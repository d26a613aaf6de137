"""The plan: which streams a station sends to central, from when on, in which order and how fast.

Contract: a plan is an ordered list of entries; the first entry whose pattern fits a stream decides
what becomes of it, a stream that fits none stays at the station. Its hash is that of its canonical
form, so two files that say the same are the same plan, in YAML or in TOML. A plan of the first version
(stream, from, priority) reads, and has the hash that it always had.

It reads no log and sends nothing.
"""

import hashlib
import json
from collections.abc import Hashable, Mapping
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from events import StreamName
from sync.errors import PlanError
from sync.plans.entries import LANES, Entry, GiveUp, Rate, base_of, derived_name, resolved, said_by, words_of
from sync.plans.plan_files import FILE_BYTES_MAX, document
from sync.plans.plan_values import no_text, time_text, truth

__all__ = ["LANES", "Entry", "GiveUp", "Plan", "base_of", "derived_name"]

ENTRIES_MAX = 1000
_MISSING: Mapping[tuple[int | str, ...], str] = {
    ("entries",): "must be there: a list of entries, such as {stream: '*/*/situation_detected'}",
    ("stream",): "must be there: station/source/type, such as '*/gate/plate_read'",
    ("older_than",): "must be there: a duration, such as 7 d",
}
"""What is said of a key that must be there and is not."""
BACKLOG_SHARE_MAX = 0.9


def _share(value: object) -> object:
    try:
        return float(value) if isinstance(value, str | int) and not isinstance(value, bool) else value
    except ValueError as error:
        raise ValueError(f"must be a number from 0 to {BACKLOG_SHARE_MAX}, such as 0.2") from error


class Plan(BaseModel):
    """Which streams a station sends, from when on, in which order and how fast."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    entries: Annotated[tuple[Entry, ...], Field(max_length=ENTRIES_MAX)]
    paused: Annotated[bool, BeforeValidator(truth)] = False
    """Nothing is sent while it is."""
    rate_bps: Annotated[Rate, Field(alias="rate")] = None
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

    def resolved(self, now: datetime, present: "Plan | None" = None) -> "Plan":
        """The plan as it is set at a time: `from: now` has become one.

        An entry that stands in the present plan with the same words keeps the time that it got then, so that
        setting a plan again changes nothing. A plan that does not say whether it is paused stays as it is.

        Raises:
            PlanError: A `from` lies ahead of the station's clock, and the present plan does not have that entry.
        """
        known = {} if present is None else {words_of(entry): entry.now for entry in present.entries}
        entries = tuple(resolved(entry, now, known.get(words_of(entry))) for entry in self.entries)
        # What the log has already was set by a clock that may have stood later, or stands wrong now.
        known_entries = () if present is None else present.entries
        for number, entry in enumerate(entries):
            if (since := entry.since) is not None and since > now and entry not in known_entries:
                raise PlanError(
                    f"entries[{number}] ({entry.stream}): from {time_text(since)} lies ahead of this station's clock, "
                    f"which says {time_text(now)}. Next: write from: now, or correct the time or the clock"
                )
        kept = {} if present is None or "paused" in self.model_fields_set else {"paused": present.paused}
        return self.model_copy(update={"entries": entries, **kept})

    def said(self) -> dict[str, Any]:
        """The plan as plain data: what differs from the defaults, and of each entry from and priority in any case."""
        data = self.model_dump(mode="json", by_alias=True, exclude_defaults=True, exclude={"entries"})
        return data | {"entries": [said_by(entry) for entry in self.entries]}

    def canonical(self) -> str:
        """The plan in its canonical form: what it says as JSON, keys sorted, no spaces."""
        return json.dumps(self.said(), sort_keys=True, separators=(",", ":"), ensure_ascii=False)

    @property
    def plan_hash(self) -> bytes:
        """SHA-256 of the canonical form."""
        return hashlib.sha256(self.canonical().encode()).digest()


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
        if each["type"] == "missing":
            message = _MISSING.get(where[-1:], "must be there")
        given = each["input"]
        has_shown_it = "\n" in message
        got = f"; got {no_text(given)}" if isinstance(given, str | int | float | bool) and not has_shown_it else ""
        reasons.append(f"{name}{line}: {place}: {message}{got}")
    return "\n".join(reasons[:10])


def _known_keys(where: tuple[int | str, ...]) -> list[str]:
    model = Plan if len(where) < 2 else GiveUp if where[0] == "give_up" else Entry
    return [field.alias or name for name, field in model.model_fields.items()]
