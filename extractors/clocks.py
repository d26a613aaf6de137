"""When a frame was taken: on the media's own clock, or on the wall.

Contract: times strictly increase, whatever the video says; where its clock cannot be followed, the
second value says so in words, and is empty else.
"""

from collections.abc import Callable
from fractions import Fraction
from typing import Protocol

import av
from av.container import InputContainer

WITHOUT_PRESENTATION_TIMES = ("avi",)
"""Formats that store frames in decoding order and no presentation times; what FFmpeg reports as
such is not even monotone. Their decoding times, which are the frames' numbers, are used instead."""

JUMP_MAX_S = 3600
"""A longer pause between two frames of a recording is taken for a corrupt time, s."""

TRUST_US = 10_000_000
"""A live stream's clock counts as long as it is so near this machine's, µs. It is the better one then,
because it knows no delay on the way; beyond that it is wrong, and rules over several cameras need one time."""

PACE = 0.5
"""Frames that come faster than this share of the time between them were stored on the way."""

SETTLE_MAX_US = 5_000_000
"""So long a live stream may give what was stored, µs."""


class Clock(Protocol):
    """Gives frames their times."""

    def time_us(self, frame: av.VideoFrame) -> tuple[int | None, str]:
        """The frame's time, µs, later than that of the frame before, and what is odd about it.

        None for a frame of which nobody knows when it was taken: it is left out.
        """
        ...


class MediaClock:
    """Presentation times from the first frame."""

    def __init__(self, container: InputContainer) -> None:
        stream = container.streams.video[0]
        rate = stream.average_rate or stream.guessed_rate or Fraction(25)
        self._nominal_s = 1 / Fraction(rate)
        self._is_decoding_time = container.format.name in WITHOUT_PRESENTATION_TIMES
        self._offset_s: Fraction | None = None
        self._last_s: Fraction | None = None

    def time_us(self, frame: av.VideoFrame) -> tuple[int, str]:
        """µs from the first frame."""
        stamp = frame.dts if self._is_decoding_time else frame.pts
        own_s = None if stamp is None or frame.time_base is None else stamp * frame.time_base
        expected_s = Fraction(0) if self._last_s is None else self._last_s + self._nominal_s
        time_s = expected_s if own_s is None or self._offset_s is None else own_s - self._offset_s
        last_s = Fraction(-1) if self._last_s is None else self._last_s
        has_jumped = not last_s < time_s <= last_s + JUMP_MAX_S
        if has_jumped:
            time_s = expected_s
        if own_s is not None and (has_jumped or self._offset_s is None):
            self._offset_s = own_s - time_s
        self._last_s = time_s
        jumped = "the video's clock jumped; times go on from the last frame" if has_jumped else ""
        return round(time_s * 1_000_000), jumped


class WallClock:
    """Wall-clock times of a live stream: its own (RTCP sender reports), else the arrival of its first frame.

    From there its presentation times count, which do not jitter as arrivals do. When they have run more
    than `TRUST_US` away from this machine's clock they are tied to it anew. What a connection begins with
    comes all at once (the camera's store, what was read to learn what the stream is) and arrived long after
    it was taken: such frames, and frames without a time, have none here.
    """

    def __init__(self, own_zero_us: Callable[[], int | None], now_us: Callable[[], int]) -> None:
        """Begin with a connection.

        Args:
            own_zero_us: The wall-clock time of presentation time 0, as the stream says; None while it has not.
            now_us: This machine's wall clock.
        """
        self._own_zero_us = own_zero_us
        self._now_us = now_us
        self._ahead_us = 0
        self._zero_us: int | None = None
        self._before: tuple[int, int] | None = None
        self._began_us = now_us()
        self._last_us = 0

    def time_us(self, frame: av.VideoFrame) -> tuple[int | None, str]:
        """µs since 1970, UTC."""
        now_us, odd = self._now_us(), ""
        if frame.pts is None or frame.time_base is None:
            return (None if self._zero_us is None else self._later(now_us)), ""
        own_us = round(frame.pts * frame.time_base * 1_000_000)
        if self._zero_us is None:
            if not self._has_settled(now_us, own_us):
                return None, ""
            self._zero_us, odd = self._first_zero_us(now_us, own_us)
        time_us = self._zero_us + own_us
        away_us = time_us - now_us - self._ahead_us
        if abs(away_us) > TRUST_US:
            odd = f"the stream's clock and this machine's jumped or ran apart by {away_us / 1e6:+.0f} s; times go on"
            time_us = max(now_us, self._last_us + 1)  # a machine's clock that was set back must not stop the time
            self._zero_us, self._ahead_us = time_us - own_us, time_us - now_us
        return self._later(time_us), odd

    def _has_settled(self, now_us: int, own_us: int) -> bool:
        """Whether frames come at about the pace at which they were taken."""
        before, self._before = self._before, (now_us, own_us)
        if now_us - self._began_us > SETTLE_MAX_US:
            return True
        return before is not None and now_us - before[0] >= PACE * (own_us - before[1]) > 0

    def _first_zero_us(self, now_us: int, own_us: int) -> tuple[int, str]:
        zero_us = self._own_zero_us()
        if zero_us is None or zero_us <= 0:
            return now_us - own_us, ""
        late_us = now_us - (zero_us + own_us)
        if abs(late_us) <= TRUST_US:
            return zero_us, ""
        said = f"the stream's own clock is {-late_us / 1e6:+.0f} s off this machine's, which counts instead"
        return now_us - own_us, said

    def _later(self, time_us: int) -> int:
        self._last_us = max(time_us, self._last_us + 1)
        return self._last_us
