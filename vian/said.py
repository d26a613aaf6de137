"""What a log holds of one source, event by event, over all the lives of its streams."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

from events import EventType, StreamName, decode, events_of
from store import Log

E = TypeVar("E", bound=EventType)


@dataclass(frozen=True, slots=True)
class Said:
    """What was said of a source, each event with its position in the log."""

    log: Log
    station: str
    source: str

    def every(self, event_type: type[E]) -> Iterator[tuple[E, int]]:
        """All events of the type, in order."""
        for segment in self.log.read_lives(StreamName.of(self.station, self.source, event_type.type_name)):
            for event in events_of(decode(segment, self.log.catalogue)):
                assert isinstance(event, event_type), "a stream holds one type"
                yield event, segment.position

    def newest(self, event_type: type[E]) -> tuple[E, int] | None:
        """The newest event of the type; None where there is none."""
        newest = None
        for said in self.every(event_type):
            newest = said
        return newest

    def newest_about(self, event_type: type[E], subject: str) -> tuple[E, int] | None:
        """The newest event of the type about the subject; None where there is none."""
        assert event_type.subject_field is not None
        newest = None
        for event, position in self.every(event_type):
            if getattr(event, event_type.subject_field) == subject:
                newest = event, position
        return newest
