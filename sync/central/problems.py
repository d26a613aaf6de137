"""Refusals as HTTP answers: a JSON problem that says what is wrong, what was got and wanted, and what to do next.

Contract: every refusal of a route is answered as a problem and noted once, wherever it was raised.
"""

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.responses import JSONResponse
from fastapi.routing import APIRoute

from store import DiskNearlyFull, LogUnavailable
from sync.central.refusals import Kind
from sync.errors import Refusal
from sync.protocol.wire import Cursor, Problem

RETRY_SECONDS = 5
RETRY_ENROL_SECONDS = 60

Note = Callable[[Kind, str], None]
"""Told of each refusal, and what was wrong."""

Cursors = Callable[[Refusal], list[dict[str, Any]]]
"""What is held of the streams of a request that was refused, as JSON."""

RESPONSES: dict[int | str, dict[str, Any]] = {
    status: {"model": Problem, "description": description}
    for status, description in (
        (400, "not the protocol"),
        (404, "no such request, or nothing of what was asked for is held"),
        (405, "not a POST"),
        (401, "not known, not signed, or not new"),
        (403, "another station's name or stream, or not granted"),
        (408, "the body stopped coming"),
        (409, "a gap or another history; with the cursors"),
        (411, "the body's length is not declared"),
        (413, "too large"),
        (422, "a segment that is not what it claims to be"),
        (429, "too many attempts"),
        (503, "the database is away"),
    )
}


def claim(request: Request, station: str | None) -> None:
    """Remember for which station the request claims to speak."""
    request.state.claimed = station


def problem_route(note: Note, cursors: Cursors) -> type[APIRoute]:
    """The class of routes that answer a refusal with its problem, and note it.

    Args:
        note: Told of each refusal.
        cursors: How the version of the protocol says what central holds.
    """

    class ProblemRoute(APIRoute):
        def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
            handle = super().get_route_handler()

            async def handle_refusals(request: Request) -> Response:
                try:
                    return await handle(request)
                except (Refusal, LogUnavailable) as error:
                    refusal = error if isinstance(error, Refusal) else unavailable(error)
                    note(_kind(request, refusal), refusal.got)
                    return answer(refusal, cursors(refusal))

            return handle_refusals

    return ProblemRoute


def cursors_2(refusal: Refusal) -> list[dict[str, Any]]:
    """What is held of the streams of a request that was refused, as version 2 says it."""
    return [Cursor.of(key, runs).model_dump(mode="json") for key, runs in refusal.held]


def answer(refusal: Refusal, cursors: list[dict[str, Any]]) -> Response:
    """The refusal's problem, and what it means for the connection."""
    problem = Problem(
        code=refusal.code,
        error=refusal.error,
        got=refusal.got[:1000],
        wanted=refusal.wanted,
        next=refusal.next,
        stream=str(refusal.stream) if refusal.stream else None,
        epoch=refusal.epoch,
        first_sequence=refusal.first_sequence,
    )
    headers = {
        401: {"WWW-Authenticate": "Bearer", "Connection": "close"},
        404: {"Connection": "close"},
        405: {"Allow": "POST", "Connection": "close"},
        # What is still coming of the body is not wanted.
        403: {"Connection": "close"},
        408: {"Connection": "close"},
        411: {"Connection": "close"},
        413: {"Connection": "close"},
        429: {"Retry-After": str(RETRY_ENROL_SECONDS), "Connection": "close"},
        503: {"Retry-After": str(RETRY_SECONDS)},
    }.get(refusal.status)
    return JSONResponse(problem.model_dump(mode="json") | {"cursors": cursors}, refusal.status, headers)


def unavailable(error: LogUnavailable) -> Refusal:
    """What a station is told while central's database is away, or takes no more."""
    if isinstance(error, DiskNearlyFull):
        said = str(error).partition(". Next: ")[0]
        return Refusal(
            503, "disk_nearly_full", "central's disk is nearly full", said, "room on it", "make room on central's disk"
        )
    return Refusal(
        503, "log_unavailable", "central's database is away", str(error), "a database", "vian doctor on central"
    )


def _kind(request: Request, refusal: Refusal) -> Kind:
    path = request.url.path.rpartition("/sync/")[2].partition("/")[2]
    endpoint = getattr(request.state, "endpoint", path)
    address = request.client.host if request.client is not None else None
    return Kind(getattr(request.state, "claimed", None), endpoint, refusal.code, address)
