"""The plan: which streams a station sends to central, and in which order.

Contract: a plan is an ordered list of entries; the first entry whose pattern fits a stream decides
its priority, a stream that fits none stays at the station. Its hash is that of its canonical form,
so two files that say the same are the same plan. `from` is `beginning`: all that a stream holds.

It reads no log and sends nothing: the daemon does.
"""

import hashlib
import json
import re
from collections.abc import Hashable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Self

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, field_validator

from events import Station, StreamName
from sync.errors import PlanError

LANES: Mapping[str, int] = {"alerts": 0, "situations": 10, "tracks": 20, "points": 30, "media": 40}
"""Names of priorities; a smaller number goes first, and there is room between them."""
PRIORITY_MAX = 99
ENTRIES_MAX = 1000
FILE_BYTES_MAX = 256 * 1024
_DEPTH_MAX = 4

_PART = re.compile(r"(?:[A-Za-z0-9._*?-]|\[!?[A-Za-z0-9._-]+\]){1,64}")


def _priority(value: object) -> object:
    if not isinstance(value, str):
        return value
    if value.isdecimal() and len(value) <= 3:
        return int(value)
    if value not in LANES:
        raise ValueError(f"must be one of {', '.join(LANES)}, or a number from 0 (first) to {PRIORITY_MAX}")
    return LANES[value]


class Entry(BaseModel):
    """One line of a plan."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, populate_by_name=True)

    stream: str
    """Pattern `station/source/type`, with `*`, `?`, `[abc]` and `[!abc]` in each part."""
    since: Annotated[str, Field(alias="from")] = "beginning"
    """From where on; only `beginning` yet."""
    priority: Annotated[int, BeforeValidator(_priority), Field(ge=0, le=PRIORITY_MAX)] = LANES["points"]
    """Place in the order, 0 first, or the name of a lane."""

    @field_validator("stream")
    @classmethod
    def _is_pattern(cls, text: str) -> str:
        parts = text.split("/")
        if len(parts) != 3:
            raise ValueError("must be a pattern station/source/type, such as */*/situation_detected")
        for part in parts:
            if not _PART.fullmatch(part):
                raise ValueError(
                    f"the part {part[:64]!r} must be 1 to 64 of A-Z a-z 0-9 . _ - * ? or a set such as [abc] or [!abc]"
                )
        return text

    @field_validator("since")
    @classmethod
    def _is_beginning(cls, text: str) -> str:
        if text != "beginning":
            raise ValueError(f"{text[:40]!r} is not supported yet; wanted: beginning")
        return text

    def fits(self, stream: StreamName) -> bool:
        """Whether the pattern fits the stream's name, part by part and case by case."""
        patterns = self.stream.split("/")
        return all(map(fnmatchcase, (stream.station, stream.source, stream.type), patterns))

    def fits_station(self, station: Station) -> bool:
        """Whether the pattern can fit a stream of the station."""
        return fnmatchcase(station, self.stream.split("/")[0])


class Plan(BaseModel):
    """Which streams a station sends, and in which order."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    entries: Annotated[tuple[Entry, ...], Field(max_length=ENTRIES_MAX)]

    @field_validator("entries", mode="before")
    @classmethod
    def _is_list(cls, entries: object) -> object:
        if not isinstance(entries, list | tuple):
            raise ValueError("must be a list of entries, each with a stream")
        if not entries:
            raise ValueError("the plan names no stream; add an entry such as {stream: '*/*/situation_detected'}")
        return tuple(entries)

    @classmethod
    def of(cls, data: object, name: str = "plan") -> Self:
        """The plan that plain data say: `{"entries": [{"stream": ..., "priority": ...}]}`.

        Raises:
            PlanError: They say none.
        """
        return cls._of(data, name, {})

    @classmethod
    def parse(cls, text: str, name: str = "plan") -> Self:
        """The plan that a YAML text says.

        Args:
            text: The text.
            name: What to call it in messages: its file.

        Raises:
            PlanError: It says none; with the line.
        """
        if len(text) > FILE_BYTES_MAX:
            raise PlanError(f"{name}: a plan has at most {FILE_BYTES_MAX} characters, got {len(text)}")
        data, lines = _document(text, name)
        return cls._of(data, name, lines)

    @classmethod
    def load(cls, path: Path) -> Self:
        """The plan in a YAML file.

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

    def priority_of(self, stream: StreamName) -> int | None:
        """The stream's priority, 0 first; None if the plan leaves it at the station."""
        return next((entry.priority for entry in self.entries if entry.fits(stream)), None)

    def canonical(self) -> str:
        """The plan in its canonical form: JSON, keys sorted, each entry whole."""
        data = self.model_dump(mode="json", by_alias=True, exclude_none=True)
        return json.dumps(data, sort_keys=True, separators=(",", ":"))

    @property
    def plan_hash(self) -> bytes:
        """SHA-256 of the canonical form."""
        return hashlib.sha256(self.canonical().encode()).digest()


def _document(text: str, name: str) -> tuple[object, dict[tuple[Hashable, ...], int]]:
    """What a YAML text says, in texts, lists and mappings, and the line of each place in it."""
    loader = None
    try:
        loader = yaml.BaseLoader(text)  # scalars stay text: the plan's own types decide
        node = loader.get_single_node()
        if node is None:
            raise PlanError(f"{name}: the file is empty; wanted: entries, a list of {{stream, from, priority}}")
        lines = dict(_lines(node, (), name, set()))
        return loader.construct_document(node), lines
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise PlanError(f"{name}{line}: not YAML: {error.problem}") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise PlanError(f"{name}: not YAML: {' '.join(str(error).split())[:200]}") from error
    finally:
        if loader is not None:
            loader.dispose()


def _lines(
    node: yaml.Node, path: tuple[Hashable, ...], name: str, seen: set[int]
) -> Iterator[tuple[tuple[Hashable, ...], int]]:
    """The line of each place, from 1; aliases, deep nesting and doubled keys are refused."""
    line = node.start_mark.line + 1
    yield path, line
    if len(path) > _DEPTH_MAX:
        raise PlanError(f"{name}, line {line}: nested too deep for a plan")
    if id(node) in seen:
        raise PlanError(f"{name}, line {line}: an alias repeats this; write it out, a plan has no aliases")
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for index, child in enumerate(node.value):
            yield from _lines(child, (*path, index), name, seen)
    elif isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key, child in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise PlanError(f"{name}, line {key.start_mark.line + 1}: a key must be a text")
            if key.value in keys:
                raise PlanError(f"{name}, line {key.start_mark.line + 1}: {key.value[:60]!r} is given twice")
            keys.add(key.value)
            yield from _lines(child, (*path, key.value), name, seen)


def _reason(name: str, error: ValidationError, lines: Mapping[tuple[Hashable, ...], int]) -> str:
    reasons = []
    for each in error.errors(include_url=False, include_context=False):
        where = tuple(each["loc"])
        known = next((where[:n] for n in range(len(where), -1, -1) if where[:n] in lines), None)
        line = f", line {lines[known]}" if known is not None else ""
        place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in where).lstrip(".")
        message = each["msg"].removeprefix("Value error, ")
        if each["type"] == "extra_forbidden":
            message = "unknown key; known: " + ("stream, from, priority" if len(where) > 1 else "entries")
        given = each["input"]
        got = f"; got {str(given)[:60]!r}" if isinstance(given, str | int | float | bool) else ""
        reasons.append(f"{name}{line}: {place}: {message}{got}")
    return "\n".join(reasons[:10])
