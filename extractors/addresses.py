"""Where pictures come from, as people write it: a path, an address, or the number of a camera.

An address may hold a password. `Address.shown` is what may be printed and stored: without user, password
and query, which many cameras take for a login; `Address.redacted` cleans what others said of it.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from urllib.parse import SplitResult, quote, unquote, urlsplit

from extractors.errors import BadAddress
from extractors.wire import Medium

SCHEMES = ("rtsp", "rtsps", "http", "https")
"""Protocols of live streams."""
HIDDEN = "***"


@dataclass(frozen=True, slots=True)
class Address:
    """A live stream: a URL, or a camera of this machine."""

    medium: Medium
    place: str = field(repr=False)
    """what is opened; may hold a password"""

    @property
    def shown(self) -> str:
        """The address without what nobody should read: user, password, query and fragment."""
        if self.medium is Medium.CAMERA:
            return self.place
        parts = urlsplit(self.place)
        return f"{parts.scheme}://{_host(parts)}{parts.path}"

    @property
    def is_over_tls(self) -> bool:
        """Whether the way there is encrypted."""
        return self.place.partition("://")[0].lower() in ("rtsps", "https")

    def redacted(self, text: str) -> str:
        """The text without the login, wherever it stands in it."""
        if self.medium is Medium.CAMERA:
            return text
        parts = urlsplit(self.place)
        text = text.replace(self.place, self.shown)
        secrets = {parts.query, parts.password, unquote(parts.password or ""), parts.netloc.rpartition("@")[0]}
        for secret in sorted((each for each in secrets if each), key=len, reverse=True):
            text = text.replace(secret, HIDDEN)
        return text

    def with_login(self, login: str) -> "Address":
        """The same address, to be opened as `user:password`.

        Raises:
            BadAddress: It is no login, or the address has none.
        """
        user, colon, password = login.strip().partition(":")
        if self.medium is Medium.CAMERA or not user or not colon or "\n" in password:
            raise BadAddress(
                f"{self.shown}: a login is one line `user:password` for an address of {', '.join(SCHEMES)}"
            )
        parts = urlsplit(self.place)
        netloc = f"{quote(user, safe='')}:{quote(password, safe='')}@{_host(parts)}"
        return replace(self, place=parts._replace(netloc=netloc).geturl())


def parsed(text: str) -> Path | Address:
    """The source that the text names: digits are a camera of this machine, `scheme://` is an address.

    >>> parsed("rtsp://user:secret@camera.example/1").shown
    'rtsp://camera.example/1'
    >>> parsed("0").shown
    '/dev/video0'

    Raises:
        BadAddress: An address of a protocol that is not read, or without a host.
    """
    if text.isascii() and text.isdigit():
        return Address(Medium.CAMERA, f"/dev/video{int(text)}")
    scheme, mark, _ = text.partition("://")
    if not mark:
        return Path(text)
    address = Address(Medium.ADDRESS, text)
    try:
        parts = urlsplit(text)
        is_whole = bool(parts.hostname) and (parts.port or 1) > 0
    except ValueError:
        is_whole = False
    if scheme.lower() not in SCHEMES or not is_whole:
        raise BadAddress(
            f"an address must be {', '.join(f'{each}://host/...' for each in SCHEMES)}, got one of {scheme!r}"
            f"{'' if is_whole else ' without a host that can be read'}. Next: correct it, or give a file"
        )
    return address


def _host(parts: SplitResult) -> str:
    return parts.netloc.rpartition("@")[2]
