"""The catalogue: every event type that this program knows, by name and version.

Contract: immutable once built. `SHIPPED` holds ViAn's own types; `load_catalogue` adds those that
installed distributions offer through the entry-point group `vian.events` (each entry point is a
subclass of `EventType`). A type is given in its newest version, and brings the older ones with it: what
was ever stored is read in the newest form, one version step after the other.
"""

from collections.abc import Iterable, Iterator
from importlib.metadata import entry_points
from typing import Self

import pyarrow as pa

from events.camera import CameraCalibrated, HorizonEstimate, HorizonVote, SceneChanged, ZoneDefined, ZoneRemoved
from events.columns import EventBatch, schema_of
from events.errors import EventError, UnknownType, UpcastFailed
from events.media import StreamInterrupted, StreamResumed, VideoAdded
from events.model import EventType
from events.motion import ActivityInterval, Appearance, TrackEnded, TrackPoint
from events.plates import PlateRead
from events.proof import CheckpointSigned, LossRecorded
from events.relations import GroupSeen, Occupancy, PairDistance, StageDeployed, Tally
from events.situations import RuleDeployed, RuleMissed, RuleRetired, SituationDetected, SituationShadowed
from events.stations import (
    CheckpointCountersigned,
    QueryAnswered,
    RequestRefused,
    SegmentsPruned,
    SegmentsRepaired,
    StationEnrolled,
    StationRevoked,
    SyncPlanned,
)
from events.work import ProcessFailed, ProcessFinished, ProcessProgressed, ProcessStarted

SHIPPED: tuple[type[EventType], ...] = (
    VideoAdded,
    StreamInterrupted,
    StreamResumed,
    ProcessStarted,
    ProcessProgressed,
    ProcessFinished,
    ProcessFailed,
    TrackPoint,
    TrackEnded,
    ActivityInterval,
    SituationDetected,
    RuleDeployed,
    SyncPlanned,
    CheckpointSigned,
    LossRecorded,
    PlateRead,
    PairDistance,
    Occupancy,
    GroupSeen,
    Tally,
    StageDeployed,
    ZoneDefined,
    ZoneRemoved,
    CameraCalibrated,
    SceneChanged,
    Appearance,
    SituationShadowed,
    RuleRetired,
    RuleMissed,
    CheckpointCountersigned,
    QueryAnswered,
    RequestRefused,
    SegmentsPruned,
    SegmentsRepaired,
    StationEnrolled,
    StationRevoked,
    HorizonVote,
    HorizonEstimate,
)
ENTRY_POINT_GROUP = "vian.events"


class Catalogue:
    """Event types by name and version.

    Raises:
        UnknownType: Two different types bear one name and version, or a version does not say how events of
            the one before become its own.
        InvalidEvent: A type has a field for which there is no column.
    """

    def __init__(self, types: Iterable[type[EventType]]) -> None:
        self._versions: dict[str, dict[int, type[EventType]]] = {}
        for event_type in _with_older(types):
            schema_of(event_type)
            versions = self._versions.setdefault(event_type.type_name, {})
            if versions.setdefault(event_type.version, event_type) is not event_type:
                raise UnknownType(
                    f"{event_type.type_name} version {event_type.version} is defined twice: "
                    f"{versions[event_type.version].__module__} and {event_type.__module__}"
                )

    def __iter__(self) -> Iterator[type[EventType]]:
        """The newest version of each type, in the order of registration."""
        return (versions[max(versions)] for versions in self._versions.values())

    def __contains__(self, name: str) -> bool:
        return name in self._versions

    def newest(self, name: str) -> type[EventType]:
        """The newest version of the type of this name.

        Raises:
            UnknownType: There is no type of this name.
        """
        versions = self._of(name)
        return versions[max(versions)]

    def find(self, name: str, version: int) -> type[EventType]:
        """The type of this name and version.

        Raises:
            UnknownType: There is no type of this name, or not in this version.
        """
        versions = self._of(name)
        if version not in versions:
            raise UnknownType(
                f"{name} version {version} is not known here, only {', '.join(map(str, sorted(versions)))}. "
                "Next: upgrade ViAn to read it (it stays stored and verified as it is)"
            )
        return versions[version]

    def check_registered(self, event_type: type[EventType]) -> None:
        """Nothing, if events of this type and version may be appended.

        Raises:
            UnknownType: The catalogue does not hold this very type.
        """
        if self._versions.get(event_type.type_name, {}).get(event_type.version) is not event_type:
            raise UnknownType(
                f"event type {event_type.type_name!r} version {event_type.version} of {event_type.__module__} is not "
                f"registered here. Next: offer it as an entry point of {ENTRY_POINT_GROUP!r} in its distribution"
            )

    def versions(self, name: str) -> tuple[type[EventType], ...]:
        """All versions of the type of this name, oldest first.

        Raises:
            UnknownType: There is no type of this name.
        """
        return tuple(event_type for _, event_type in sorted(self._of(name).items()))

    def upcast(self, batch: EventBatch) -> EventBatch:
        """The batch in the newest version of its type.

        Raises:
            UpcastFailed: A version does not say of it what its contract asks.
        """
        versions = self._of(batch.type.type_name)
        for version in range(batch.type.version + 1, max(versions) + 1):
            batch = _one_step(batch, versions[version])
        return batch

    def _of(self, name: str) -> dict[int, type[EventType]]:
        if name not in self._versions:
            raise UnknownType(f"no event type {name[:100]!r}; known: {', '.join(sorted(self._versions))}")
        return self._versions[name]

    @classmethod
    def shipped(cls) -> Self:
        """ViAn's own types."""
        return cls(SHIPPED)


