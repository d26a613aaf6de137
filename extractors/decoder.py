"""The decoding process: `python -m extractors.decoder`, one request on stdin to messages on stdout.

Contract: sends INFO or REFUSED first, then FRAME and GAP in order of presentation, then END. It dies
with its parent: stdin is a pipe whose end ends this process, wherever the decoder is at that moment.
It runs alone because a decoder fed with hostile bytes may crash, and a camera may never answer; the
parent (`extractors.video`, `extractors.live`) survives both and says so.

It decides nothing about what a gap means. Of a recording it keeps at most one frame, and waits for the
parent; of a live stream a queue of the newest, so that pictures that nobody has time for are left out
and counted.
"""

import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import av
import av.error
from av.container import InputContainer

from extractors import folder
from extractors.clocks import Clock, MediaClock, WallClock
from extractors.errors import VideoUnreadable
from extractors.media import GapReason
from extractors.opening import About, NoVideo, about, opened, read_picture, said
from extractors.outlets import Newest, Outlet, Straight
from extractors.pictures import Picture, Pictures
from extractors.wire import Header, Kind, Medium, Request, Writable

SHORTFALL_SHARE = 0.02
"""Missing frames up to this share of the container's count are a shortfall; more is a broken-off file."""

PACKETS_CORRUPT_MAX = 1_000
"""Corrupt packets in a row after which the rest is given up."""

SLOT_TOLERANCE_US = 1_000
"""A frame that comes so early belongs to the next slot of a given frame rate: times in files are rounded."""


def main() -> None:
    """Decode what the request on stdin names."""
    request = Request.from_line(sys.stdin.buffer.readline())
    threading.Thread(target=_die_with_parent, args=(sys.stdin.buffer,), daemon=True).start()
    try:
        send(request, sys.stdout.buffer)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        os._exit(0)  # the parent wants no more frames
    os._exit(0)  # destructors of a decoder that met hostile data had better not run


def send(request: Request, out: Writable) -> None:
    """Write the messages of what is requested to `out`."""
    outlet = Newest(out, request.queue_frames) if request.is_live else Straight(out)
    try:
        if request.medium is Medium.FOLDER:
            _send_folder(request, outlet)
        else:
            _send_stream(request, outlet)
    finally:
        outlet.close()


def _send_stream(request: Request, outlet: Outlet) -> None:
    try:
        container = opened(request)
    except (av.error.FFmpegError, VideoUnreadable, NoVideo) as error:
        outlet.json(Kind.REFUSED, error=said(error))
        return
    with container:
        sender = _Sender(outlet, request, about(container))
        own_zero_us = lambda: container.start_time_realtime  # noqa: E731
        clock = WallClock(own_zero_us, _now_us) if request.is_live else MediaClock(container)
        broken = None
        try:
            for frame in _decoded(container, sender, is_live=request.is_live):
                sender.send(frame, clock)
        except _BrokenOff as error:
            broken = str(error)
        sender.end(broken)


def _send_folder(request: Request, outlet: Outlet) -> None:
    try:
        paths = folder.pictures_in(Path(request.place))
        times = folder.times_us(paths, request.fps)
    except VideoUnreadable as error:
        outlet.json(Kind.REFUSED, error=str(error))
        return
    first = folder.taken_at(paths[:1])
    taken = first[0].isoformat() if first else None
    sender = _Sender(outlet, request, About("pictures", request.fps, len(paths), creation_time=taken))
    for path, time_us in zip(paths, times, strict=True):
        try:
            sender.send(read_picture(path, request), _Told(time_us))
        except (av.error.FFmpegError, VideoUnreadable, StopIteration) as error:
            sender.corrupt(f"{path.name}: {said(error) or 'no picture'}")
    sender.end(None)


class _BrokenOff(Exception):
    """A live stream ended with an error."""


@dataclass(frozen=True, slots=True)
class _Told:
    """A clock that shows one time: that of a picture in a folder."""

    its_us: int

    def time_us(self, _: av.VideoFrame) -> tuple[int, str]:
        return self.its_us, ""


@dataclass(frozen=True, slots=True)
class _Place:
    """A frame's place among the others, and what is to be said before it."""

    index: int
    time_us: int
    gaps: list[tuple[GapReason, str]] = field(default_factory=list)


