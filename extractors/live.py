"""Live streams in: frames of a camera as they come, over every interruption.

Contract: `Live` connects when it is entered, and says what the stream is; `frames` then yields frames and gaps
until `is_stopped`. A stream that ends, breaks or falls silent is a gap at once (INTERRUPTED), and is tried
again with growing pauses until it gives pictures (RESUMED); numbers of frames go on, and times are the
wall clock's, so what lies between is missing and nothing is twice. Only the first connection fails for good:
then nothing is known yet, not even the size of the pictures.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from extractors.addresses import Address
from extractors.decoding import LOOK_S, Decoding
from extractors.errors import Stopped, StreamLost, VideoError, VideoUnreadable
from extractors.media import Frame, Gap, GapReason, Shape, VideoInfo
from extractors.wire import Request

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


@dataclass(frozen=True, slots=True)
class LiveLimits:
    """How long a live stream is waited for, and how much of it is kept."""

    connect_s: float = 15.0
    """longest wait for its first picture, s"""
    stall_s: float = 10.0
    """silence after which it counts as interrupted, s"""
    retry_s_min: float = 1.0
    """pause before it is tried again, s; each failure doubles it ..."""
    retry_s_max: float = 60.0
    """... up to this, s"""
    give_up_s: float = 7 * 86_400.0
    """an interruption longer than this ends the work with an error, s"""
    queue_frames: int = 8
    """pictures that wait for the extractor at most; then the oldest are left out"""
    pixels_max: int = 8192 * 4320
    """largest width times height of a picture, px"""


class Live:
    """A connection to a live stream that is made again when it breaks."""

    def __init__(
        self,
        address: Address,
        limits: LiveLimits | None = None,
        shape: Shape | None = None,
        *,
        ca_file: Path | None = None,
        is_stopped: Callable[[], bool] = lambda: False,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self._address = address
        self._limits = limits or LiveLimits()
        self._shape = shape or Shape()
        self._ca_file = ca_file
        self._is_stopped = is_stopped
        self._sleep = sleep
        self._decoding: Decoding | None = None
        self._connection = ExitStack()
        self._pause_s = self._limits.retry_s_min
        self._next_index = 0
        self._last_us = -1
        self._why = ""
        self.info: VideoInfo
        """what the stream says of itself; its size is that of the newest pictures"""

    def __enter__(self) -> Self:
        """Connect.

        Raises:
            VideoUnreadable: There is no live stream at the address, or no answer.
            Stopped: The caller wants no more.
        """
        self._connect()
        self._zero_us = self._first_us
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._connection.close()

    @property
    def started_at(self) -> datetime:
        """Wall-clock time of the first picture: the stream's own, where it tells one, else this machine's."""
        return _EPOCH + timedelta(microseconds=self._zero_us)

    def frames(self) -> Iterator[Frame | Gap]:
        """Frames, with their times from the first one, and gaps, until the caller wants no more.

        Raises:
            StreamLost: It was interrupted for `give_up_s`.
        """
        try:
            while True:
                yield from self._of_this_connection()
                yield self._gap(GapReason.INTERRUPTED, f"the live stream is interrupted: {self._why}")
                before = self.info
                tries, gone_s = self._reconnect()
                behind_s = self._caught_up(gone_s)
                yield self._gap(GapReason.RESUMED, f"the live stream is back after {gone_s:.1f} s, at attempt {tries}")
                if behind_s:
                    said = f"the clock is {behind_s:.1f} s behind after the break: times go on from it"
                    yield self._gap(GapReason.TIME_JUMPED, said)
                now = self.info
                if (now.width, now.height) != (before.width, before.height):
                    sizes = f"from {before.width}x{before.height} to {now.width}x{now.height} px"
                    changed = self._gap(GapReason.SIZE_CHANGED, f"the frame size changed {sizes}")
                    yield replace(changed, size=(now.width, now.height))
        except Stopped:
            return

    def _of_this_connection(self) -> Iterator[Frame | Gap]:
        """What comes until it breaks; `_why` says then how."""
        assert self._decoding is not None
        began_s, first_index = time.monotonic(), self._next_index
        try:
            for item in self._decoding.media():
                if isinstance(item, Gap):
                    if item.size is not None:
                        self.info = replace(self.info, width=item.size[0], height=item.size[1])
                    yield replace(item, before_index=first_index + item.before_index, time_us=max(0, self._last_us))
                    continue
                self._next_index = first_index + item.index + 1
                self._last_us = max(item.time_us - self._zero_us, self._last_us + 1)
                yield replace(item, index=first_index + item.index, time_us=self._last_us)
            self._why = self._decoding.error or "the other side ended it"
        except VideoError as error:
            self._why = str(error)
        if time.monotonic() - began_s > self._limits.stall_s:
            self._pause_s = self._limits.retry_s_min  # it held for a while: not one failure after another

    def _caught_up(self, gone_s: float) -> float:
        """Let times go on behind the break where the new connection's clock is not yet there; how far it is behind, s.

        The camera's clock may be believed on one connection and not on the next, and this machine's may be set back
        meanwhile: without this no time would pass until the clock has caught up.
        """
        due_us = self._last_us + round(1e6 * gone_s)
        behind_us = due_us - (self._first_us - self._zero_us)
        if self._first_us - self._zero_us > self._last_us:
            return 0.0
        self._zero_us -= behind_us
        return behind_us / 1e6

    def _reconnect(self) -> tuple[int, float]:
        """Connect again; the attempts that it took, and the time, s.

        Raises:
            StreamLost: It stayed away for `give_up_s`.
            Stopped: The caller wants no more.
        """
        began_s, tries = time.monotonic(), 0
        while True:
            self._pause()
            tries += 1
            try:
                self._connect()
                return tries, time.monotonic() - began_s
            except VideoError as error:
                if time.monotonic() - began_s > self._limits.give_up_s:
                    raise StreamLost(
                        f"{self._address.shown}: interrupted for {self._limits.give_up_s:g} s and given up after "
                        f"{tries} attempts; the last one: {error}"
                    ) from error

    def _connect(self) -> None:
        """Open the stream, and wait for its first picture."""
        self._connection.close()
        limits, shape = self._limits, self._shape
        request = Request(
            self._address.medium,
            self._address.place,
            pixels_max=limits.pixels_max,
            width_max=shape.width_max,
            height_max=shape.height_max,
            fps=shape.fps,
            queue_frames=limits.queue_frames,
            ca_file=str(self._ca_file) if self._ca_file and self._address.is_over_tls else None,
        )
        decoding = Decoding(
            request,
            name=self._address.shown,
            stall_s=limits.connect_s,
            redact=self._address.redacted,
            is_stopped=self._is_stopped,
        )
        self._decoding = self._connection.enter_context(decoding)
        try:
            content = decoding.info()
            self._check_live(content)
        except BaseException:
            self._connection.close()
            raise
        decoding.stall_s = limits.stall_s
        self._first_us = int(content["first_us"])
        self.info = _info(content)

    def _check_live(self, content: dict[str, Any]) -> None:
        name = self._address.shown
        if content["first_us"] is None:
            raise VideoUnreadable(f"{name}: not one picture of the stream decodes. Next: try it in a player")
        if content["duration_s"] is not None and content["frames_expected"] is not None:
            raise VideoUnreadable(
                f"{name}: is a recording of {content['duration_s']:.0f} s, not a live stream. "
                "Next: download it, then give the file"
            )

    def _pause(self) -> None:
        """Wait before the next attempt; the next wait is twice as long."""
        until_s = time.monotonic() + self._pause_s
        while (left_s := until_s - time.monotonic()) > 0:
            if self._is_stopped():
                raise Stopped(f"{self._address.shown}: stopped while it was away")
            self._sleep(min(left_s, LOOK_S))
        self._pause_s = min(2 * self._pause_s, self._limits.retry_s_max)

    def _gap(self, reason: GapReason, detail: str) -> Gap:
        if reason is GapReason.RESUMED:
            self._last_us = max(self._last_us, self._first_us - self._zero_us - 1)
        return Gap(self._next_index, reason, detail, self._last_us)


def _info(content: dict[str, Any]) -> VideoInfo:
    """What the stream says of itself, without what only a recording has."""
    return VideoInfo(
        width=content["width"],
        height=content["height"],
        fps=content["fps"],
        frames_expected=None,
        duration_s=None,
        codec=content["codec"],
        creation_time=None,
        sha256="",
    )
