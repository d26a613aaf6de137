"""Turns: a request that goes on where another ends waits until that one is through.

Contract: a station with two requests under way names each (`order`) and says of the second that it follows the
first. Threads of one program keep turns; a request whose predecessor does not come through in time, or with which too
many of its station would wait, goes on without, and the log refuses it where that matters. Names are a station's own
and are forgotten after a while.
"""

import threading
from collections import Counter, OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager

from events import Station

WAIT_S = 2.0
WAITING_MAX = 4
"""Requests of a station that wait at a time: each holds a thread that the other stations need."""
NAME_LENGTH_MAX = 64
_REMEMBERED = 16
"""Requests of a station that are remembered."""
_STATIONS_MAX = 10_000


class Turns:
    """The requests with segments of all stations that are through."""

    def __init__(self, wait_s: float = WAIT_S) -> None:
        self._wait_s = wait_s
        self._changed = threading.Condition()
        self._through: OrderedDict[Station, OrderedDict[str, None]] = OrderedDict()
        self._waiting: Counter[Station] = Counter()

    def wait_for(self, station: Station, follows: str) -> None:
        """Return when the station's request of that name is through or too late; empty: at once."""
        if not follows:
            return
        with self._changed:
            if self._waiting[station] >= WAITING_MAX:
                return
            self._waiting[station] += 1
            try:
                self._changed.wait_for(lambda: follows in self._through.get(station, ()), self._wait_s)
            finally:
                self._waiting[station] -= 1
                self._waiting += Counter()  # forgets those of which none waits

    @contextmanager
    def named(self, station: Station, order: str) -> Iterator[None]:
        """Note, when the block ends, that the station's request of that name is through; empty: it has none."""
        try:
            yield
        finally:
            if order:
                self._note(station, order)

    def _note(self, station: Station, order: str) -> None:
        with self._changed:
            names = self._through.setdefault(station, OrderedDict())
            names[order] = None
            self._through.move_to_end(station)
            while len(names) > _REMEMBERED:
                names.popitem(last=False)
            while len(self._through) > _STATIONS_MAX:
                self._through.popitem(last=False)
            self._changed.notify_all()
