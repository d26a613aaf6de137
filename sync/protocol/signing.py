"""A station's signature over each of its requests: HTTP message signatures of RFC 9421, by Ed25519.

Contract: `signed` gives what a signature covers, and nothing else of a request may be believed. Both
sides know which parts each endpoint's signature must cover. Nothing here looks at a clock: whether a
request is new is told by its number or its challenge (`sync.central.access`), so `created` is not judged.

`@path` is the path from `/sync/` on, as central's own application knows it, whatever a proxy put before it.

Source: RFC 9421 (signatures), RFC 9530 (content-digest), RFC 8032 (Ed25519).
"""

import base64
import hashlib
import threading
from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass
from datetime import timedelta
from itertools import count
from typing import Any

import httpx
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey
from http_message_signatures import (
    HTTPMessageSigner,
    HTTPMessageVerifier,
    HTTPSignatureKeyResolver,
    InvalidSignature,
    VerifyResult,
    algorithms,
)
from http_message_signatures.exceptions import HTTPMessageSignaturesException

from store import StationKey
from sync.errors import BadSignature

LABEL = TAG = "vian-sync"
STATION_HEADER = "vian-station"
CENTRAL_HEADER = "vian-central"
NUMBER_HEADER = "vian-number"
CHALLENGE_HEADER = "vian-challenge"

ENROL = ("@method", "@path", "content-digest", "content-length", STATION_HEADER)
"""What the signature of an enrolment covers; its key comes in the body."""
HELLO = (*ENROL, CENTRAL_HEADER, CHALLENGE_HEADER)
"""What the signature of a hello covers."""
SESSION = (*ENROL, "authorization", CENTRAL_HEADER, NUMBER_HEADER)
"""What the signature of a request within a session covers."""

_HOST = "https://central"
"""Any: the signature names central by its key, not by an address that a proxy may change."""


@dataclass(frozen=True, slots=True)
class Signed:
    """What a signature was found to cover."""

    key_id: str
    values: Mapping[str, str]
    """each covered part and its value"""


def content_digest(body: bytes) -> str:
    """The field `content-digest` of a body.

    >>> content_digest(b"")
    'sha-256=:47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU=:'
    """
    return digest_field(hashlib.sha256(body).digest())


def digest_field(sha256: bytes) -> str:
    """The field `content-digest` for the SHA-256 of a body: the one spelling that is taken here."""
    return f"sha-256=:{base64.b64encode(sha256).decode()}:"


def covered_by(endpoint: str) -> tuple[str, ...]:
    """The parts that the signature of a request to that endpoint must cover."""
    return {"hello": HELLO, "enrol": ENROL}.get(endpoint, SESSION)


def sign(headers: dict[str, str], path: str, endpoint: str, key: StationKey) -> dict[str, str]:
    """The two fields that sign a request.

    Args:
        headers: The request's fields, in lower case; they hold all that `covered_by` names.
        path: Path of the protocol's version, such as `/sync/v2`.
        endpoint: The rest of the path.
        key: The station's key.
    """
    message = _Message(f"{_HOST}{path}/{endpoint}", dict(headers))
    _signer(key).sign(
        message,
        key_id=key.id,
        label=LABEL,
        tag=TAG,
        covered_component_ids=covered_by(endpoint),
        use_existing_digest=True,
    )
    return {name.lower(): value for name, value in message.headers.items() if name not in headers}


def signed(headers: Mapping[str, str], path: str, endpoint: str, key_of: Callable[[str], bytes | None]) -> Signed:
    """What the request's signature covers, once it is known to be that of the key that it names.

    Args:
        headers: The request's fields, all of them; one that comes twice is signed as one.
        path: Path of the protocol's version.
        endpoint: The rest of the path.
        key_of: The raw public key of a key id, None where there is none; what it raises comes through.

    Raises:
        BadSignature: There is no signature, of a known key, over all that must be covered.
    """
    asked = _Key(key_of)
    try:
        (result,) = _verified(headers, f"{_HOST}{path}/{endpoint}", asked, covered_by(endpoint))
    except (InvalidSignature, HTTPMessageSignaturesException, ValueError) as error:
        if asked.failure is not None:
            raise asked.failure from error
        raise BadSignature(_why(error), key_id=asked.key_id, is_key_known=asked.is_known) from error
    values = {name.strip('"'): value for name, value in result.covered_components.items()}
    return Signed(str(result.parameters["keyid"]), values)


