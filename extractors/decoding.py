"""The decoding process from its parent's side: starts it, asks it, reads its messages, ends it.

Contract: used as a context manager, `info` once, then `media` once. The process never outlives the
block. It holds what was sent to the pipe and no more. What it wrote to stderr is part of the error that
tells its end, without what `redact` takes out.
"""

import contextlib
import fcntl
import json
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from extractors.errors import DecoderDied, DecoderStalled, Stopped, VideoUnreadable
from extractors.media import Frame, Gap, GapReason
from extractors.wire import HEADER, Header, Kind, Medium, Request, unpack

PIPE_BYTES = 1024 * 1024
"""The kernel's buffer between decoder and reader; Linux allows this much without privilege."""

LOOK_S = 0.25
"""While nothing comes, it is asked so often whether to stop, s."""

_WANTED = {
    Medium.FILE: "wanted MP4, AVI, MKV, MPEG-TS, GIF or the like, whole to its index. "
    "Next: ffprobe says more; copy the file again",
    Medium.FOLDER: "wanted a folder of pictures. Next: look at the first of them",
    Medium.ADDRESS: "wanted a live stream (RTSP; or MJPEG, MPEG-TS or the like over HTTP). Next: try the address "
    "in a player; is the camera on, the path right, the login needed?",
    Medium.CAMERA: "wanted a camera of this machine. Next: ls -l /dev/video*; is it plugged in, may this user read it?",
}


class Decoding:
    """A decoding process and the messages it sends."""

    def __init__(
        self,
        request: Request,
        *,
        name: str,
        stall_s: float,
        redact: Callable[[str], str] = str,
        is_stopped: Callable[[], bool] = lambda: False,
    ) -> None:
        """Prepare it; entering the block starts it.

        Args:
            request: What to decode.
            name: What people call it.
            stall_s: Longest silence while a message is wanted, s.
            redact: Takes out of a text what nobody should read.
            is_stopped: Asked while nothing comes.
        """
        self._request = request
        self._name = name
        self.stall_s = stall_s
        """longest silence while a message is wanted, s"""
        self._redact = redact
        self._is_stopped = is_stopped
        self.frames = 0
        """frames read so far"""
        self.error: str | None = None
        """how a live stream ended, once it has; None: in order"""

    def __enter__(self) -> Self:
        self._complaints: IO[bytes] = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "extractors.decoder"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for this process; the decoder ends with it anyway
        )
        assert self._process.stdout is not None
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # then it died, which reading says
            self._process.stdin.write(self._request.to_line())
        self._pipe = self._process.stdout
        self._wakeup = select.poll()
        self._wakeup.register(self._pipe, select.POLLIN | select.POLLHUP)
        with contextlib.suppress(OSError):  # a smaller buffer is slower, nothing else
            fcntl.fcntl(self._pipe, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout, self._complaints):
            if stream is not None:
                stream.close()

    def info(self) -> dict[str, Any]:
        """What the source says of itself; the first message.

        Raises:
            VideoUnreadable: It cannot be opened.
            DecoderDied: The process ended.
            DecoderStalled: It said nothing for `stall_s`.
            Stopped: The caller wants no more.
        """
        header = self._header()
        content = self._json(header)
        if header.kind is Kind.REFUSED:
            said = self._redact(content["error"])
            if "Next: " in said:
                raise VideoUnreadable(said)
            kind = "live stream" if self._request.is_live else "video"
            ca_file = self._request.ca_file
            vouched = f"; does {ca_file} hold its certificate, and the certificate its name?" if ca_file else ""
            raise VideoUnreadable(
                f"{self._name}: not a {kind} that can be opened ({said}); {_WANTED[self._request.medium]}{vouched}"
            )
        return content

    def media(self) -> Iterator[Frame | Gap]:
        """Frames and gaps up to the end."""
        while (header := self._header()).kind is not Kind.END:
            if header.kind is Kind.FRAME:
                yield self._frame(header)
            else:
                yield self._gap(header)
        error = self._json(header)["error"]
        self.error = None if error is None else self._redact(error)

    def _frame(self, header: Header) -> Frame:
        image = np.empty((header.height, header.width, 3), np.uint8)
        if image.nbytes != header.body_bytes:
            raise self._died(f"sent {header.body_bytes} bytes for a frame of {image.nbytes}")
        self._read_into(image.data.cast("B"))
        self.frames += 1
        self._last_index = header.index
        return Frame(header.index, header.time_us, image, header.scale)

    def _gap(self, header: Header) -> Gap:
        content = self._json(header)
        size = (int(content["width"]), int(content["height"])) if "width" in content else None
        return Gap(header.index, GapReason(content["reason"]), self._redact(content["detail"]), size=size)

    def _header(self) -> Header:
        data = bytearray(HEADER.size)
        self._read_into(memoryview(data))
        try:
            header = unpack(bytes(data))
        except ValueError as error:
            raise self._died(f"sent what is no message ({error})") from error
        bytes_max = 3 * self._request.pixels_max
        if header.body_bytes > bytes_max:
            raise self._died(f"announced {header.body_bytes} bytes, at most {bytes_max} are allowed")
        return header

    def _json(self, header: Header) -> dict[str, Any]:
        data = bytearray(header.body_bytes)
        self._read_into(memoryview(data))
        content: dict[str, Any] = json.loads(data)
        return content

    def _read_into(self, buffer: memoryview) -> None:
        got = 0
        while got < len(buffer):
            self._await_bytes()
            count = self._pipe.readinto(buffer[got:])  # type: ignore[attr-defined]  # buffered
            if not count:
                raise self._died(self._how_it_ended())
            got += count

    def _await_bytes(self) -> None:
        waits = max(1, round(self.stall_s / LOOK_S))
        for _ in range(waits):
            if self._is_stopped():
                raise Stopped(f"{self._name}: stopped before its first picture came")
            if self._wakeup.poll(self.stall_s / waits * 1000):
                return
        next_step = (
            "Next: is the camera on, and the network?"
            if self._request.is_live
            else "Next: raise stall_s, or cut the video before that place"
        )
        raise DecoderStalled(
            f"{self._name}: the decoder said nothing for {self.stall_s:g} s after {self._last_frame()}. {next_step}"
        )

    def _how_it_ended(self) -> str:
        code = self._process.wait()
        if code < 0:
            return f"was ended by signal {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def _died(self, how: str) -> DecoderDied:
        said = self._redact(_last_line(self._complaints))
        next_step = "look at it in a player" if self._request.is_live else "re-encode the video with a tool you trust"
        return DecoderDied(
            f"{self._name}: the decoder {how}{f' ({said})' if said else ''} after {self._last_frame()}; "
            f"all frames before that were given. Next: {next_step}"
        )

    def _last_frame(self) -> str:
        return f"frame {self._last_index}" if self.frames else "no frame at all"


def _last_line(file: IO[bytes]) -> str:
    """The last line of what was written to the file, at most 200 characters."""
    size = file.seek(0, 2)
    file.seek(max(0, size - 2000))
    lines = file.read().decode(errors="replace").split("\n")
    return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "")
