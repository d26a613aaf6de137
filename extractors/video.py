"""Videos in: what a file is, and its frames with exact times and recorded gaps.

Contract: `frames` yields every frame that decodes, in order of presentation, with a `Gap` at each
place where something is missing or changed. A file that breaks off gives all frames before the break
and then a gap; a decoder that crashes gives all frames before the crash and then `DecoderDied`.
Decoding happens in a process of its own (`extractors.decoder`), which never outlives this one; at most
a pipe's buffer of frames is under way. Nothing is retried here.

Source of the choice of decoder: docs/decisions/0006-video-decoding.md.
"""

import contextlib
import fcntl
import hashlib
import json
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

import numpy as np

from extractors.errors import DecoderDied, DecoderStalled, VideoHasNoFrames, VideoUnreadable
from extractors.media import Frame, Gap, GapReason, VideoInfo
from extractors.wire import HEADER, Header, Kind, unpack

PIPE_BYTES = 1024 * 1024
"""The kernel's buffer between decoder and reader; Linux allows this much without privilege."""


@dataclass(frozen=True, slots=True)
class DecodeLimits:
    """How much a decoder may take."""

    pixels_max: int = 8192 * 4320
    """largest width times height of a frame, px"""
    stall_s: float = 60.0
    """longest silence of the decoder while a frame is wanted, s"""
    threads: int = 1
    """decoding threads; with more than one, what a corrupt video decodes to may vary"""


def probe(path: Path, limits: DecodeLimits | None = None) -> VideoInfo:
    """What the file says of itself.

    Raises:
        VideoUnreadable: It is not a video that can be opened.
        DecoderDied: It crashed the decoder.
    """
    digest = _digest(path)
    with _Decoder(path, limits or DecodeLimits()) as decoder:
        content = decoder.info()
    return VideoInfo(sha256=digest, **(content | {"creation_time": _utc(content["creation_time"])}))


def frames(path: Path, limits: DecodeLimits | None = None) -> Iterator[Frame | Gap]:
    """The file's frames and gaps, in order of presentation.

    Raises:
        VideoUnreadable: It is not a video that can be opened.
        VideoHasNoFrames: Not one frame of it decodes.
        DecoderDied: It crashed the decoder; all frames before that were yielded.
        DecoderStalled: The decoder said nothing for `stall_s`; all frames before that were yielded.
    """
    _check_file(path)
    with _Decoder(path, limits or DecodeLimits()) as decoder:
        decoder.info()
        yield from decoder.media()


class _Decoder:
    """The decoding process and the messages it sends."""

    def __init__(self, path: Path, limits: DecodeLimits) -> None:
        self._path = path
        self._limits = limits
        self._frames = 0
        self._gaps: list[Gap] = []

    def __enter__(self) -> Self:
        self._complaints: IO[bytes] = tempfile.TemporaryFile()
        limits = (str(self._limits.pixels_max), str(self._limits.threads))
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "extractors.decoder", str(self._path.absolute()), *limits],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._complaints,
            bufsize=0,
            start_new_session=True,  # Ctrl-C is for this process; the decoder ends with it anyway
        )
        assert self._process.stdout is not None
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
        """What the video says of itself; the first message."""
        header = self._header()
        content = self._json(header)
        if header.kind is Kind.REFUSED:
            raise VideoUnreadable(
                f"{self._path}: not a video that can be opened ({content['error']}); wanted MP4, AVI, MKV, "
                "MPEG-TS, GIF or the like, whole to its index. Next: ffprobe says more; copy the file again"
            )
        return content

    def media(self) -> Iterator[Frame | Gap]:
        """Frames and gaps up to the end."""
        while (header := self._header()).kind is not Kind.END:
            if header.kind is Kind.FRAME:
                yield self._frame(header)
            else:
                yield self._gap(header)
        if not self._frames:
            said = "; ".join(str(gap) for gap in self._gaps) or "it is empty"
            raise VideoHasNoFrames(f"{self._path}: not one frame decodes: {said}. Next: try another copy of it")

    def _frame(self, header: Header) -> Frame:
        image = np.empty((header.height, header.width, 3), np.uint8)
        if image.nbytes != header.body_bytes:
            raise self._died(f"sent {header.body_bytes} bytes for a frame of {image.nbytes}")
        self._read_into(image.data.cast("B"))
        self._frames += 1
        return Frame(header.index, header.time_us, image)

    def _gap(self, header: Header) -> Gap:
        content = self._json(header)
        gap = Gap(header.index, GapReason(content["reason"]), content["detail"])
        self._gaps = [*self._gaps[-4:], gap]
        return gap

    def _header(self) -> Header:
        data = bytearray(HEADER.size)
        self._read_into(memoryview(data))
        try:
            header = unpack(bytes(data))
        except ValueError as error:
            raise self._died(f"sent what is no message ({error})") from error
        bytes_max = 3 * self._limits.pixels_max
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
            if not self._wakeup.poll(self._limits.stall_s * 1000):
                raise DecoderStalled(
                    f"{self._path}: the decoder said nothing for {self._limits.stall_s:g} s after "
                    f"{self._last_frame()}. Next: raise stall_s, or cut the video before that place"
                )
            count = self._pipe.readinto(buffer[got:])  # type: ignore[attr-defined]  # buffered
            if not count:
                raise self._died(self._how_it_ended())
            got += count

    def _how_it_ended(self) -> str:
        code = self._process.wait()
        if code < 0:
            return f"was ended by signal {signal.Signals(-code).name}"
        return f"ended with exit code {code}"

    def _died(self, how: str) -> DecoderDied:
        said = _last_line(self._complaints)
        return DecoderDied(
            f"{self._path}: the decoder {how}{f' ({said})' if said else ''} after {self._last_frame()}; "
            "all frames before that were given. Next: re-encode the video with a tool you trust"
        )

    def _last_frame(self) -> str:
        return f"frame {self._frames - 1}" if self._frames else "no frame at all"


def _check_file(path: Path) -> None:
    """Whether the path is a file that can be read and is not empty.

    Raises:
        VideoUnreadable: It is not.
    """
    if path.is_dir():
        raise VideoUnreadable(f"{path}: is a directory, wanted a video file")
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise VideoUnreadable(f"{path}: the file is empty, wanted a video")
    except FileNotFoundError as error:
        raise VideoUnreadable(f"{path}: no such file. Next: check the name") from error
    except PermissionError as error:
        raise VideoUnreadable(f"{path}: no permission to read it. Next: chmod +r {path}") from error
    except OSError as error:
        raise VideoUnreadable(f"{path}: cannot be read: {error.strerror}") from error


def _digest(path: Path) -> str:
    _check_file(path)
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _utc(text: str | None) -> datetime | None:
    """The time as the container wrote it, in UTC; None where it is none."""
    if not text:
        return None
    try:
        time = datetime.fromisoformat(text)
    except ValueError:
        return None
    try:
        return time.replace(tzinfo=UTC) if time.tzinfo is None else time.astimezone(UTC)
    except OverflowError:
        return None


def _last_line(file: IO[bytes]) -> str:
    """The last line of what was written to the file, at most 200 characters."""
    size = file.seek(0, 2)
    file.seek(max(0, size - 2000))
    lines = file.read().decode(errors="replace").split("\n")
    return next((line.strip()[:200] for line in reversed(lines) if line.strip()), "")
