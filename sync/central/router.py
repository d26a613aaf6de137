"""Central's side over HTTP: a router for the FastAPI application that serves everything else.

Contract: who sends a request is found out before its body is read, and the body is cut off at the limit
while it comes in. Segments are checked and stored by a few threads. An answer 200 to them means durable. Every
refusal is a JSON problem: what is wrong, what was got, what was wanted, what to do next.

Version 2 is for enrolled stations, which sign each request (`sync.central.access`); version 1 is for stations of
the release before, which have a token of the stations file (`sync.protocol.grants`).
"""

from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from time import monotonic
from typing import Annotated, Any, Protocol

from fastapi import APIRouter, Depends, Request, Response

from events import Segment, Station
from store import Log
from sync.central.access import REPLICATE, Access, Asked, Caller
from sync.central.apply import answer_hello_2, checked_2, read_hello, store_2
from sync.central.apply_v1 import answer_hello, apply, cursor_of
from sync.central.bodies import BodyLimits, check_declared, read_body, read_signed
from sync.central.contacts import Contacts
from sync.central.places import Places
from sync.central.problems import RESPONSES, Note, claim, cursors_2, problem_route
from sync.central.room import Room
from sync.central.turns import NAME_LENGTH_MAX, Turns
from sync.central.workers import Workers
from sync.errors import Refusal
from sync.keeping.countersigning import countersign
from sync.keeping.repair import RANGE_BYTES_MAX, records_for, repair_with
from sync.protocol.enrolment import ENROL_BYTES_MAX, Attempts, Enrolled, parse_message
from sync.protocol.grants import Grantor, Grants
from sync.protocol.questions import QUESTION_BYTES_MAX
from sync.protocol.signing import STATION_HEADER
from sync.protocol.wire import (
    BODY_BYTES_MAX,
    CHALLENGE_BYTES_MAX,
    FOLLOWS_HEADER,
    HELLO_BYTES_MAX,
    ORDER_HEADER,
    PATH,
    RECORD_TYPE,
    SEGMENTS_MAX,
    Challenge,
    ChallengeRequest,
    Countersigned,
    Range,
    Record,
    RepairAnswer,
)
from sync.protocol.wire import HelloAnswer as HelloAnswer2
from sync.protocol.wire import SegmentsAnswer as SegmentsAnswer2
from sync.protocol.wire_v1 import PATH as PATH_1
from sync.protocol.wire_v1 import PROTOCOL as PROTOCOL_1
from sync.protocol.wire_v1 import Hello as Hello1
from sync.protocol.wire_v1 import HelloAnswer, SegmentsAnswer, parse_versioned
from sync.text import one_line

Storing = Callable[[], AbstractContextManager[None]]
"""Makes what is entered while segments are stored."""

OnHollow = Callable[[Sequence[Segment]], None]
"""Told of segments that were stored without payload."""

__all__ = ["Call", "Door", "Grants", "Limits", "router"]


@dataclass(frozen=True, slots=True)
class Limits:
    """What central takes at most."""

    body_bytes_max: int = BODY_BYTES_MAX
    """Bytes of a body of segments."""
    segments_max: int = SEGMENTS_MAX
    """Segments in one body."""
    hello_bytes_max: int = HELLO_BYTES_MAX
    """Bytes of a hello."""
    idle_s_max: float = 30.0
    """Seconds between two pieces of a body."""
    bits_per_s_max: int | None = None
    """Most that each station may send, which it keeps to by itself; None: no limit."""
    requests_max: int = 8
    """Requests of one station whose bodies are held at once."""
    bodies_bytes_max: int = 16 * 1024 * 1024
    """Bytes of the bodies of all stations that are held at once."""

    def body(self, bytes_max: int) -> BodyLimits:
        """The limits of a body of so many bytes."""
        return BodyLimits(bytes_max, self.idle_s_max)


@dataclass(frozen=True, slots=True)
class Call:
    """A request whose sender is known, and whose body is the one that was signed."""

    caller: Caller
    body: bytes
    asked: Asked
    began: float
    """by central's steady clock, later by what the body took to come"""
    order: str
    """the station's name for it; empty: none"""
    follows: str
    """name of the request on which it goes on; empty: none"""

    def took_s(self) -> float:
        """What central took for it until now, in seconds."""
        return monotonic() - self.began


