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
from av.video.codeccontext import VideoCodecContext

from extractors import folder
from extractors.clocks import Clock, MediaClock, WallClock
from extractors.errors import VideoUnreadable
from extractors.media import GapReason
from extractors.outlets import Newest, Outlet, Straight
from extractors.pictures import Picture, Pictures
from extractors.wire import Header, Kind, Medium, Request, Writable

CONTAINERS = (
    "asf,avi,av1,dv,flv,gif,h264,hevc,ivf,m4v,matroska,webm,mjpeg,mov,mp4,mpeg,mpegts,mpegvideo,mxf,nut,obu,"
    "ogg,rm,vc1,yuv4mpegpipe"
)
"""Formats that are opened. Without a list FFmpeg takes any text file for a terminal recording, and
plays lists that name other files and addresses."""

LIVE = f"{CONTAINERS},mpjpeg,rtp,rtsp,sdp"
"""Formats of live streams. Play lists are none of them: they name other addresses."""

PROTOCOLS = {
    "rtsp": "rtsp,rtp,tcp,udp",
    "rtsps": "rtsps,rtsp,rtp,tcp,tls",
    "http": "http,tcp",
    "https": "https,tls,tcp",
}
"""Protocols that an address of each scheme may use; a redirection to any other is refused."""

SHORTFALL_SHARE = 0.02
"""Missing frames up to this share of the container's count are a shortfall; more is a broken-off file."""

PACKETS_CORRUPT_MAX = 1_000
"""Corrupt packets in a row after which the rest is given up."""

ANALYSED_US = 1_000_000
"""Most of a live stream that is read to learn what it is, µs."""

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
        container = _open(request)
    except (av.error.FFmpegError, VideoUnreadable, _NoVideo) as error:
        outlet.json(Kind.REFUSED, error=_said(error))
        return
    with container:
        stream = container.streams.video[0]
        sender = _Sender(outlet, request, _about(container), stream.frames or None)
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
    about = _About("pictures", request.fps, len(paths), creation_time=first[0].isoformat() if first else None)
    sender = _Sender(outlet, request, about, len(paths))
    for path, time_us in zip(paths, times, strict=True):
        try:
            sender.send(_read_picture(path, request), _Told(time_us))
        except (av.error.FFmpegError, VideoUnreadable, StopIteration) as error:
            sender.corrupt(f"{path.name}: {_said(error) or 'no picture'}")
    sender.end(None)


class _NoVideo(Exception):
    """It opens, and holds no video stream."""


class _BrokenOff(Exception):
    """A live stream ended with an error."""


@dataclass(frozen=True, slots=True)
class _About:
    """What the source says of itself; the size where no frame tells it."""

    codec: str
    fps: float | None
    frames_expected: int | None
    duration_s: float | None = None
    creation_time: str | None = None
    size: tuple[int, int] = (0, 0)


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

    def __init__(self, outlet: Outlet, request: Request, about: _About, frames_expected: int | None) -> None:
        self._outlet = outlet
        self._about = about
        self._frames_expected = frames_expected
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
        if self._size is None:
            self._send_info(picture.full_size, place.time_us)
        elif self._size != picture.full_size:
            changed = f"the frame size changed from {_times(self._size)} to {_times(picture.full_size)} px"
            gaps.append((GapReason.SIZE_CHANGED, changed))
        self._size = picture.full_size
        self._send_gaps(place.index, gaps)
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

    def _note_corrupt(self) -> None:
        if self._corrupt:
            self._gaps.append((GapReason.CORRUPT, f"{self._corrupt} packets or frames did not decode: {self._lost}"))
        self._corrupt, self._lost = 0, None

    def _note_missing(self) -> None:
        found = self._index + self._corrupt_in_all
        missing = (self._frames_expected or found) - found
        if self._index and missing > max(2, SHORTFALL_SHARE * self._index):
            said = f"the file breaks off: {self._frames_expected} frames announced, {self._index} decoded"
            self._gaps.append((GapReason.BROKEN_OFF, said))
        elif self._index and missing > 0:
            said = f"{self._frames_expected} frames announced, {self._index} decoded"
            self._gaps.append((GapReason.SHORTFALL, said))


