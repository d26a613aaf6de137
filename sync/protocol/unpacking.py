"""What payloads declare to unpack to, seen before any is unpacked.

Contract: no payload is decoded whose frame declares more than a segment may hold, nor any of a body that together
declare more than `UNPACKED_BYTES_MAX`: a small body must not cost central gigabytes, not one after the other either.
A frame that declares nothing counts as the largest; what it really holds is bounded when it is decoded.

Source: RFC 8878, section 3.1.1 (frame header).
"""

from collections.abc import Iterable

import zstandard

from events import Segment
from events.segment import PAYLOAD_MAX_BYTES
from sync.errors import Refusal

UNPACKED_BYTES_MAX = 2**30
"""Most bytes that the payloads of one body may declare to unpack to."""


def check_unpacked(segments: Iterable[Segment], bytes_max: int = UNPACKED_BYTES_MAX) -> None:
    """Nothing, if the payloads together declare to be no more than may be unpacked.

    Raises:
        Refusal: They are more.
    """
    declared = sum(min(unpacked_bytes(segment.payload), PAYLOAD_MAX_BYTES + 1) for segment in segments)
    if declared > bytes_max:
        raise Refusal(
            413,
            "too_much_unpacked",
            "the payloads unpack to more than a body may hold",
            f"{declared} bytes declared",
            f"at most {bytes_max} bytes",
            "send fewer segments at a time",
        )


def unpacked_bytes(payload: bytes) -> int:
    """What the payload's frame declares; the most of a segment where it does not say, 0 where it is no frame."""
    try:
        declared = zstandard.frame_content_size(payload)
    except zstandard.ZstdError:
        return 0  # Whoever decodes it says what it is.
    return PAYLOAD_MAX_BYTES if declared < 0 else int(declared)