class Answers(Protocol):
    """Answers questions of stations, as JSON. Each checks what is granted, and raises Refusal or LogUnavailable."""

    def find(self, caller: Caller, body: bytes) -> bytes:
        """What is found of plates or situations."""

    def query(self, caller: Caller, body: bytes) -> bytes:
        """What SQL gives."""


def router(
    log: Log,
    grants: Grantor | None,
    limits: Limits | None = None,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
    *,
    access: Access | None = None,
    answers: Answers | None = None,
    note: Note = lambda kind, got: None,
    while_storing: Storing = nullcontext,
    on_hollow: OnHollow = lambda segments: None,
) -> APIRouter:
    """The endpoints of sync over a log: `/sync/v1/...` with grants, `/sync/v2/...` with access.

    Args:
        log: Central's log.
        grants: Which token speaks for which station, of protocol version 1.
        limits: What a request may cost.
        now: Central's clock, which a hello's answer tells.
        access: Who may speak in protocol version 2.
        answers: Answers the questions of stations, in version 2.
        note: Told of each refusal, such as `Refusals.note`.
        while_storing: Entered while segments of a request are checked and stored.
        on_hollow: Told of segments that were stored without payload.
    """
    most = limits or Limits()
    api = APIRouter()
    contacts = Contacts(log, monotonic)
    room = Room(most.bodies_bytes_max)
    if grants is not None:
        api.include_router(_version_1(log, grants, most, now, note, while_storing, contacts, room))
    if access is not None:
        door = Door(access, most, room)
        api.include_router(_version_2(log, door, most, now, note, answers, while_storing, contacts, on_hollow))
        api.include_router(_repairs(log, door, most, now, note))
    api.include_router(_rest(note))
    return api


def _rest(note: Note) -> APIRouter:
    """What is asked under /sync/ and is no request of any version here: refused and noted like all else."""
    api = APIRouter(route_class=problem_route(note, cursors_2))

    @api.api_route(
        "/sync/{rest:path}", methods=["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE"], include_in_schema=False
    )
    def unknown(request: Request) -> None:
        claim(request, request.headers.get(STATION_HEADER))
        is_post = request.method == "POST"
        request.state.endpoint = "unknown"  # what a stranger writes there must not become many kinds
        raise Refusal(
            404 if is_post else 405,
            "unknown_request" if is_post else "wrong_method",
            "central answers no such request",
            f"{request.method} {one_line(request.url.path, 200)}",
            "a POST to one of the paths that GET / names",
            "bring station and central to the same ViAn: pip install --upgrade vian",
        )

    return api


Opened = Callable[..., AsyncIterator[Call]]
"""A dependency that gives the `Call`."""


class Door:
    """Lets in who may speak: makes the dependencies that endpoints of version 2 declare.

    Contract: the order is declared length; signature, session and grant; what it follows has come; room; body; the
    body's digest.
    """

    def __init__(self, access: Access, limits: Limits, room: Room) -> None:
        self.access = access
        self.workers = Workers()
        self.turns = Turns()
        self._limits = limits
        self._room = room
        self._places = Places(
            "too_many_requests",
            "the station has too many requests under way",  # an enrolled one must not fill central's memory
            "wait until one of them is answered; a daemon that runs twice is seen in vian sync status",
            of_station_max=limits.requests_max,
        )

    def hello(self) -> Opened:
        """A dependency: the station that says hello."""

        def asked(request: Request) -> Asked:
            return self.access.hello(request.headers)

        return self._call(asked, self._limits.hello_bytes_max)

    def opens(self, endpoint: str, operation: str | None, bytes_max: int) -> Opened:
        """A dependency: the station that asks `endpoint`, which the operation must be granted to.

        Args:
            endpoint: What stands behind the version in the path; it is signed.
            operation: One of `sync.central.access.OPERATIONS`; None where the endpoint looks at grants itself.
            bytes_max: Most bytes of the body.
        """

        def asked(request: Request) -> Asked:
            return self.access.asked(request.headers, endpoint, operation)

        return self._call(asked, bytes_max)

    def _call(self, asked: Callable[[Request], Asked], bytes_max: int) -> Opened:
        limits = self._limits.body(bytes_max)

        async def call(request: Request) -> AsyncIterator[Call]:
            began, waits = monotonic(), list[float]()
            claim(request, request.headers.get(STATION_HEADER))
            size = check_declared(request, limits)
            order, follows = (_name(request, header) for header in (ORDER_HEADER, FOLLOWS_HEADER))
            one = await self.workers.do(lambda: asked(request))
            station = one.caller.station
            with self._places.taken(station):
                await self.turns.wait_until_come(station, follows)
                with self.turns.under_way(station, order):  # only now: what follows it must not go ahead of it
                    async with self._room.taken(station, size):
                        body = await read_signed(request, limits, one.digest, waits.append)
                        yield Call(one.caller, body, one, began + sum(waits), order, follows)

        return call