def _open(request: Request) -> InputContainer:
    place, form, options = _way(request)
    container = av.open(
        place,
        format=form,
        container_options=options,
        stream_options=[],
        options={},
        metadata_errors="replace",
    )
    if not container.streams.video:
        container.close()
        raise _NoVideo("it holds no video stream")
    context = container.streams.video[0].codec_context
    try:
        _limit_size(context, request)
    except VideoUnreadable:
        container.close()
        raise
    context.thread_count = request.threads
    return container


def _limit_size(context: VideoCodecContext, request: Request) -> None:
    """Let it decode no picture that is too large.

    Raises:
        VideoUnreadable: It says itself that its pictures are.
    """
    if context.width * context.height > request.pixels_max:
        raise VideoUnreadable(
            f"{request.place}: pictures of {context.width}x{context.height} px are too large, at most "
            f"{request.pixels_max:,} px in all are decoded. Next: make it smaller with a tool you trust"
        )
    context.options = {"max_pixels": str(request.pixels_max)}


def _way(request: Request) -> tuple[str, str | None, dict[str, str]]:
    """What FFmpeg is told to open: the name, the format where it must be told, and options."""
    if request.medium is Medium.FILE:
        return f"file:{request.place}", None, {"protocol_whitelist": "file", "format_whitelist": CONTAINERS}
    if request.medium is Medium.CAMERA:
        return request.place, "v4l2", {"protocol_whitelist": "file"}
    scheme = request.place.partition("://")[0].lower()
    options = {
        "protocol_whitelist": PROTOCOLS[scheme],
        "format_whitelist": LIVE,
        "analyzeduration": str(ANALYSED_US),
        "fpsprobesize": "0",  # the rate is of no use here, and takes frames to learn
    }
    if scheme.startswith("rtsp"):
        # What is lost on the way is sent again, and no firewall is in it; UDP for cameras that know nothing else.
        options["rtsp_flags"] = "prefer_tcp"
    if request.ca_file is not None:
        options |= {"tls_verify": "1", "ca_file": request.ca_file}
    return request.place, None, options


def _read_picture(path: Path, request: Request) -> av.VideoFrame:
    """The file's picture.

    Raises:
        FFmpegError: It does not decode.
        VideoUnreadable: It is too large.
        StopIteration: It holds none.
    """
    form = folder.ENDINGS[path.suffix.lower()]
    options = {"protocol_whitelist": "file"}
    with av.open(f"file:{path}", format=form, container_options=options) as file:
        _limit_size(file.streams.video[0].codec_context, request)
        return next(frame for frame in file.decode(video=0) if not frame.is_corrupt)


def _decoded(container: InputContainer, sender: _Sender, *, is_live: bool) -> Iterator[av.VideoFrame]:
    """Frames in order of presentation; what does not decode is reported to the sender."""
    for packet in _packets(container, sender, is_live=is_live):
        try:
            frames = packet.decode()
        except av.error.EOFError:
            return
        except av.error.FFmpegError as error:
            if not sender.corrupt(_said(error)):
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
                raise _BrokenOff(_said(error)) from error
            if not sender.corrupt(_said(error)):
                return


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _said(error: Exception) -> str:
    return (isinstance(error, av.error.FFmpegError) and error.strerror) or str(error)


def _about(container: InputContainer) -> _About:
    stream = container.streams.video[0]
    context = stream.codec_context
    rate = stream.average_rate or stream.guessed_rate
    duration_us = container.duration
    return _About(
        codec=context.name,
        fps=float(rate) if rate else None,
        frames_expected=stream.frames or None,
        duration_s=duration_us / 1e6 if duration_us and duration_us > 0 else None,
        creation_time=container.metadata.get("creation_time") or stream.metadata.get("creation_time"),
        size=(context.width, context.height),
    )


def _now_us() -> int:
    return time.time_ns() // 1000


def _die_with_parent(stdin: BinaryIO) -> None:
    stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
