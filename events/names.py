"""Names of stations, sources, types and streams.

A stream is one (station, source, type); it is written `station/source/type`,
for example `brno-2/gate/track_point`. Names are checked where they enter, so
that a stream name can be split at its slashes, printed in a terminal and used
in a file name without quoting.
"""

import re
from dataclasses import dataclass
from typing import NewType, Self

from events.errors import InvalidName

Station = NewType("Station", str)
Source = NewType("Source", str)
TypeName = NewType("TypeName", str)

_NAME = re.compile(r"[A-Za-z0-9](?:[A-Za-z0-9._-]{0,62}[A-Za-z0-9])?")
_SOURCE = re.compile(rf"(?=.{{1,64}}\Z){_NAME.pattern}(?:~[0-9a-f]{{8}})?")
_TYPE = re.compile(r"[a-z][a-z0-9_]{0,47}")
_NAME_WANTED = "1 to 64 of A-Z a-z 0-9 . _ -, beginning and ending with a letter or digit"
_SOURCE_WANTED = f"{_NAME_WANTED}; if derived, then ~ and 8 hexadecimal digits"
_TYPE_WANTED = "1 to 48 of a-z 0-9 _, beginning with a letter"


def station_name(text: str) -> Station:
    """The text as a station's name.

    Raises:
        InvalidName: The text is outside the grammar.
    """
    return Station(_checked("station", text, _NAME, _NAME_WANTED))


def source_name(text: str) -> Source:
    """The text as the name of a source: a camera or another sensor, or what a filter leaves of its streams.

    Raises:
        InvalidName: The text is outside the grammar.
    """
    return Source(_checked("source", text, _SOURCE, _SOURCE_WANTED))


def type_name(text: str) -> TypeName:
    """The text as the name of an event type.

    Raises:
        InvalidName: The text is outside the grammar.
    """
    return TypeName(_checked("type", text, _TYPE, _TYPE_WANTED))


@dataclass(frozen=True, slots=True, order=True)
class StreamName:
    """One stream: what one source at one station says in one event type."""

    station: Station
    source: Source
    type: TypeName

    @classmethod
    def of(cls, station: str, source: str, type: str) -> Self:  # noqa: A002 - the envelope's own word
        """The stream of these three names, each checked.

        Raises:
            InvalidName: One of them is outside the grammar.
        """
        return cls(station_name(station), source_name(source), type_name(type))

    @classmethod
    def parse(cls, text: str) -> Self:
        """The stream written `station/source/type`.

        >>> StreamName.parse("brno-2/gate/track_point").source
        'gate'

        Raises:
            InvalidName: Not three names between slashes, or one is outside the grammar.
        """
        parts = text.split("/")
        if len(parts) != 3:
            raise InvalidName(f"a stream is written station/source/type, got {text[:100]!r}")
        return cls.of(*parts)

    def __str__(self) -> str:
        return f"{self.station}/{self.source}/{self.type}"


def _checked(what: str, text: str, grammar: re.Pattern[str], wanted: str) -> str:
    if not grammar.fullmatch(text):
        raise InvalidName(f"{what} must be {wanted}; got {text[:100]!r}")
    return text