class RequestSigner(httpx.Auth):
    """Signs each request of a station's HTTP client to central; may be used by several threads.

    Args:
        key: The station's key.
        station: The station's name.
        central: Id of central's key, as it was told at enrolment; empty before.
        path: Path of the protocol's version.
    """

    requires_request_body = True

    def __init__(self, key: StationKey, station: str, central: str, path: str) -> None:
        self._key = key
        self._station = station
        self._central = central
        self._path = path
        self._lock = threading.Lock()
        self._challenge = ""
        self._token = ""
        self._numbers = count(1)

    def answer(self, challenge: str) -> None:
        """Sign the next hello over this challenge of central's."""
        self._challenge = challenge

    def use(self, token: str) -> None:
        """Begin a session: send this token from now on, and number the requests from 1."""
        with self._lock:
            self._token, self._numbers = token, count(1)

    def auth_flow(self, request: httpx.Request) -> Generator[httpx.Request, httpx.Response, None]:
        """Add the fields that prove who sends the request; a challenge is asked for without."""
        endpoint = request.url.path.partition(f"{self._path}/")[2]
        if endpoint != "challenge":
            self._sign(request, endpoint)
        yield request

    def _sign(self, request: httpx.Request, endpoint: str) -> None:
        headers = {
            "content-digest": content_digest(request.content),
            "content-length": str(len(request.content)),
            STATION_HEADER: self._station,
            **self._proof(endpoint),
        }
        request.headers.update(headers | sign(headers, self._path, endpoint, self._key))

    def _proof(self, endpoint: str) -> dict[str, str]:
        """The fields that say that the request is new, and meant for this central."""
        if endpoint == "enrol":
            return {}
        if endpoint == "hello":
            return {CENTRAL_HEADER: self._central, CHALLENGE_HEADER: self._challenge}
        with self._lock:
            number = str(next(self._numbers))
            return {CENTRAL_HEADER: self._central, NUMBER_HEADER: number, "authorization": f"Bearer {self._token}"}


@dataclass(frozen=True, slots=True)
class _Message:
    """A request as the library of RFC 9421 wants to see it."""

    url: str
    headers: Any
    """gives all lines of all fields by `items()`"""
    method: str = "POST"


class _Key(HTTPSignatureKeyResolver):
    """The key that a signature names; remembers which that was."""

    def __init__(self, key_of: Callable[[str], bytes | None]) -> None:
        self._key_of = key_of
        self.key_id: str | None = None
        self.is_known = False
        self.failure: Exception | None = None

    def resolve_public_key(self, key_id: str) -> Ed25519PublicKey | None:
        self.key_id = key_id
        try:
            public_key = self._key_of(key_id)
        except Exception as error:
            self.failure = error  # The library would take it for a bad signature.
            raise
        self.is_known = public_key is not None
        return None if public_key is None else Ed25519PublicKey.from_public_bytes(public_key)


class _OwnKey(HTTPSignatureKeyResolver):
    """The station's own key."""

    def __init__(self, private: Ed25519PrivateKey) -> None:
        self._private = private

    def resolve_private_key(self, key_id: str) -> Ed25519PrivateKey:
        return self._private


class _Verifier(HTTPMessageVerifier):
    """One that believes no clock: a field station's may be years off, and numbers tell what is new."""

    require_created = False

    def validate_created_and_expires(self, sig_input: Any, max_age: timedelta | None = None) -> None:
        """Nothing: see the class."""


def _signer(key: StationKey) -> HTTPMessageSigner:
    return HTTPMessageSigner(signature_algorithm=algorithms.ED25519, key_resolver=_OwnKey(key.private))


def _verified(headers: Mapping[str, str], url: str, key: _Key, covered: tuple[str, ...]) -> list[VerifyResult]:
    verifier = _Verifier(signature_algorithm=algorithms.ED25519, key_resolver=key)
    return verifier.verify(_Message(url, headers), max_age=None, expect_tag=TAG, require_components=covered)


def _why(error: Exception) -> str:
    return str(error) or repr(error.__cause__ or error)
