"""The messages that the decoding process sends to its parent, as bytes on a pipe.

A message is a fixed header and a body: raw BGR pixels for a frame, JSON for the rest. Only numbers,
text and pixels cross; nothing is unpickled. This module decides layout and reads or writes whole
messages; it starts no process and knows no decoder.
"""

import json
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

HEADER = struct.Struct("<2sBxIqIIQ")
MAGIC = b"VF"


class Kind(IntEnum):
    """What a message says."""

    INFO = 1
    """the video was opened; JSON: what it says of itself"""
    FRAME = 2
    """a frame; pixels"""
    GAP = 3
    """something is missing or changed; JSON: reason, detail"""
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
    body_bytes: int


class Writable(Protocol):
    """Where messages go: a pipe or a buffer that takes all bytes it is given."""

    def write(self, data: Any, /) -> Any:
        """Write all of the data."""
        ...


def pack(header: Header) -> bytes:
    """The header's bytes."""
    return HEADER.pack(MAGIC, header.kind, header.index, header.time_us, header.width, header.height, header.body_bytes)


def unpack(data: bytes) -> Header:
    """The header that the bytes hold.

    Raises:
        ValueError: They hold none.
    """
    magic, kind, index, time_us, width, height, body_bytes = HEADER.unpack(data)
    if magic != MAGIC:
        raise ValueError(f"a message begins with {MAGIC!r}, got {magic!r}")
    return Header(Kind(kind), index, time_us, width, height, body_bytes)


def write_json(out: Writable, kind: Kind, index: int = 0, **content: Any) -> None:
    """Send a message that holds text and numbers."""
    body = json.dumps(content).encode()
    out.write(pack(Header(kind, index, 0, 0, 0, len(body))))
    out.write(body)
