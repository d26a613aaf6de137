"""What parent and decoding process tell each other, as bytes on pipes: one request, then messages.

The request is a line of JSON on the decoder's stdin, because an address may hold a password, and a
command line is for everybody to read. A message is a fixed header and a body: raw BGR pixels for a
frame, JSON for the rest. Only numbers, text and pixels cross; nothing is unpickled.

This module decides layout and reads or writes whole messages; it starts no process and knows no decoder.
"""

import json
import struct
from dataclasses import asdict, dataclass
from enum import IntEnum, StrEnum
from typing import Any, Protocol, Self

HEADER = struct.Struct("<2sBxIqIIdQ")
MAGIC = b"VF"


class Medium(StrEnum):
    """What a source of pictures is."""

    FILE = "file"
    """a video file"""
    FOLDER = "folder"
    """a folder of pictures"""
    ADDRESS = "address"
    """a live stream at a URL"""
    CAMERA = "camera"
    """a camera of this machine"""


@dataclass(frozen=True, slots=True)
class Request:
    """What is to be decoded, and how much of it."""

    medium: Medium
    place: str
    """path, URL or device"""
    pixels_max: int
    """largest width times height that is decoded, px"""
    threads: int = 1
    """decoding threads; with more than one, what a corrupt video decodes to may vary"""
    width_max: int | None = None
    height_max: int | None = None
    fps: float | None = None
    queue_frames: int = 1
    """pictures of a live stream that wait for the parent at most"""
    ca_file: str | None = None
    """PEM file of the certificates that who answers over TLS must have, or have been given by; None: any will do"""

    @property
    def is_live(self) -> bool:
        """Whether pictures come when they are taken, and do not wait."""
        return self.medium in (Medium.ADDRESS, Medium.CAMERA)

    def to_line(self) -> bytes:
        """The request as a line of JSON."""
        return json.dumps(asdict(self)).encode() + b"\n"

    @classmethod
    def from_line(cls, line: bytes) -> Self:
        """The request that the line says."""
        content = json.loads(line)
        return cls(**content | {"medium": Medium(content["medium"])})


class Kind(IntEnum):
    """What a message says."""

    INFO = 1
    """the video was opened; JSON: what it says of itself"""
    FRAME = 2
    """a frame; pixels"""
    GAP = 3
    """something is missing or changed; JSON: reason, detail; width and height of frames that have another size"""
    END = 4
    """the video ended; no body"""
    REFUSED = 5
    """the video cannot be opened; JSON: error"""


@dataclass(frozen=True, slots=True)
class Header:
    """What precedes a message's body."""

    kind: Kind
    index: int
    """number of the frame, or of the frame that follows"""
    time_us: int
    width: int
    height: int
    scale: float
    """pixels of the video for one of the frame's"""
    body_bytes: int


class Writable(Protocol):
    """Where messages go: a pipe or a buffer that takes all bytes it is given."""

    def write(self, data: Any, /) -> Any:
        """Write all of the data."""
        ...


def pack(header: Header) -> bytes:
    """The header's bytes."""
    numbers = (header.index, header.time_us, header.width, header.height, header.scale, header.body_bytes)
    return HEADER.pack(MAGIC, header.kind, *numbers)


def unpack(data: bytes) -> Header:
    """The header that the bytes hold.

    Raises:
        ValueError: They hold none.
    """
    magic, kind, *numbers = HEADER.unpack(data)
    if magic != MAGIC:
        raise ValueError(f"a message begins with {MAGIC!r}, got {magic!r}")
    return Header(Kind(kind), *numbers)


def write_json(out: Writable, kind: Kind, index: int = 0, **content: Any) -> None:
    """Send a message that holds text and numbers."""
    body = json.dumps(content).encode()
    out.write(pack(Header(kind, index, 0, 0, 0, 1.0, len(body))))
    out.write(body)