def _with_older(types: Iterable[type[EventType]]) -> Iterator[type[EventType]]:
    """The types, and behind each the older versions that it brings."""
    for newest in types:
        event_type = newest
        yield event_type
        while event_type.version > 1:
            event_type = _older(event_type)
            yield event_type


def _older(event_type: type[EventType]) -> type[EventType]:
    """The version before, which must be there and lead to this one: every stored version must be readable."""
    older, place = event_type.older, f"{event_type.type_name} version {event_type.version} ({event_type.__module__})"
    wanted = (event_type.type_name, event_type.version - 1)
    if older is None or (older.type_name, older.version) != wanted:
        got = "none" if older is None else f"{older.type_name} version {older.version}"
        raise UnknownType(f"{place} must name version {wanted[1]} of its type as `older`, got {got}")
    if not event_type.has_upcast():
        raise UnknownType(
            f"{place} must define `upcast`, which makes events of version {wanted[1]} its own; it has none"
        )
    return older


def _one_step(batch: EventBatch, newer: type[EventType]) -> EventBatch:
    """The batch in the next version.

    An upcaster may be a plug-in's, so what it does and raises can be anything.
    """
    place = f"{newer.type_name}: the upcast from version {batch.type.version} to {newer.version} of {newer.__module__}"
    try:
        data = newer.upcast(batch.data)
        upcast = EventBatch(newer, data)
        data.validate(full=True)
    except (
        EventError,
        pa.ArrowException,
        ArithmeticError,
        LookupError,
        TypeError,
        ValueError,
        AttributeError,
    ) as error:
        raise UpcastFailed(f"{place} fails: {error}. Next: upgrade or uninstall what brings this type") from error
    if len(upcast) != len(batch) or not data.column(0).equals(batch.data.column(0)):
        raise UpcastFailed(
            f"{place} must keep every event with its time. Next: upgrade or uninstall what brings this type"
        )
    return upcast


def load_catalogue() -> Catalogue:
    """ViAn's own types and those of installed plug-ins.

    Raises:
        UnknownType: A plug-in's entry point does not load, is not an event type, defines one that
            exists, or leaves an older version out.
        InvalidEvent: A plug-in's type has a field for which there is no column.
    """
    plugged: list[type[EventType]] = []
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        try:
            loaded = entry.load()
        except Exception as error:
            raise UnknownType(
                f"entry point {entry.name} of {ENTRY_POINT_GROUP} ({entry.value}) does not load: {error}. "
                "Next: repair or uninstall the distribution that brings it"
            ) from error
        if not (isinstance(loaded, type) and issubclass(loaded, EventType) and loaded is not EventType):
            raise UnknownType(f"entry point {entry.name} of {ENTRY_POINT_GROUP} must be an EventType, got {loaded!r}")
        plugged.append(loaded)
    return Catalogue([*SHIPPED, *plugged])
