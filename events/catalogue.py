"""The catalogue: every event type that this program knows, by name and version.

Contract: immutable once built. `SHIPPED` holds ViAn's own types; `load_catalogue` adds those that
installed distributions offer through the entry-point group `vian.events` (each entry point is a
subclass of `EventType`).
"""

from collections.abc import Iterable, Iterator
from importlib.metadata import entry_points
from typing import Self

from events.columns import schema_of
from events.errors import UnknownType
from events.media import VideoAdded
from events.model import EventType
from events.motion import ActivityInterval, TrackEnded, TrackPoint
from events.plates import PlateRead
from events.proof import CheckpointSigned, LossRecorded
from events.situations import RuleDeployed, SituationDetected
from events.stations import SyncPlanned
from events.work import ProcessFailed, ProcessFinished, ProcessProgressed, ProcessStarted

SHIPPED: tuple[type[EventType], ...] = (
    VideoAdded,
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
)
ENTRY_POINT_GROUP = "vian.events"


class Catalogue:
    """Event types by name and version.

    Raises:
        UnknownType: Two different types bear one name and version.
        InvalidEvent: A type has a field for which there is no column.
    """

    def __init__(self, types: Iterable[type[EventType]]) -> None:
        self._versions: dict[str, dict[int, type[EventType]]] = {}
        for event_type in types:
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

    def _of(self, name: str) -> dict[int, type[EventType]]:
        if name not in self._versions:
            raise UnknownType(f"no event type {name[:100]!r}; known: {', '.join(sorted(self._versions))}")
        return self._versions[name]

    @classmethod
    def shipped(cls) -> Self:
        """ViAn's own types."""
        return cls(SHIPPED)


def load_catalogue() -> Catalogue:
    """ViAn's own types and those of installed plug-ins.

    Raises:
        UnknownType: A plug-in's entry point does not load, is not an event type, or defines one that
            exists.
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
