"""A rule as its file defines it: pydantic at the border, frozen.

Nothing here understands the SQL; `patterns.language.parser` does. A rule's `hash` names
its meaning: two rules of one hash find the same situations in the same rows.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    InstanceOf,
    PrivateAttr,
    StrictBool,
    StrictInt,
    StrictStr,
    model_validator,
)

from patterns.durations import is_duration, microseconds, parse_duration
from patterns.errors import RuleError
from patterns.language.text import Passage
from patterns.language.tokens import tokenise
from patterns.scene.geometry import Line, Zone
from patterns.scene.quantities import Quantity, is_quantity, parse_quantity

Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9](?:[A-Za-z0-9._-]{0,62}[A-Za-z0-9])?$")]
ColumnName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]{0,62}$")]
Severity = Literal["info", "warning", "alarm"]
ParamScalar = bool | int | float | str | timedelta | Quantity
ParamValue = ParamScalar | tuple[ParamScalar, ...]
CellValue = bool | int | float | str | datetime | timedelta | None


def _as_duration(value: Any) -> Any:
    return parse_duration(value) if isinstance(value, str) else value


def _as_param(value: Any) -> Any:
    """What a parameter's text means: a duration, a speed or length, or itself."""
    if isinstance(value, str) and is_duration(value):
        return parse_duration(value)
    return parse_quantity(value) if isinstance(value, str) and is_quantity(value) else value


def _as_list(value: Any) -> Any:
    if isinstance(value, list | tuple):
        if not value:
            raise ValueError("a list has one value or more")
        return tuple(map(_as_param, value))
    return _as_param(value)


Duration = Annotated[timedelta, BeforeValidator(_as_duration), Field(ge=timedelta(0), strict=True)]
VERSION_MOST = 2**31 - 1
_FiniteFloat = Annotated[float, Field(strict=True, allow_inf_nan=False)]
_StrictDuration = Annotated[timedelta, Field(strict=True)]
_Scalar = StrictBool | StrictInt | _FiniteFloat | StrictStr | _StrictDuration | InstanceOf[Quantity]
Param = Annotated[_Scalar | tuple[_Scalar, ...], BeforeValidator(_as_list)]
Homography = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class TimeSettings(_Frozen):
    """How the rule deals with rows that come late and sources that fall silent.

    Attributes:
        lateness: How much older than its source's newest row a row may be, and still be in time.
        idle: After how long without a row a source stops holding the watermark; None: never.
    """

    lateness: Duration = timedelta(0)
    idle: Duration | None = None


class EmitSettings(_Frozen):
    """Which of the matches become situations.

    Attributes:
        once_per: Partition columns or measures; a key's further matches are held back.
            None: the partition columns, if there is a cooldown, else nothing is held back.
        cooldown: For how long in event time; None with `once_per`: for good.
    """

    once_per: tuple[ColumnName, ...] | None = None
    cooldown: Duration | None = None


class Case(_Frozen):
    """One test in the rule's own file.

    Attributes:
        name: What it shows; the file's name or the test's number when not given.
        given: A CSV file beside the rule, or the rows themselves.
        expect: For each situation wanted, in order, the measures, partition columns or
            `title` to compare; what is not named is not compared.
        frames: Frame size (width, height) in pixels for each source, for normalised zones and lines.
        zones: For shared zones that the rule names, what they are in this test.
        lines: For shared lines that the rule names, what they are in this test.
        calibrations: For each source its homography, px to m on the ground, row by row, for frames of `frames`.
    """

    name: str | None = None
    given: str | tuple[Mapping[str, CellValue], ...]
    expect: tuple[Mapping[str, CellValue], ...]
    frames: Mapping[str, tuple[int, int]] = Field(default_factory=dict)
    zones: Mapping[Name, Zone] = Field(default_factory=dict)
    lines: Mapping[Name, Line] = Field(default_factory=dict)
    calibrations: Mapping[str, Homography] = Field(default_factory=dict)


