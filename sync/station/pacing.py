"""How much at a time: the size of a request, what the link was found to carry, and caps on it.

Contract: no clock of its own; moments are seconds that never go back, given by the caller. A request is as large
as the link carries in the latency that is aimed at, so that what comes in a better lane never waits for more.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from sync.plans.plan import Entry, Plan

_GROWTH_MAX = 4.0
_SHRINK_MAX = 0.25
_SMOOTHING = 0.3
_BORROW_S = 10.0
"""What is live may run into debt for so many seconds of a cap's rate."""


class Sizer:
    """The bytes of the next request, from how long those before took.

    A request of s bytes takes s/b + c seconds on a link of b bytes a second. The next size is the last one, times
    latency over time taken, so it comes to rest where a request takes the latency, without knowing b and c; the
    step is the smaller the larger c is, so it cannot swing. Where c alone, the way there and back, is long, what is
    aimed at is twice that: else a link with a long way would be left idle.

    Args:
        latency_s: What a request may take, in seconds.
        bytes_min: Least bytes of a request.
        bytes_max: Most bytes of a request.
    """

    def __init__(self, latency_s: float, bytes_min: int, bytes_max: int) -> None:
        self._latency_s = latency_s
        self._bytes_min = min(bytes_min, bytes_max)
        self._bytes_max = bytes_max
        self._shortest_s: float | None = None
        self.size = self._bytes_min
        """What the next request should hold."""
        self.took_s = 0.0
        """How long the last one took that was not small for want of segments."""

    def took(self, size: int, seconds: float) -> None:
        """Learn from a request of `size` bytes that was answered after so many seconds."""
        seconds = max(seconds, 1e-6)
        self._shortest_s = min(seconds, self._shortest_s or seconds)
        if 2 * size < self.size:
            return  # It was small for want of segments: it says little of larger ones.
        self.took_s = seconds
        aimed_s = max(self._latency_s, 2 * self._shortest_s)
        wanted = min(max(size * aimed_s / seconds, self.size * _SHRINK_MAX), self.size * _GROWTH_MAX)
        self.size = int(min(max(wanted, self._bytes_min), self._bytes_max))


class Meter:
    """Bits a second that were sent while something was being sent."""

    def __init__(self) -> None:
        self.bps: float | None = None

    def took(self, size: int, seconds: float) -> None:
        """Learn from `size` bytes that took so many seconds of sending."""
        found = 8 * size / max(seconds, 1e-6)
        self.bps = found if self.bps is None else self.bps + _SMOOTHING * (found - self.bps)


@dataclass(slots=True)
class Bucket:
    """A cap on bits a second: what was sent is a debt that the rate pays off."""

    rate_bps: float
    _debt_bits: float = 0.0
    _at: float = 0.0

    def sent(self, size: int, at: float) -> None:
        """Count so many bytes."""
        self._debt_bits = self._debt(at) + 8 * size
        self._at = at

    def wait_s(self, at: float, *, is_live: bool = False) -> float:
        """Seconds until something may be sent; live traffic goes ahead of the debt, up to a bound."""
        debt = self._debt(at) - (_BORROW_S * self.rate_bps if is_live else 0.0)
        return max(0.0, debt / self.rate_bps)

    def bytes_in(self, seconds: float) -> int:
        """What the rate carries in so many seconds."""
        return int(self.rate_bps * seconds / 8)

    def _debt(self, at: float) -> float:
        return max(0.0, self._debt_bits - self.rate_bps * (at - self._at))


class Caps:
    """The caps on what a station sends: the plan's, those of its entries, and central's."""

    def __init__(self) -> None:
        self._station: Bucket | None = None
        self._central: Bucket | None = None
        self._entries: dict[Entry, Bucket] = {}

    def follow(self, plan: Plan) -> None:
        """Keep the plan's caps from now on; a cap that stays keeps its debt."""
        self._station = _kept(self._station, plan.rate_bps)
        kept = {entry: _kept(self._entries.get(entry), entry.rate_bps) for entry in plan.entries}
        self._entries = {entry: bucket for entry, bucket in kept.items() if bucket is not None}

    def heed(self, bits_per_s_max: int | None) -> None:
        """Keep central's cap from now on."""
        self._central = _kept(self._central, bits_per_s_max)

    def wait_s(self, entry: Entry, at: float, *, is_live: bool) -> float:
        """Seconds until something of the entry may be sent."""
        return max((bucket.wait_s(at, is_live=is_live) for bucket in self._of(entry)), default=0.0)

    def sent(self, sizes: Mapping[Entry, int], at: float) -> None:
        """Count what was sent of each entry."""
        for entry, size in sizes.items():
            for bucket in self._of(entry):
                bucket.sent(size, at)

    def bytes_in(self, entry: Entry, seconds: float) -> int | None:
        """What the caps on the entry carry in so many seconds; None where there is none."""
        return min((bucket.bytes_in(seconds) for bucket in self._of(entry)), default=None)

    def _of(self, entry: Entry) -> list[Bucket]:
        return [each for each in (self._station, self._central, self._entries.get(entry)) if each is not None]


def _kept(bucket: Bucket | None, rate_bps: float | None) -> Bucket | None:
    if rate_bps is None:
        return None
    return bucket if bucket is not None and bucket.rate_bps == rate_bps else Bucket(rate_bps)
