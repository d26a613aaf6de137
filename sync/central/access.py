"""Who speaks: what central knows of the sender of a request, and what that sender may do.

Contract: a `Caller` is made only of what the request's signature covers and central's registry says;
nothing that a station claims of itself is in it. The registry is asked for every request, and once more
before what the request wants is committed (`Access.check_again`), so a revocation counts at once.
"""

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial

from events import InvalidName, Station, station_name
from store import Log, StationKey, Transaction
from sync.central.registry import Registered, Registry, check_granted, revoked
from sync.central.sessions import CHALLENGE_SECONDS, Sessions, Token
from sync.errors import BadSignature, Refusal
from sync.protocol.enrolment import Enrol, Enrolled, parse_message
from sync.protocol.signing import (
    CENTRAL_HEADER,
    CHALLENGE_HEADER,
    NUMBER_HEADER,
    STATION_HEADER,
    Signed,
    content_digest,
    signed,
)
from sync.protocol.wire import PATH, Challenge

REPLICATE = "replicate"
FIND = "find"
QUERY = "query"
OPERATIONS = (REPLICATE, FIND, QUERY)
"""What a station may be granted."""
EVERY_STATION = "*"
"""Among `Caller.reads`: the events of all stations."""
TOKEN_MINUTES = 15.0


@dataclass(frozen=True, slots=True)
class Caller:
    """The station that sent a request, as its signature proves."""

    station: Station
    operations: frozenset[str]
    reads: frozenset[str]
    """stations whose events it may find and query: names, or `EVERY_STATION`"""
    key_id: str
    number: int
    """of the request in its session, from 1; 0 for a hello"""

    def may_read(self, station: str) -> bool:
        """Whether it may find and query events of that station."""
        return EVERY_STATION in self.reads or station in self.reads


@dataclass(frozen=True, slots=True)
class Asked:
    """A request whose signature and session were found good; its body has not come yet."""

    caller: Caller
    digest: str
    """the field `content-digest` that the signature covers"""
    token: Token | None = None
    """of the session that a hello began"""


class Access:
    """Decides for one central server who may speak.

    Args:
        log: Central's log.
        central: Central's own name.
        key: Central's key.
        own_keys: Ids of keys that central had before; a station that knows central by one of them is understood.
        now: Central's clock, aware.
        token_minutes: How long a session's token counts.
    """

    def __init__(
        self,
        log: Log,
        central: Station,
        key: StationKey,
        *,
        now: Callable[[], datetime],
        own_keys: Collection[str] = (),
        token_minutes: float = TOKEN_MINUTES,
    ) -> None:
        self.registry = Registry(log, central, now)
        self.key = key
        self._own_keys = {key.id, *own_keys}
        self._sessions = Sessions(log, key, now, token_minutes)

    def challenge(self, station: str) -> Challenge:
        """What that station's next hello must be signed over."""
        text = self._sessions.challenge(station)
        return Challenge(challenge=text, central=self.key.id, expires_s=CHALLENGE_SECONDS)

    def hello(self, headers: Mapping[str, str]) -> Asked:
        """Who says hello, and the session that it begins.

        Raises:
            Refusal: It is not an enrolled station that says it, or not now.
            LogUnavailable: The database is away.
        """
        station, proof = self._signed(headers, "hello")
        token = self._sessions.begin(station, proof.values[CHALLENGE_HEADER])
        return Asked(_caller(station, 0), proof.values["content-digest"], token)

    def asked(self, headers: Mapping[str, str], endpoint: str, operation: str | None) -> Asked:
        """Who sends a request within a session.

        Raises:
            Refusal: No enrolled station sends it, it came before, or the station may not do that.
            LogUnavailable: The database is away.
        """
        station, proof = self._signed(headers, endpoint)
        token = proof.values["authorization"].removeprefix("Bearer ")
        number = self._sessions.admit(station, token, proof.values[NUMBER_HEADER])
        if operation is not None and operation not in station.operations:
            raise _not_granted(station, operation)
        return Asked(_caller(station, number), proof.values["content-digest"])

    def check_again(self, transaction: Transaction, caller: Caller) -> None:
        """Nothing, if the caller may still speak; it then may until the transaction ends.

        Call it in the transaction that stores what the caller sent, before it appends.

        Raises:
            Refusal: It was revoked since its request began.
        """
        check_granted(transaction, caller.station, caller.key_id)

    def enrol(self, headers: Mapping[str, str], body: bytes, address: str | None) -> Enrolled:
        """Take a station in.

        Raises:
            Refusal: It has not the key that it shows, or its code does not count.
            LogUnavailable: The database is away.
        """
        asked = parse_message(Enrol, body)
        public_key = bytes.fromhex(asked.public_key)
        try:
            proof = signed(headers, PATH, "enrol", lambda _: public_key)
        except BadSignature as error:
            raise _bad_signature(str(error)) from error
        if proof.values["content-digest"] != content_digest(body):
            raise _bad_signature("another body than was signed")
        name = proof.values[STATION_HEADER]
        taken_in = self.registry.enrol(name, bytes.fromhex(asked.secret), public_key, address)
        return Enrolled(
            station=taken_in.name,
            operations=taken_in.operations,
            reads=taken_in.reads,
            central=self.registry.central,
            public_key=self.key.public.hex(),
            epoch=self.registry.next_epoch(taken_in.name),
        )

    def _signed(self, headers: Mapping[str, str], endpoint: str) -> tuple[Registered, Signed]:
        """The enrolled station that signed the request, and what its signature covers."""
        name = headers.get(STATION_HEADER, "")
        station = self.registry.station(name) if _is_name(name) else None
        try:
            proof = signed(headers, PATH, endpoint, partial(_key_of, station))
        except BadSignature as error:
            raise _unproven(headers, station, error) from error
        assert station is not None, "its key was found"
        if station.revoked_at is not None:
            raise revoked(station.name)
        if proof.values[CENTRAL_HEADER] not in self._own_keys:
            raise _other_central(proof.values[CENTRAL_HEADER], self.key.id)
        return station, proof


