"""A stage as its file defines it: pydantic at the border, frozen.

Its `hash` names its meaning: two stages of one hash derive the same events from the same rows.
"""

import hashlib
import json
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from patterns.durations import microseconds
from patterns.errors import RuleError
from patterns.files.rule import CellValue, ColumnName, Duration, Name, TimeSettings
from patterns.language.text import Passage
from patterns.scene.geometry import Zone

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Period = Annotated[Duration, Field(gt=timedelta(0))]


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Pairs(_Frozen):
    """`pair_distance`: two tracks nearer than a radius.

    Attributes:
        radius_px: How near two tracks are to be told of, px, inclusive.
        every: After how long the same pair is told of again; zero: in every frame.
        pairs_most: Of one frame at most so many pairs, the nearest, are told of.
        tracks_most: Of one frame at most so many tracks, those of the lowest numbers, are looked at.
    """

    radius_px: Positive
    every: Duration = timedelta(0)
    pairs_most: int = Field(default=1_000, ge=1)
    tracks_most: int = Field(default=1_000, ge=2)


class Zones(_Frozen):
    """`occupancy`: how many tracks are in a zone, whenever that changes.

    Attributes:
        zones: By name.
        gone_after: A track of which no point has come for so long is no longer there.
    """

    zones: Mapping[Name, Zone] = Field(min_length=1)
    gone_after: Period = timedelta(seconds=2)


class Groups(_Frozen):
    """`group_seen`: tracks that are near each other, directly or through others, and stay so.

    Attributes:
        radius_px: How near two tracks are neighbours, px, inclusive.
        members_least: How many tracks make a group.
        persists: How long they must have been together before they are told of.
        every: After how long an unchanged group is told of again.
        gone_after: A group that has not been seen for so long has dissolved.
        tracks_most: Of one frame at most so many tracks, those of the lowest numbers, are looked at.
    """

    radius_px: Positive
    members_least: int = Field(default=2, ge=2)
    persists: Duration = timedelta(seconds=1)
    every: Period = timedelta(seconds=1)
    gone_after: Period = timedelta(seconds=2)
    tracks_most: int = Field(default=1_000, ge=2)


class Windows(_Frozen):
    """`tally`: how many events of a type there were in each window of time.

    Windows follow each other from 1970-01-01T00:00:00Z on. Empty windows are told of too, of a source from
    its first event on, of a key likewise.

    Attributes:
        of: The event type.
        window: Length of a window.
        by: A column by whose values events are counted apart; None: all of a source together.
        keys_most: At most so many values of a source are counted apart; further ones are not counted.
        empty_most: After so many empty windows in a row a key is forgotten until its next event.
    """

    of: str = Field(min_length=1)
    window: Period
    by: ColumnName | None = None
    keys_most: int = Field(default=10_000, ge=1)
    empty_most: int = Field(default=1_000, ge=0)


KINDS = {"pair_distance": Pairs, "occupancy": Zones, "group_seen": Groups, "tally": Windows}


class StageCase(_Frozen):
    """One test in the stage's own file: rows in, derived events out, in order; only what is named is compared."""

    name: str | None = None
    given: str | tuple[Mapping[str, CellValue], ...]
    expect: tuple[Mapping[str, CellValue], ...]
    frames: Mapping[str, tuple[int, int]] = Field(default_factory=dict)


class Stage(_Frozen):
    """One stage.

    Attributes:
        stage: Its name, unique among stages.
        version: A deployed version never changes its meaning, the next one does.
        derives: The event type that it derives; its own settings stand under the key of that name.
        sources: The sources whose rows it takes; None: all.
        time: How late a row may be, and when a silent source stops holding the others.
    """

    stage: Name
    version: int = Field(ge=1, strict=True)
    sources: tuple[str, ...] | None = None
    time: TimeSettings = TimeSettings()
    pair_distance: Pairs | None = None
    occupancy: Zones | None = None
    group_seen: Groups | None = None
    tally: Windows | None = None
    tests: tuple[StageCase, ...] = ()

    _path: Path | None = PrivateAttr(default=None)
    _passages: Mapping[tuple[str, ...], Passage] = PrivateAttr(default_factory=dict)

    @model_validator(mode="after")
    def _derives_one_type(self) -> Self:
        given = [name for name in KINDS if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a stage has one of the keys {', '.join(KINDS)}; got {', '.join(given) or 'none'}")
        return self

    @property
    def derives(self) -> Literal["pair_distance", "occupancy", "group_seen", "tally"]:
        """The event type that it derives."""
        (name,) = (name for name in KINDS if getattr(self, name) is not None)
        return name  # type: ignore[return-value]  # KINDS has these names and no others

    @property
    def settings(self) -> Pairs | Zones | Groups | Windows:
        """What stands under the key of that name."""
        settings: Pairs | Zones | Groups | Windows = getattr(self, self.derives)
        return settings

    @property
    def reads(self) -> str:
        """The event type that it takes."""
        return self.tally.of if self.tally is not None else "track_point"

    @property
    def hash(self) -> str:
        """SHA-256, in hex, of everything that changes what it derives: all keys but `tests`, as JSON."""
        fields = self.model_dump(exclude={"tests"})
        text = json.dumps(fields, sort_keys=True, separators=(",", ":"), default=_json_value)
        return hashlib.sha256(text.encode()).hexdigest()

    @property
    def path(self) -> Path | None:
        """The file that says this stage; None if it was made in a program."""
        return self._path

    def passage(self, *path: str | int) -> Passage:
        """Where the value under these keys stands in the file, for errors that point at it."""
        for length in range(len(path), -1, -1):
            found = self._passages.get(tuple(str(key) for key in path[:length]))
            if found is not None:
                return found
        return Passage.alone("", f"<{self.stage}>")

    def error(self, message: str, *path: str | int) -> RuleError:
        """The error that points at the value under these keys in the stage's file."""
        return self.passage(*path).error(message, 0)

    def loaded_from(self, path: Path | None, passages: Mapping[tuple[str, ...], Passage]) -> Self:
        """The stage, knowing where in which file each of its values stands."""
        copy = self.model_copy()
        copy._path = path
        copy._passages = passages
        return copy


def _json_value(value: Any) -> Any:
    if isinstance(value, timedelta):
        return {"us": microseconds(value)}
    raise TypeError(f"no canonical form for {type(value).__name__}")