class Rule(_Frozen):
    """One rule: a SQL:2016 row pattern and what surrounds it."""

    rule: Name
    version: int = Field(ge=1, le=VERSION_MOST, strict=True)
    title: str = Field(min_length=1)
    severity: Severity
    zones: Mapping[Name, Zone] = Field(default_factory=dict)
    lines: Mapping[Name, Line] = Field(default_factory=dict)
    shared: tuple[Name, ...] = ()
    params: Mapping[ColumnName, Param] = Field(default_factory=dict)
    time: TimeSettings = TimeSettings()
    emit: EmitSettings = EmitSettings()
    profile: Literal["full", "portable"] = "full"
    template: Name | None = None
    given: Mapping[str, Any] = Field(default_factory=dict, alias="with")
    shadow: bool = Field(default=False, strict=True)
    match: str = Field(min_length=1)
    tests: tuple[Case, ...] = ()

    _path: Path | None = PrivateAttr(default=None)
    _folder: Path = PrivateAttr(default=Path())
    _passages: Mapping[tuple[str, ...], Passage] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _names_are_distinct(self) -> Self:
        both = sorted(set(self.zones) & set(self.lines))
        if both:
            raise ValueError(f"{both[0]!r} names both a zone and a line")
        own = sorted((set(self.zones) | set(self.lines)) & set(self.shared))
        if own:
            raise ValueError(f"{own[0]!r} is shared, and also drawn in the rule itself; keep one of them")
        return self

    @property
    def path(self) -> Path | None:
        """The file that says this rule; None if it was made in a program, or changed since it was loaded."""
        return self._path

    @property
    def is_whole(self) -> bool:
        """Whether the rule's own file says all of it, without a template or lists in other files."""
        lists = (path for path in self._passages if len(path) == 3 and path[0] == "params" and path[2] == "file")
        return self._path is not None and self.template is None and not any(lists)

    @property
    def folder(self) -> Path:
        """Where the files that the rule's tests name lie."""
        return self._folder

    @property
    def hash(self) -> str:
        """SHA-256, in hex, of everything that changes which situations the rule finds or what they say.

        Layout: UTF-8 JSON with sorted keys and no spaces, of the fields `rule`, `version`,
        `title`, `severity`, `zones`, `lines`, `params`, `time`, `emit` and `match`, and of `shared` if
        it has any; durations in microseconds as `{"us": n}`, speeds and lengths in their base unit as
        `{"m/s": n}`, and `match` without comments and with single spaces.
        """
        return hashlib.sha256(self._canonical().encode()).hexdigest()

    def passage(self, *path: str | int) -> Passage:
        """Where the value under these keys stands in the file, for errors that point at it."""
        for length in range(len(path), -1, -1):
            found = self._passages.get(tuple(str(key) for key in path[:length]))
            if found is not None:
                return found
        value: Any = self.model_dump(mode="python")
        for key in path:
            value = value[key]
        return Passage.alone(value if isinstance(value, str) else json.dumps(value, default=str), f"<{self.rule}>")

    def error(self, message: str, *path: str | int) -> RuleError:
        """The error that points at the value under these keys in the rule's file."""
        return self.passage(*path).error(message, 0)

    def with_zones(self, zones: Mapping[str, Zone]) -> Self:
        """The rule with these zones in place of its own of the same names; others stay.

        Raises:
            ValueError: The rule has no zone of one of the names.
        """
        return self._with("zones", self.zones, zones)

    def with_lines(self, lines: Mapping[str, Line]) -> Self:
        """The rule with these lines in place of its own of the same names; others stay.

        Raises:
            ValueError: The rule has no line of one of the names.
        """
        return self._with("lines", self.lines, lines)

    def with_params(self, params: Mapping[str, ParamValue]) -> Self:
        """The rule with these parameters in place of its own of the same names; others stay.

        Raises:
            ValueError: The rule has no parameter of one of the names.
        """
        return self._with("params", self.params, {name: _as_list(value) for name, value in params.items()})

    def loaded_from(self, path: Path | None, passages: Mapping[tuple[str, ...], Passage]) -> Self:
        """The rule, knowing where in which file each of its values stands."""
        copy = self.model_copy()
        copy._path = path
        copy._folder = path.parent if path is not None else Path()
        copy._passages = passages
        return copy

    def _with(self, field: str, old: Mapping[str, Any], new: Mapping[str, Any]) -> Self:
        unknown = sorted(set(new) - set(old))
        if unknown:
            have = ", ".join(sorted(old)) or "none"
            raise ValueError(f"rule {self.rule} has no {field[:-1]} {unknown[0]!r}; it has: {have}")
        changed = self.model_copy(update={field: {**old, **new}})
        if new:
            changed._path = None
        return changed

    def _canonical(self) -> str:
        fields = self.model_dump(include=_MEANING | ({"shared"} if self.shared else set()))
        fields["match"] = _single_spaced(self.passage("match"))
        return json.dumps(fields, sort_keys=True, separators=(",", ":"), default=_json_value)


@lru_cache(maxsize=1_000)
def _single_spaced(passage: Passage) -> str:
    """The SQL without comments and with single spaces: milliseconds of work, asked for again and again."""
    return " ".join(token.text for token in tokenise(passage))


_MEANING = {
    "rule", "version", "title", "severity", "zones", "lines", "params", "time", "emit", "match",
}  # fmt: skip


def _json_value(value: Any) -> Any:
    if isinstance(value, timedelta):
        return {"us": microseconds(value)}
    if isinstance(value, Quantity):
        return {value.base_unit: value.value}
    raise TypeError(f"no canonical form for {type(value).__name__}")
