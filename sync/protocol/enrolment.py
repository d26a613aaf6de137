"""Enrolment: a one-time code takes a station in, and tells it which central it talks to.

Contract: a code holds a secret of 96 random bits and, where central made its own certificate, the pin of
that certificate's key, so that what the station first connects to is what the operator meant. A slip of the
pen in a code is noticed at the station. The station proves that it has the private key of the public one
that it sends, by signing the request with it.
"""

import base64
import hashlib
import secrets
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, TypeVar

from pydantic import Field

from sync.errors import GrantError, Refusal, WireError
from sync.protocol.wire import EpochNumber, HashText, Message, StationText, Text, parse

SECRET_BYTES = 12
PIN_BYTES = 16
"""Of the SHA-256 of the certificate's public key: nobody finds another key with the same 128 bits."""
ENROL_BYTES_MAX = 4096
"""Most bytes of the body of an enrolment, and of a question for a challenge."""
ATTEMPTS_PER_MINUTE = 10
"""Enrolments that one network address may try; a guess has one chance in 2^96."""
_ADDRESSES_MAX = 10_000

_PLAIN, _PINNED = b"\x01", b"\x02"
_SUM_BYTES = 2
_GROUP = 5
_SLIPS = str.maketrans({"0": "O", "1": "I", "8": "B", "-": None, " ": None})


@dataclass(frozen=True, slots=True)
class Code:
    """What a one-time code holds."""

    secret: bytes
    pin: bytes | None
    """the first `PIN_BYTES` of the SHA-256 of central's public TLS key; None where its certificate is an operator's"""


def new_secret() -> bytes:
    """The secret of a new code."""
    return secrets.token_bytes(SECRET_BYTES)


def code_text(code: Code) -> str:
    """The code as people carry it: groups of letters and digits."""
    data = (_PLAIN if code.pin is None else _PINNED) + code.secret + (code.pin or b"")
    text = base64.b32encode(data + _sum(data)).decode().rstrip("=")
    return "-".join(text[at : at + _GROUP] for at in range(0, len(text), _GROUP))


def parse_code(text: str) -> Code:
    """The code that the text is; case, spaces and lines between groups do not matter.

    Raises:
        GrantError: It is no code: cut off, or with a slip.
    """
    plain = text.strip().upper().translate(_SLIPS)
    try:
        data = base64.b32decode(plain + "=" * (-len(plain) % 8))
    except ValueError as error:
        raise _no_code(plain) from error
    said, checksum = data[:-_SUM_BYTES], data[-_SUM_BYTES:]
    size = {_PLAIN: SECRET_BYTES, _PINNED: SECRET_BYTES + PIN_BYTES}.get(said[:1])
    if size is None or len(said) != 1 + size or _sum(said) != checksum:
        raise _no_code(plain)
    return Code(said[1 : 1 + SECRET_BYTES], said[1 + SECRET_BYTES :] or None)


def pin_of(public_key_info: bytes) -> bytes:
    """The pin of a certificate's public key, given as the DER of its SubjectPublicKeyInfo."""
    return hashlib.sha256(public_key_info).digest()[:PIN_BYTES]


M = TypeVar("M", bound=Message)


class Enrol(Message):
    """A station asks to be taken in; its name and signature are in the request's fields."""

    secret: Annotated[str, Field(pattern=rf"^[0-9a-f]{{{2 * SECRET_BYTES}}}$")]
    public_key: HashText


class Enrolled(Message):
    """The station was taken in."""

    station: StationText
    operations: tuple[Text, ...]
    reads: tuple[Text, ...]
    central: StationText
    """central's own name"""
    public_key: HashText
    """central's key, which its countersignatures are checked against, and which requests are meant for"""
    epoch: EpochNumber = 0
    """behind all epochs of which central holds events of the station; 0: it holds none"""


def parse_message(kind: type[M], body: bytes) -> M:
    """The message that the body holds.

    Raises:
        Refusal: It holds another thing.
    """
    try:
        return parse(kind, body)
    except WireError as error:
        raise Refusal(
            400,
            "bad_message",
            "the body does not hold what is sent here",
            str(error),
            f"{kind.__name__} in JSON, as docs/reference/sync.md says",
            "bring station and central to the same ViAn: pip install --upgrade vian",
        ) from error


class Attempts:
    """Counts what each network address tries, minute by minute; memory is bounded.

    Args:
        clock: Seconds that never go back.
    """

    def __init__(self, clock: Callable[[], float], per_minute: int = ATTEMPTS_PER_MINUTE) -> None:
        self._clock = clock
        self._per_minute = per_minute
        self._minute = -1
        self._tried: dict[str, int] = {}
        self._lock = threading.Lock()

    def check(self, address: str | None) -> None:
        """Nothing, if the address may try once more.

        Raises:
            Refusal: It has tried too often, or too many addresses have, within this minute.
        """
        with self._lock:
            minute = int(self._clock() // 60)
            if minute != self._minute:
                self._minute, self._tried = minute, {}
            name = address or ""
            tried = self._tried.get(name, 0)
            if tried < self._per_minute and (tried or len(self._tried) < _ADDRESSES_MAX):
                self._tried[name] = tried + 1
                return
        raise Refusal(
            429,
            "too_many_attempts",
            "too many enrolments were tried from this address",
            f"more than {self._per_minute} in a minute",
            f"at most {self._per_minute} a minute",
            "wait a minute, then try again with the code as central showed it",
        )


def _sum(data: bytes) -> bytes:
    return hashlib.sha256(data).digest()[:_SUM_BYTES]


def _no_code(plain: str) -> GrantError:
    return GrantError(
        f"this is not a one-time code: got {len(plain)} letters and digits with a slip, wanted the code as "
        "vian station invite NAME showed it. Next: copy it again"
    )
