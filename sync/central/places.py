"""Places: how much of one kind a station, and all stations together, may have under way at central.

Contract: a place is taken for the length of a block; where none is free, the block is refused and never waits. May be
used by several threads.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from events import Station
from sync.errors import Refusal


class Places:
    """The places of one kind.

    Args:
        code: The refusal's code where none is free.
        error: What is wrong then.
        next_step: What to do then.
        of_station_max: Places of one station.
        in_all_max: Places of all stations together; None: only those of each are counted.
    """

    def __init__(
        self, code: str, error: str, next_step: str, *, of_station_max: int, in_all_max: int | None = None
    ) -> None:
        self._code = code
        self._error = error
        self._next_step = next_step
        self._of_station_max = of_station_max
        self._in_all_max = in_all_max
        self._taken: Counter[Station] = Counter()
        self._lock = threading.Lock()

    @contextmanager
    def taken(self, station: Station) -> Iterator[None]:
        """A place of the station's.

        Raises:
            Refusal: All are taken.
        """
        with self._lock:
            own, total = self._taken[station], self._taken.total()
            if own >= self._of_station_max or (self._in_all_max is not None and total >= self._in_all_max):
                raise self._refusal(station, own, total)
            self._taken[station] += 1
        try:
            yield
        finally:
            with self._lock:
                self._taken[station] -= 1
                self._taken += Counter()  # forgets who has none

    def _refusal(self, station: Station, own: int, total: int) -> Refusal:
        got, wanted = f"{own} of station {station}", f"at most {self._of_station_max} of a station"
        if self._in_all_max is not None:
            got, wanted = f"{got}, {total} in all", f"{wanted} and {self._in_all_max} in all"
        return Refusal(429, self._code, self._error, got, wanted, self._next_step)
