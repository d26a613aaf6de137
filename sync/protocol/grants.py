"""Grants: which token speaks for which station.

Contract: central keeps SHA-256 hashes only. A token speaks for one station; comparing takes the same
time whichever station it is, and whether there is one. A token is a secret of at least 128 random
bits (`secrets.token_urlsafe(32)`), which is why a plain hash is enough.
"""

import hashlib
import hmac
import re
from collections.abc import Mapping
from typing import Protocol

from events import InvalidName, Station, station_name
from sync.errors import GrantError

_HASH = re.compile(r"[0-9a-f]{64}")
_TOKEN = re.compile(r"[\x21-\x7e]{16,512}")


class Grantor(Protocol):
    """Who knows the tokens that central accepts now."""

    def station_of(self, token: str) -> Station | None:
        """The station for which the token speaks; None if there is none. Does not raise; asked for every request."""


class Grants:
    """The tokens that central accepts.

    Args:
        token_hashes: For each station the SHA-256 of its token (`token_hash`), 64 hexadecimal digits.

    Raises:
        GrantError: A name or a hash is malformed, or two stations share one token.
    """

    def __init__(self, token_hashes: Mapping[str, str]) -> None:
        self._stations: dict[bytes, Station] = {}
        for name, digits in token_hashes.items():
            try:
                station = station_name(name)
            except InvalidName as error:
                raise GrantError(f"grants: {error}") from error
            if not _HASH.fullmatch(digits):
                raise GrantError(
                    f"the grant of station {station} must be the SHA-256 of its token, 64 hexadecimal digits in lower "
                    f"case, got {len(digits)} characters"
                )
            other = self._stations.setdefault(bytes.fromhex(digits), station)
            if other != station:
                raise GrantError(f"stations {other} and {station} share one token; give each its own")

    def stations(self) -> list[Station]:
        """The stations that have a token, by name."""
        return sorted(self._stations.values())

    def station_of(self, token: str) -> Station | None:
        """The station for which the token speaks; None if there is none."""
        digest = hashlib.sha256(token.encode()).digest()
        found: Station | None = None
        for granted, station in self._stations.items():
            if hmac.compare_digest(granted, digest):
                found = station
        return found


def token_hash(token: str) -> str:
    """SHA-256 of the token in hexadecimal, as central keeps it.

    Raises:
        GrantError: The token is too short or cannot travel in an HTTP header.
    """
    return hashlib.sha256(checked_token(token).encode()).hexdigest()


def checked_token(token: str) -> str:
    """The token.

    Raises:
        GrantError: It is too short or cannot travel in an HTTP header.
    """
    if not _TOKEN.fullmatch(token):
        raise GrantError(
            f"a token must be 16 to 512 visible ASCII characters without spaces, got {len(token)} characters. "
            "Next: make one with python -c 'import secrets; print(secrets.token_urlsafe(32))'"
        )
    return token
