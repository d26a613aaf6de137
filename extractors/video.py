"""Recordings in: what a file or folder of pictures is, and its frames with exact times and recorded gaps.

Contract: `frames` yields every frame that decodes, in order of presentation, with a `Gap` at each
place where something is missing or changed. A file that breaks off gives all frames before the break
and then a gap; a decoder that crashes gives all frames before the crash and then `DecoderDied`.
Decoding happens in a process of its own (`extractors.decoding`), which never outlives this one; at most
a pipe's buffer of frames is under way. Nothing is retried here.

Source of the choice of decoder: docs/decisions/0006-video-decoding.md.
"""

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from extractors import folder
from extractors.decoding import Decoding
from extractors.errors import VideoHasNoFrames, VideoUnreadable
from extractors.media import Frame, Gap, Shape, VideoInfo
from extractors.wire import Medium, Request


@dataclass(frozen=True, slots=True)
class DecodeLimits:
    """How much a decoder may take."""

    pixels_max: int = 8192 * 4320
    """largest width times height of a frame, px"""
    stall_s: float = 60.0
    """longest silence of the decoder while a frame is wanted, s"""
    threads: int = 1
    """decoding threads; with more than one, what a corrupt video decodes to may vary"""


def probe(path: Path, limits: DecodeLimits | None = None, shape: Shape | None = None) -> VideoInfo:
    """What the file or folder says of itself.

    Raises:
        VideoUnreadable: It is not a video that can be opened.
        DecoderDied: It crashed the decoder.
    """
    sha256 = digest(path)
    with _decoding(path, limits, shape) as decoding:
        content = decoding.info()
    del content["first_us"]  # 0: media time begins with the first frame
    return VideoInfo(sha256=sha256, **(content | {"creation_time": utc(content["creation_time"])}))


def frames(path: Path, limits: DecodeLimits | None = None, shape: Shape | None = None) -> Iterator[Frame | Gap]:
    """The frames and gaps of a file or a folder of pictures, in order of presentation.

    Raises:
        VideoUnreadable: It is not a video that can be opened.
        VideoHasNoFrames: Not one frame of it decodes.
        DecoderDied: It crashed the decoder; all frames before that were yielded.
        DecoderStalled: The decoder said nothing for `stall_s`; all frames before that were yielded.
    """
    _check(path)
    gaps: list[Gap] = []
    with _decoding(path, limits, shape) as decoding:
        decoding.info()
        for item in decoding.media():
            if isinstance(item, Gap):
                gaps = [*gaps[-4:], item]
            yield item
        if not decoding.frames:
            said = "; ".join(str(gap) for gap in gaps) or "it is empty"
            raise VideoHasNoFrames(f"{path}: not one frame decodes: {said}. Next: try another copy of it")


def _decoding(path: Path, limits: DecodeLimits | None, shape: Shape | None) -> Decoding:
    limits, shape = limits or DecodeLimits(), shape or Shape()
    request = Request(
        Medium.FOLDER if path.is_dir() else Medium.FILE,
        str(path.absolute()),
        pixels_max=limits.pixels_max,
        threads=limits.threads,
        width_max=shape.width_max,
        height_max=shape.height_max,
        fps=shape.fps,
    )
    return Decoding(request, name=str(path), stall_s=limits.stall_s)


def _check(path: Path) -> None:
    """Whether the path is a folder, or a file that can be read and is not empty.

    Raises:
        VideoUnreadable: It is not.
    """
    if path.is_dir():
        return
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


def digest(path: Path) -> str:
    """SHA-256 of the file's bytes, or of the names and bytes of the folder's pictures, hexadecimal.

    Raises:
        VideoUnreadable: It cannot be read.
    """
    _check(path)
    if path.is_dir():
        return folder.digest(folder.pictures_in(path))
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def utc(text: str | None) -> datetime | None:
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
