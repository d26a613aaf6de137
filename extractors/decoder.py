"""The decoding process: `python -m extractors.decoder PATH`, one video to messages on stdout.

Contract: sends INFO or REFUSED first, then FRAME and GAP in order of presentation, then END. It dies
with its parent: stdin is a pipe that the parent holds and never writes to, and its end ends this
process, wherever the decoder is at that moment. It runs alone because a decoder fed with a hostile
file may crash; the parent (`extractors.video`) survives that and says so.

It decides nothing about what a gap means, and keeps at most one frame.
"""

import os
import sys
import threading
from collections.abc import Iterator
from fractions import Fraction
from typing import Any, BinaryIO

import av
import av.error
import numpy as np
from av.container import InputContainer
from av.video.reformatter import VideoReformatter

from extractors.media import GapReason
from extractors.wire import Header, Kind, Writable, pack, write_json

CONTAINERS = (
    "asf,avi,av1,dv,flv,gif,h264,hevc,ivf,m4v,matroska,webm,mjpeg,mov,mp4,mpeg,mpegts,mpegvideo,mxf,nut,obu,"
    "ogg,rm,vc1,yuv4mpegpipe"
)
"""Formats that are opened. Without a list FFmpeg takes any text file for a terminal recording, and
plays lists that name other files and addresses."""

WITHOUT_PRESENTATION_TIMES = ("avi",)
"""Formats that store frames in decoding order and no presentation times; what FFmpeg reports as
such is not even monotone. Their decoding times, which are the frames' numbers, are used instead."""

SHORTFALL_SHARE = 0.02
"""Missing frames up to this share of the container's count are a shortfall; more is a broken-off file."""

JUMP_MAX_S = 3600
"""A longer pause between two frames is taken for a corrupt time, s."""

PACKETS_CORRUPT_MAX = 1_000
"""Corrupt packets in a row after which the rest is given up."""


def main() -> None:
    """Decode the video named on the command line."""
    path, pixels_max, threads = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    threading.Thread(target=_die_with_parent, args=(sys.stdin.buffer,), daemon=True).start()
    try:
        send_video(path, sys.stdout.buffer, pixels_max=pixels_max, threads=threads)
        sys.stdout.buffer.flush()
    except BrokenPipeError:
        os._exit(0)  # the parent wants no more frames
    os._exit(0)  # destructors of a decoder that met hostile data had better not run


def send_video(path: str, out: Writable, *, pixels_max: int, threads: int = 1) -> None:
    """Write the video's messages to `out`.

    Args:
        path: A file.
        out: Where the messages go.
        pixels_max: Largest width times height that is decoded.
        threads: Decoding threads. With more than one, what a corrupt video decodes to may vary.
    """
    try:
        container = _open(path, pixels_max, threads)
    except (av.error.FFmpegError, _NoVideo) as error:
        write_json(out, Kind.REFUSED, error=_said(error))
        return
    with container:
        stream = container.streams.video[0]
        write_json(out, Kind.INFO, **_info(container))
        sender = _Sender(out, _Clock(container), stream.frames or None)
        for frame in _decoded(container, sender):
            sender.send(frame)
        sender.end()


class _NoVideo(Exception):
    """The file opens, and holds no video stream."""


class _Clock:
    """Presentation times in µs from the first frame, strictly increasing, whatever the file says."""

    def __init__(self, container: InputContainer) -> None:
        stream = container.streams.video[0]
        rate = stream.average_rate or stream.guessed_rate or Fraction(25)
        self._nominal_s = 1 / Fraction(rate)
        self._is_decoding_time = container.format.name in WITHOUT_PRESENTATION_TIMES
        self._offset_s: Fraction | None = None
        self._last_s: Fraction | None = None

    def time_us(self, frame: av.VideoFrame) -> tuple[int, bool]:
        """The frame's time, and whether the video's own clock stood, went back or leapt before it."""
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
        return round(time_s * 1_000_000), has_jumped


