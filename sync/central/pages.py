"""Where a question goes on: the key of the last row that was given, sealed by central.

Contract: `opened(sealed(key))` is the key. What central did not seal, or sealed for another station or another
question, is refused. A key gives nobody more than the question itself does: each page is checked like the first.
"""

import base64
import binascii
import hashlib
import hmac
import json
from dataclasses import dataclass
from typing import Any

from events import Station
from sync.errors import Refusal

_MAC_BYTES = 16


@dataclass(frozen=True, slots=True)
class Pages:
    """What seals and opens keys.

    Args:
        secret: Central's own; at least 32 bytes. Pages hold as long as it stays the same.
    """

    secret: bytes

    def sealed(self, station: Station, question: str, key: list[Any]) -> str:
        """The key as an opaque text, for this station and question."""
        text = json.dumps(key, separators=(",", ":")).encode()
        return base64.urlsafe_b64encode(self._mac(station, question, text) + text).decode()

    def opened(self, station: Station, question: str, page: str) -> list[Any]:
        """The key.

        Raises:
            Refusal: Central has not sealed it for this station and question.
        """
        try:
            data = base64.b64decode(page, altchars=b"-_", validate=True)
        except (binascii.Error, ValueError):
            data = b""
        mac, text = data[:_MAC_BYTES], data[_MAC_BYTES:]
        if not hmac.compare_digest(mac, self._mac(station, question, text)):
            raise Refusal(
                422,
                "unknown_page",
                "that page is not of this question, of this station, or of the central that runs now",
                page,
                "`next` of an answer to the same question",
                "ask again from the first page",
            )
        key: list[Any] = json.loads(text)
        return key

    def _mac(self, station: Station, question: str, text: bytes) -> bytes:
        parts = (station.encode(), question.encode(), text)
        message = b"".join(len(part).to_bytes(8, "big") + part for part in parts)
        return hmac.digest(self.secret, message, hashlib.sha256)[:_MAC_BYTES]
