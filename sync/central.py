"""Central's side over HTTP: a router for the FastAPI application that serves everything else.

Contract: a request is authenticated before its body is read, and its body is cut off at the limit
while it comes in. Endpoints run in the thread pool. An answer 200 to segments means durable. Every
refusal is a JSON problem: what is wrong, what was got, what was wanted, what to do next.
"""

import asyncio
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Request, Response
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute
from starlette.requests import ClientDisconnect

from events import Station
from store import Log, LogUnavailable
from sync.apply_v1 import answer_hello, apply, cursor_of
from sync.errors import Refusal
from sync.grants import Grantor, Grants
from sync.wire import BODY_BYTES_MAX, HELLO_BYTES_MAX, SEGMENTS_MAX
from sync.wire_v1 import PATH, HelloAnswer, Problem, SegmentsAnswer

__all__ = ["Grants", "Limits", "router"]

_RETRY_SECONDS = 5


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


def router(
    log: Log,
    grants: Grantor,
    limits: Limits | None = None,
    now: Callable[[], datetime] = lambda: datetime.now(UTC),
) -> APIRouter:
    """The endpoints `POST /sync/v1/hello` and `POST /sync/v1/segments` over a log.

    Args:
        log: Central's log.
        grants: Which token speaks for which station.
        limits: What a request may cost.
        now: Central's clock, which a hello's answer tells.
    """
    most = limits or Limits()
    api = APIRouter(prefix=PATH, tags=["sync"], route_class=_ProblemRoute, responses=_RESPONSES)

    async def granted(request: Request) -> Station:
        return _authenticated(request, grants)

    async def hello_body(request: Request, _: Annotated[Station, Depends(granted)]) -> bytes:
        return await _body(request, most.hello_bytes_max, most.idle_s_max)

    async def segments_body(request: Request, _: Annotated[Station, Depends(granted)]) -> bytes:
        return await _body(request, most.body_bytes_max, most.idle_s_max)

    @api.post("/hello", summary="A station says where it stands, and learns its cursors")
    def hello(
        station: Annotated[Station, Depends(granted)], body: Annotated[bytes, Depends(hello_body)]
    ) -> HelloAnswer:
        return answer_hello(
            log, station, body, body_bytes_max=most.body_bytes_max, segments_max=most.segments_max, now=now
        )

    @api.post("/segments", summary="A station sends segments; 200 means that they are durable")
    def segments(
        station: Annotated[Station, Depends(granted)], body: Annotated[bytes, Depends(segments_body)]
    ) -> SegmentsAnswer:
        return apply(log, station, body, body_bytes_max=most.body_bytes_max, segments_max=most.segments_max)

    return api


_RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"model": Problem, "description": description}
    for status, description in (
        (400, "not the protocol"),
        (401, "no token, or one that is not granted"),
        (403, "another station's name or stream"),
        (408, "the body stopped coming"),
        (409, "a gap or another history; with the cursors"),
        (413, "too large"),
        (422, "a segment that is not what it claims to be"),
        (503, "the database is away"),
    )
}


class _ProblemRoute(APIRoute):
    """A route that answers a refusal with its problem, wherever it was raised."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        handle = super().get_route_handler()

        async def handle_refusals(request: Request) -> Response:
            try:
                return await handle(request)
            except Refusal as refusal:
                return _answer(refusal)
            except LogUnavailable as error:
                return _answer(_unavailable(error))

        return handle_refusals


def _answer(refusal: Refusal) -> Response:
    problem = Problem(
        code=refusal.code,
        error=refusal.error,
        got=refusal.got[:1000],
        wanted=refusal.wanted,
        next=refusal.next,
        stream=str(refusal.stream) if refusal.stream else None,
        epoch=refusal.epoch,
        first_sequence=refusal.first_sequence,
        cursors=tuple(cursor_of(key, runs) for key, runs in refusal.held),
    )
    headers = {
        401: {"WWW-Authenticate": "Bearer", "Connection": "close"},
        # What is still coming of the body is not wanted.
        408: {"Connection": "close"},
        413: {"Connection": "close"},
        503: {"Retry-After": str(_RETRY_SECONDS)},
    }.get(refusal.status)
    return JSONResponse(problem.model_dump(mode="json"), refusal.status, headers)


def _unavailable(error: LogUnavailable) -> Refusal:
    return Refusal(
        503, "log_unavailable", "central's database is away", str(error), "a database", "vian doctor on central"
    )


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


async def _body(request: Request, bytes_max: int, idle_s_max: float) -> bytes:
    """The request's body, read piece by piece up to the limit.

    Raises:
        Refusal: It is too large, came too slowly, or broke off.
    """
    declared = request.headers.get("content-length", "0")
    if declared.isdecimal() and int(declared) > bytes_max:
        raise _too_large(f"{declared} bytes", bytes_max)
    parts: list[bytes] = []
    size = 0
    pieces = request.stream()
    try:
        while (piece := await asyncio.wait_for(anext(pieces, None), idle_s_max)) is not None:
            size += len(piece)
            if size > bytes_max:
                raise _too_large(f"more than {bytes_max} bytes", bytes_max)
            parts.append(piece)
    except TimeoutError as error:
        raise Refusal(
            408, "slow_body", "the body stopped coming", f"{size} bytes", "the whole body", "send it again"
        ) from error
    except ClientDisconnect as error:
        raise Refusal(
            400,
            "broken_body",
            "the connection was lost in the body",
            f"{size} bytes",
            "the whole body",
            "send it again",
        ) from error
    return b"".join(parts)


def _too_large(got: str, bytes_max: int) -> Refusal:
    return Refusal(
        413,
        "too_large",
        "the body is too large",
        got,
        f"at most {bytes_max} bytes",
        "send fewer segments at a time; hello says how many bytes are taken",
    )