class _Sender:
    """Numbers frames, notes gaps, and sends both in order."""

    def __init__(self, outlet: Outlet, request: Request, about: About) -> None:
        self._outlet = outlet
        self._about = about
        self._pictures = Pictures(request.width_max, request.height_max)
        self._fps = None if request.medium is Medium.FOLDER else request.fps
        self._slot: int | None = None
        self._size: tuple[int, int] | None = None
        self._gaps: list[tuple[GapReason, str]] = []  # before the next frame
        self._corrupt = 0  # since the last frame
        self._corrupt_in_all = 0
        self._lost: str | None = None
        self._index = 0

    def corrupt(self, detail: str) -> bool:
        """Note a packet or frame that does not decode; whether there is still hope."""
        self._corrupt += 1
        self._corrupt_in_all += 1
        self._lost = self._lost or detail
        return self._corrupt < PACKETS_CORRUPT_MAX

    def send(self, frame: av.VideoFrame, clock: Clock) -> None:
        """Take in a frame; send what is ready."""
        self._note_corrupt()
        time_us, jumped = clock.time_us(frame)
        if time_us is None:
            return
        if jumped:
            self._gaps.append((GapReason.TIME_JUMPED, jumped))
        place = _Place(self._index, time_us, self._gaps)
        self._index += 1
        if self._is_wanted(time_us):
            self._gaps = []
            for picture, its in self._pictures.push(frame, place):
                self._send(picture, its)

    def end(self, error: str | None) -> None:
        """Send what is still held back, what is missing, and the end."""
        for picture, its in self._pictures.flush():
            self._send(picture, its)
        self._note_corrupt()
        self._note_missing()
        if self._size is None:
            self._send_info(self._about.size, None)
        self._send_gaps(self._index, self._gaps)
        self._outlet.json(Kind.END, self._index, error=error)

    def _is_wanted(self, time_us: int) -> bool:
        """Whether the frame is the first of its slot of the wanted rate."""
        if self._fps is None:
            return True
        slot = int((time_us + SLOT_TOLERANCE_US) * self._fps // 1_000_000)
        is_first = slot != self._slot
        self._slot = slot
        return is_first

    def _send(self, picture: Picture, place: _Place) -> None:
        gaps = place.gaps + [(GapReason.CONVERTED, text) for text in self._pictures.told()]
        before, self._size = self._size, picture.full_size
        if before is None:
            self._send_info(self._size, place.time_us)
        self._send_gaps(place.index, gaps)
        if before is not None and before != self._size:
            self._send_size_changed(place.index, before, self._size)
        height, width = picture.image.shape[:2]
        header = Header(Kind.FRAME, place.index, place.time_us, width, height, picture.scale, picture.image.nbytes)
        self._outlet.frame(header, picture.image)

    def _send_info(self, size: tuple[int, int], first_us: int | None) -> None:
        about = self._about
        self._outlet.json(
            Kind.INFO,
            width=size[0],
            height=size[1],
            fps=about.fps,
            frames_expected=about.frames_expected,
            duration_s=about.duration_s,
            codec=about.codec,
            creation_time=about.creation_time,
            first_us=first_us,
        )

    def _send_gaps(self, index: int, gaps: list[tuple[GapReason, str]]) -> None:
        for reason, detail in gaps:
            self._outlet.json(Kind.GAP, index, reason=reason, detail=detail)

    def _send_size_changed(self, index: int, before: tuple[int, int], now: tuple[int, int]) -> None:
        told = f"the frame size changed from {_times(before)} to {_times(now)} px"
        self._outlet.json(Kind.GAP, index, reason=GapReason.SIZE_CHANGED, detail=told, width=now[0], height=now[1])

    def _note_corrupt(self) -> None:
        if self._corrupt:
            self._gaps.append((GapReason.CORRUPT, f"{self._corrupt} packets or frames did not decode: {self._lost}"))
        self._corrupt, self._lost = 0, None

    def _note_missing(self) -> None:
        found = self._index + self._corrupt_in_all
        missing = (self._about.frames_expected or found) - found
        if self._index and missing > max(2, SHORTFALL_SHARE * self._index):
            told = f"the file breaks off: {self._about.frames_expected} frames announced, {self._index} decoded"
            self._gaps.append((GapReason.BROKEN_OFF, told))
        elif self._index and missing > 0:
            told = f"{self._about.frames_expected} frames announced, {self._index} decoded"
            self._gaps.append((GapReason.SHORTFALL, told))


def _decoded(container: InputContainer, sender: _Sender, *, is_live: bool) -> Iterator[av.VideoFrame]:
    """Frames in order of presentation; what does not decode is reported to the sender."""
    for packet in _packets(container, sender, is_live=is_live):
        try:
            frames = packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError as error:
            if not sender.corrupt(said(error)):
                return
            continue
        for frame in frames:
            if frame.is_corrupt:
                sender.corrupt("decoded with errors")
            else:
                yield frame


def _packets(container: InputContainer, sender: _Sender, *, is_live: bool) -> Iterator["av.Packet[Any]"]:
    """Packets as the source has them; the last one is empty, and makes the decoder give what it still holds."""
    stream = container.streams.video[0]
    while True:
        try:
            yield from container.demux(stream)
            return
        except av.error.FFmpegError as error:
            if is_live:
                raise _BrokenOff(said(error)) from error
            if not sender.corrupt(said(error)):
                return


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _now_us() -> int:
    return time.time_ns() // 1000


def _die_with_parent(stdin: BinaryIO) -> None:
    stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