class _Sender:
    """Numbers frames, notes gaps, and writes both."""

    def __init__(self, out: Writable, clock: _Clock, frames_expected: int | None) -> None:
        self._out = out
        self._clock = clock
        self._frames_expected = frames_expected
        self._reformatter = VideoReformatter()
        self._size: tuple[int, int] | None = None
        self._corrupt = 0  # since the last frame
        self._corrupt_in_all = 0
        self._lost: str | None = None
        self.index = 0

    def corrupt(self, detail: str) -> bool:
        """Note a packet or frame that does not decode; whether there is still hope."""
        self._corrupt += 1
        self._corrupt_in_all += 1
        self._lost = self._lost or detail
        return self._corrupt < PACKETS_CORRUPT_MAX

    def send(self, frame: av.VideoFrame) -> None:
        self._flush_corrupt()
        time_us, has_jumped = self._clock.time_us(frame)
        if has_jumped:
            self._gap(GapReason.TIME_JUMPED, "the video's clock jumped; times go on from the last frame")
        size = (frame.width, frame.height)
        if self._size is not None and self._size != size:
            self._gap(GapReason.SIZE_CHANGED, f"the frame size changed from {_times(self._size)} to {_times(size)} px")
        self._size = size
        bgr = self._reformatter.reformat(frame, format="bgr24", threads=1).to_ndarray()
        image = np.ascontiguousarray(bgr)
        self._out.write(pack(Header(Kind.FRAME, self.index, time_us, *size, image.nbytes)))
        self._out.write(image.data.cast("B"))
        self.index += 1

    def end(self) -> None:
        self._flush_corrupt()
        found = self.index + self._corrupt_in_all
        missing = (self._frames_expected or found) - found
        if self.index and missing > max(2, SHORTFALL_SHARE * self.index):
            self._gap(
                GapReason.BROKEN_OFF,
                f"the file breaks off: {self._frames_expected} frames announced, {self.index} decoded",
            )
        elif self.index and missing > 0:
            self._gap(GapReason.SHORTFALL, f"{self._frames_expected} frames announced, {self.index} decoded")
        write_json(self._out, Kind.END, self.index)

    def _flush_corrupt(self) -> None:
        if self._corrupt:
            self._gap(GapReason.CORRUPT, f"{self._corrupt} packets or frames did not decode: {self._lost}")
        self._corrupt, self._lost = 0, None

    def _gap(self, reason: GapReason, detail: str) -> None:
        write_json(self._out, Kind.GAP, self.index, reason=reason, detail=detail)


def _open(path: str, pixels_max: int, threads: int) -> InputContainer:
    container = av.open(
        f"file:{path}",
        container_options={"protocol_whitelist": "file", "format_whitelist": CONTAINERS},
        stream_options=[],
        options={},
        metadata_errors="replace",
    )
    if not container.streams.video:
        container.close()
        raise _NoVideo("the file holds no video stream")
    context = container.streams.video[0].codec_context
    context.thread_count = threads
    context.options = {"max_pixels": str(pixels_max)}
    return container


def _decoded(container: InputContainer, sender: _Sender) -> Iterator[av.VideoFrame]:
    """Frames in order of presentation; what does not decode is reported to the sender."""
    for packet in _packets(container, sender):
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


def _packets(container: InputContainer, sender: _Sender) -> Iterator["av.Packet[Any]"]:
    """Packets as the file has them; the last one is empty, and makes the decoder give what it still holds."""
    stream = container.streams.video[0]
    while True:
        try:
            yield from container.demux(stream)
            return
        except av.error.FFmpegError as error:
            if not sender.corrupt(_said(error)):
                return


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _said(error: Exception) -> str:
    return (isinstance(error, av.error.FFmpegError) and error.strerror) or str(error)


def _info(container: InputContainer) -> dict[str, Any]:
    stream = container.streams.video[0]
    context = stream.codec_context
    rate = stream.average_rate or stream.guessed_rate
    duration_us = container.duration
    return {
        "width": context.width,
        "height": context.height,
        "fps": float(rate) if rate else None,
        "frames_expected": stream.frames or None,
        "duration_s": duration_us / 1e6 if duration_us and duration_us > 0 else None,
        "codec": context.name,
        "creation_time": container.metadata.get("creation_time") or stream.metadata.get("creation_time"),
    }


def _die_with_parent(stdin: BinaryIO) -> None:
    stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