def _is_name(text: str) -> bool:
    try:
        return bool(station_name(text))
    except InvalidName:
        return False


def _key_of(station: Registered | None, key_id: str) -> bytes | None:
    return station.public_key if station is not None and station.key_id == key_id else None


def _caller(station: Registered, number: int) -> Caller:
    return Caller(station.name, frozenset(station.operations), frozenset(station.reads), station.key_id, number)


def _unproven(headers: Mapping[str, str], station: Registered | None, error: BadSignature) -> Refusal:
    """Why a request whose signature does not hold is refused."""
    name = headers.get(STATION_HEADER, "")[:80]
    if error.key_id is None or not name:
        return Refusal(
            401,
            "not_signed",
            "the request is not signed as a station signs",
            str(error),
            "signature, signature-input and vian-station as docs/reference/sync.md says",
            "vian station enrol CODE on the station; a proxy before central must pass all fields on",
        )
    if error.is_key_known:
        return _bad_signature(str(error))
    again = f"vian station invite {name} on central, then vian station enrol CODE on the station"
    if station is None:
        return Refusal(
            401, "unknown_station", "central knows no such station", f"station {name!r}", "an enrolled station", again
        )
    return Refusal(
        401,
        "wrong_key",
        "the station is known here by another key",
        f"key {error.key_id[:64]}",
        f"key {station.key_id}",
        f"put the station's own key back; if it is lost or was replaced: {again}",
    )


def _bad_signature(got: str) -> Refusal:
    return Refusal(
        401,
        "bad_signature",
        "the signature does not hold for this request",
        got or "other fields than were signed",
        "the fields as the station signed them",
        "let proxies before central leave the request as it is; if none is there, somebody changes it on the way",
    )


def _other_central(got: str, wanted: str) -> Refusal:
    return Refusal(
        401,
        "other_central",
        "the request is meant for another central",
        f"central {got[:64]}",
        f"central {wanted}",
        "check the address; if central's key was lost and made anew: vian station invite NAME there, then enrol again",
    )


def _not_granted(station: Registered, operation: str) -> Refusal:
    return Refusal(
        403,
        "not_granted",
        "central has not granted this to the station",
        operation,
        f"one of: {', '.join(station.operations) or 'nothing'}",
        f"on central: vian station invite {station.name} --operations "
        f"{','.join((*station.operations, operation))}, then vian station enrol CODE here",
    )
