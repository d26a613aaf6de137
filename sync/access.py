"""Who speaks: what central knows of the sender of a request, and what that sender may do.

Contract: a `Caller` is made only of what the request's signature covers and central's registry says;
nothing that a station claims of itself is in it.
"""

from dataclasses import dataclass

from events import Station

REPLICATE = "replicate"
FIND = "find"
QUERY = "query"
OPERATIONS = (REPLICATE, FIND, QUERY)
"""What a station may be granted."""
EVERY_STATION = "*"
"""Among `Caller.reads`: the events of all stations."""


@dataclass(frozen=True, slots=True)
class Caller:
    """The station that sent a request, as its signature proves."""

    station: Station
    operations: frozenset[str]
    reads: frozenset[str]
    """stations whose events it may find and query: names, or `EVERY_STATION`"""
    key_id: str
    number: int
    """of the request in its session, from 1; 0 for a hello"""

    def may_read(self, station: str) -> bool:
        """Whether it may find and query events of that station; its own are not among them unless granted."""
        return EVERY_STATION in self.reads or station in self.reads