def _name(request: Request, header: str) -> str:
    """The name of a request that the header gives; empty: none.

    Raises:
        Refusal: It is too long.
    """
    name = request.headers.get(header, "")
    if len(name) > NAME_LENGTH_MAX:
        raise Refusal(
            400,
            "long_name",
            f"the name in {header} is too long",
            f"{len(name)} characters",
            f"at most {NAME_LENGTH_MAX}",
            "let the daemon of this ViAn send it",
        )
    return name


def _version_2(
    log: Log,
    door: Door,
    most: Limits,
    now: Callable[[], datetime],
    note: Note,
    answers: Answers | None,
    while_storing: Storing,
    contacts: Contacts,
    on_hollow: OnHollow,
) -> APIRouter:
    api = APIRouter(prefix=PATH, tags=["sync"], route_class=problem_route(note, cursors_2), responses=RESPONSES)
    attempts = Attempts(monotonic)
    turns = door.turns
    small = most.body(ENROL_BYTES_MAX)

    async def small_body(request: Request) -> bytes:
        claim(request, request.headers.get(STATION_HEADER))
        return await read_body(request, small)

    async def attempted(request: Request) -> str | None:
        claim(request, request.headers.get(STATION_HEADER))
        address = request.client.host if request.client is not None else None
        attempts.check(address)
        return address

    @api.post("/challenge", summary="What the next hello must be signed over")
    async def challenge(body: Annotated[bytes, Depends(small_body)]) -> Challenge:
        return door.access.challenge(parse_message(ChallengeRequest, body).station)

    @api.post("/enrol", summary="A station is taken in by its one-time code")
    def enrol(
        request: Request,
        address: Annotated[str | None, Depends(attempted)],
        body: Annotated[bytes, Depends(small_body)],
    ) -> Enrolled:
        return door.access.enrol(request.headers, body, address)

    @api.post("/hello", summary="A station says where it stands, and learns what central holds")
    async def hello(call: Annotated[Call, Depends(door.hello())]) -> HelloAnswer2:
        token = call.asked.token
        assert token is not None, "a hello begins a session"

        def answered() -> HelloAnswer2:
            said = read_hello(call.body)
            answer = answer_hello_2(
                log,
                call.caller,
                said,
                body_bytes_max=most.body_bytes_max,
                segments_max=most.segments_max,
                now=now,
                token=token.text,
                token_expires_s=token.expires_s,
                bits_per_s_max=most.bits_per_s_max,
            )
            contacts.greeted(said, answer.protocol, answer.time)
            return answer

        return await door.workers.do(answered, len(call.body))

    @api.post("/segments", summary="A station sends segments; 200 means that they are durable")
    async def segments(
        call: Annotated[Call, Depends(door.opens("segments", REPLICATE, most.body_bytes_max))],
    ) -> SegmentsAnswer2:
        caller, size = call.caller, len(call.body)

        def checked() -> list[Record]:
            return checked_2(log, caller, call.body, body_bytes_max=most.body_bytes_max, segments_max=most.segments_max)

        def stored() -> SegmentsAnswer2:
            answer = store_2(log, records, lambda transaction: door.access.check_again(transaction, caller), on_hollow)
            contacts.heard(caller.station, now())
            return answer

        with while_storing():  # also while it waits: what it waits for is being stored
            records = await door.workers.do(checked, size)
            await turns.wait_until_through(caller.station, call.follows)
            answer = await door.workers.do(stored, size)
        turns.is_through(caller.station, call.order)
        return answer.model_copy(update={"took_s": call.took_s()})

    @api.post("/countersign", summary="Central signs that it holds what a station's checkpoint says")
    def countersigned(
        call: Annotated[Call, Depends(door.opens("countersign", REPLICATE, CHALLENGE_BYTES_MAX))],
    ) -> Countersigned:
        return countersign(log, call.caller.station, call.body, door.access.key, now())

    if answers is not None:
        _add_questions(api, door, answers)
    return api


