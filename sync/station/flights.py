"""Requests with segments that are under way: one in the caller's own thread, or several in threads of their own.

Contract: with one slot a flight is over when `launch` returns, so that steps are deterministic. With more, a flight
that goes on where another ends names it, and central waits for that one. Flights are given out as they land, in any
order; whoever launches decides what a failure means for the others.
"""

from collections.abc import Callable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass

from sync.protocol.wire import SegmentsAnswer
from sync.station.client import Link
from sync.station.outbox import Filled, Parcel

_LIVE_SLOTS = 1
_FAST_SECONDS = 0.1
"""Requests that are answered within this need not be kept apart."""
LOOK_SECONDS = (0.02, 0.2)
"""Least and longest wait for an answer before the log is looked at again."""
_LOOK_SHARE = 0.5
"""That wait, of the time since the last launch: a request that takes long is no reason to look often."""


BACKLOG = float("inf")
"""The lane of a request in which nothing is live: whatever is live may overtake it."""


@dataclass(frozen=True, slots=True)
class _Flight:
    """A request under way."""

    name: str
    parcel: Parcel
    live_lane: float


@dataclass(frozen=True, slots=True)
class Landed:
    """What became of a request."""

    parcel: Parcel
    seconds: float
    answer: SegmentsAnswer | BaseException

    @property
    def way_s(self) -> float:
        """What the way there and back took: all but what central says that it took itself."""
        own_s = self.answer.took_s if isinstance(self.answer, SegmentsAnswer) else 0.0
        return max(0.0, self.seconds - own_s)


class Flights:
    """The requests under way.

    Args:
        link: Central.
        slots: How many may be under way at once; with more than one, one more for what overtakes them.
        name: What to name requests by, unlike those of any other daemon.
        monotonic: Seconds that never go back.
    """

    def __init__(self, link: Link, slots: int, name: str, monotonic: Callable[[], float]) -> None:
        self._link = link
        self._slots = slots
        self._name = name
        self._monotonic = monotonic
        self._number = 0
        self._launched_at = 0.0
        self._threads = ThreadPoolExecutor(slots + _LIVE_SLOTS, "vian-sync") if slots > 1 else None
        self._under_way: dict[Future[Landed], _Flight] = {}

    def __len__(self) -> int:
        """How many are under way or landed and not given out."""
        return len(self._under_way)

    @property
    def has_slot(self) -> bool:
        """Whether another may be launched."""
        return len(self._under_way) < self._slots

    def overtakes(self, lane: int) -> bool:
        """Whether what is live in that lane need not wait for a slot: there is one for what is more urgent."""
        has_room = self._slots > 1 and len(self._under_way) < self._slots + _LIVE_SLOTS
        return has_room and all(lane < each.live_lane for each in self._under_way.values())

    def is_apart(self, took_s: float) -> bool:
        """Whether one launched now is far enough from the one before, where each takes so long.

        Two that begin together share a slow link, and land together; then nothing travels until the next ones do.
        """
        since_s = self._monotonic() - self._launched_at
        return took_s < _FAST_SECONDS or not self._under_way or since_s >= took_s / self._slots

    def filled(self) -> list[Filled]:
        """What those under way carry, in the order of their launch."""
        return [each for flight in self._under_way.values() for each in flight.parcel.filled]

    def launch(self, parcel: Parcel, live_lane: float = BACKLOG) -> None:
        """Send the parcel; what is live in it is of that lane or behind it."""
        self._number += 1
        self._launched_at = self._monotonic()
        name = f"{self._name}-{self._number}"
        follows = self._followed(parcel)
        if self._threads is not None:
            future = self._threads.submit(self._fly, parcel, name, follows)
        else:
            future = Future()
            future.set_result(self._fly(parcel, name, follows))
        self._under_way[future] = _Flight(name, parcel, live_lane)

    def wait(self) -> None:
        """Return when one has landed, or when it is time to look at the log again."""
        least, longest = LOOK_SECONDS
        since_s = self._monotonic() - self._launched_at
        wait(self._under_way, min(max(least, _LOOK_SHARE * since_s), longest), FIRST_COMPLETED)

    def landed(self) -> Landed | None:
        """One that has landed, the first launched first; None if none has."""
        future = next((each for each in self._under_way if each.done()), None)
        if future is None:
            return None
        del self._under_way[future]
        return future.result()

    def close(self) -> None:
        """Launch no more; what is under way ends by itself."""
        if self._threads is not None:
            self._threads.shutdown(wait=False, cancel_futures=True)

    def _followed(self, parcel: Parcel) -> str:
        """Name of the newest request under way that carries what this parcel goes on from."""
        begins = {(each.key, each.after) for each in parcel.filled}
        names = [
            other.name
            for other in self._under_way.values()
            if begins & {(each.key, each.end) for each in other.parcel.filled}
        ]
        return names[-1] if names else ""

    def _fly(self, parcel: Parcel, name: str, follows: str) -> Landed:
        begun = self._monotonic()
        answer: SegmentsAnswer | BaseException
        try:
            answer = self._link.send(parcel.records, name, follows)
        except BaseException as error:  # given to whoever asks for it
            answer = error
        return Landed(parcel, self._monotonic() - begun, answer)