def _repairs(log: Log, door: Door, most: Limits, now: Callable[[], datetime], note: Note) -> APIRouter:
    api = APIRouter(prefix=PATH, tags=["sync"], route_class=problem_route(note, cursors_2), responses=RESPONSES)

    @api.post("/segments/read", summary="A station reads back segments that it sent", response_class=Response)
    def read(call: Annotated[Call, Depends(door.opens("segments/read", REPLICATE, RANGE_BYTES_MAX))]) -> Response:
        wanted = parse_message(Range, call.body)
        body = records_for(
            log, call.caller.station, wanted, bytes_max=most.body_bytes_max, segments_max=most.segments_max
        )
        return Response(body, media_type=RECORD_TYPE)

    @api.post("/segments/repair", summary="A station sends again what central wants back")
    def repair(
        call: Annotated[Call, Depends(door.opens("segments/repair", REPLICATE, most.body_bytes_max))],
    ) -> RepairAnswer:
        repaired = repair_with(
            log, door.access.registry.central, call.caller.station, call.body, segments_max=most.segments_max, now=now
        )
        return RepairAnswer(repaired=repaired)

    return api


def _add_questions(api: APIRouter, door: Door, answers: Answers) -> None:
    """The endpoints for questions; whether they are granted is seen, and recorded, by who answers."""

    @api.post("/find", summary="A station looks for plates or situations that central knows")
    def find(call: Annotated[Call, Depends(door.opens("find", None, QUESTION_BYTES_MAX))]) -> Response:
        return Response(answers.find(call.caller, call.body), media_type="application/json")

    @api.post("/query", summary="A station asks central in SQL")
    def query(call: Annotated[Call, Depends(door.opens("query", None, QUESTION_BYTES_MAX))]) -> Response:
        return Response(answers.query(call.caller, call.body), media_type="application/json")


def _version_1(
    log: Log,
    grants: Grantor,
    most: Limits,
    now: Callable[[], datetime],
    note: Note,
    while_storing: Storing,
    contacts: Contacts,
    room: Room,
) -> APIRouter:
    api = APIRouter(prefix=PATH_1, tags=["sync"], route_class=problem_route(note, _cursors_1), responses=RESPONSES)

    async def granted(request: Request) -> Station:
        station = _authenticated(request, grants)
        claim(request, station)
        return station

    async def hello_body(request: Request, _: Annotated[Station, Depends(granted)]) -> bytes:
        return await read_body(request, most.body(most.hello_bytes_max))

    async def segments_body(request: Request, station: Annotated[Station, Depends(granted)]) -> AsyncIterator[bytes]:
        declared = request.headers.get("content-length", "")
        size = min(int(declared), most.body_bytes_max) if declared.isdecimal() else most.body_bytes_max
        async with room.taken(station, size):
            yield await read_body(request, most.body(most.body_bytes_max))

    @api.post("/hello", summary="A station says where it stands, and learns its cursors")
    def hello(
        station: Annotated[Station, Depends(granted)], body: Annotated[bytes, Depends(hello_body)]
    ) -> HelloAnswer:
        answer = answer_hello(
            log, station, body, body_bytes_max=most.body_bytes_max, segments_max=most.segments_max, now=now
        )
        contacts.greeted(parse_versioned(Hello1, body), PROTOCOL_1, answer.time)
        return answer

    @api.post("/segments", summary="A station sends segments; 200 means that they are durable")
    def segments(
        station: Annotated[Station, Depends(granted)], body: Annotated[bytes, Depends(segments_body)]
    ) -> SegmentsAnswer:
        with while_storing():
            answer = apply(log, station, body, body_bytes_max=most.body_bytes_max, segments_max=most.segments_max)
        contacts.heard(station, now())
        return answer

    return api


def _cursors_1(refusal: Refusal) -> list[dict[str, Any]]:
    return [cursor_of(key, runs).model_dump(mode="json") for key, runs in refusal.held]


def _authenticated(request: Request, grants: Grantor) -> Station:
    scheme, _, token = request.headers.get("authorization", "").partition(" ")
    is_bearer = scheme.lower() == "bearer"
    station = grants.station_of(token.strip()) if is_bearer else None
    if station is None:
        raise Refusal(
            401,
            "wrong_token",
            "the token is not granted here",
            "an unknown token" if is_bearer else "no bearer token",
            "Authorization: Bearer with the token of a station",
            "vian station add NAME on central, then carry its token to the station",
        )
    return station
