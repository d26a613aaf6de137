"""The HTTP application: health, and in the central role the sync end points.

Contract: `create_app` builds it from what it is given; it holds no state of its own.
"""

import asyncio.sslproto
import logging
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from itertools import groupby
from typing import Any

import structlog
import uvicorn
from fastapi import FastAPI, Request, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from events import Segment
from store import Log, LogUnavailable
from sync.central.access import Access
from sync.central.problems import Note
from sync.central.router import Answers, Limits, Storing, router
from sync.protocol.grants import Grantor
from vian.errors import WorldFailed
from vian.metrics import Metrics
from vian.tls import Certificate
from vian.version import VERSION

logger = structlog.get_logger()

_START_SECONDS_MAX = 15.0
KEEP_ALIVE_S = 20
"""Longer than a station keeps a connection (`sync.station.rotation.REST_S`): else a request meets its end."""
_TLS_BUFFER_BYTES = 64 * 1024
"""Of each connection, twice: asyncio takes four times as much, which a hundred stations make 80 MB of."""
_END_SECONDS_MAX = 5


def create_app(
    log: Log,
    grants: Grantor | None = None,
    *,
    limits: Limits | None = None,
    access: Access | None = None,
    answers: Answers | None = None,
    note: Note = lambda kind, got: None,
    while_storing: Storing = nullcontext,
    metrics: Metrics | None = None,
) -> FastAPI:
    """The application over a log; with grants or access it takes stations' segments.

    Args:
        log: The log.
        grants: Which tokens speak for which station, of protocol version 1.
        limits: What requests of stations may cost.
        access: Which stations are enrolled, for version 2.
        answers: Answers enrolled stations' questions.
        note: Told of each request of a station that is refused.
        while_storing: Entered while segments of a request are checked and stored.
        metrics: What Prometheus reads, from this machine alone unless they are public.
    """
    # The pages of documentation that FastAPI would serve need a CDN; the schema itself is served.
    app = FastAPI(title="ViAn", version=VERSION, docs_url=None, redoc_url=None)

    @app.get("/")
    def root() -> dict[str, Any]:
        """What is served here."""
        return {"program": "vian", "version": VERSION, "paths": _paths(app)}

    @app.get("/health", responses={503: {"description": "the database is away"}})
    def health() -> JSONResponse:
        """Whether the log answers, and where it stands."""
        try:
            return JSONResponse({"status": "ok", "version": VERSION, "position": log.head()})
        except LogUnavailable:
            return JSONResponse({"status": "the database is away", "version": VERSION}, status_code=503)

    if metrics is not None:
        _add_metrics(app, metrics)
    if grants is not None or access is not None:
        app.include_router(
            router(
                log,
                grants,
                limits,
                access=access,
                answers=answers,
                note=note,
                while_storing=while_storing,
                on_hollow=_tell_hollow,
            )
        )
    return app


def _tell_hollow(segments: Sequence[Segment]) -> None:
    """Say in the program's log what came without payload: lost at its station, or gone at both sides."""
    for place, group in groupby(segments, lambda each: (str(each.stream), int(each.header.epoch))):
        headers = [each.header for each in group]
        logger.warning(
            "segments came without payload",
            stream=place[0],
            epoch=place[1],
            first_sequence=int(headers[0].first_sequence),
            last_sequence=int(headers[-1].last_sequence),
            next="vian sync status",
        )


def _add_metrics(app: FastAPI, metrics: Metrics) -> None:
    @app.get("/metrics", response_class=Response, responses={403: {"description": "asked from another machine"}})
    def read(request: Request) -> Response:
        """What an operator watches, for Prometheus."""
        if not metrics.may_read(request.client.host if request.client is not None else None):
            return PlainTextResponse("only this machine may read it, unless metrics_public is set\n", status_code=403)
        return Response(metrics.text(), media_type=CONTENT_TYPE_PLAIN_0_0_4)


def _paths(app: FastAPI) -> dict[str, str]:
    """Each path and the methods that it takes."""
    return {path: ", ".join(methods).upper() for path, methods in app.openapi()["paths"].items()} | {
        "/openapi.json": "GET"
    }


def bind(host: str, port: int) -> socket.socket:
    """A listening socket.

    Raises:
        WorldFailed: The port is taken, or the address is not one of this machine's.
    """
    listening = socket.socket(
        socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP
    )
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((host, port))
    except OSError as error:
        listening.close()
        raise WorldFailed(
            f"cannot listen on {host} port {port}: {error.strerror}. "
            "Next: stop what uses it, or give another with --port (0 takes a free one)"
        ) from error
    listening.listen(128)
    return listening


def _is_news(record: logging.LogRecord) -> bool:
    """Whether it is more than that idle connections did not close by themselves, which stations' never do."""
    return not record.getMessage().startswith("Cancel 0 running task(s)")


@contextmanager
def serving(app: FastAPI, listening: socket.socket, certificate: Certificate | None = None) -> Iterator[str]:
    """The application served from a thread while the block runs, over TLS with a certificate; its address."""
    shown, key = (None, None) if certificate is None else (certificate.certificate, certificate.key)
    config = uvicorn.Config(
        app,
        log_config=None,
        lifespan="off",
        ssl_certfile=shown,
        ssl_keyfile=key,
        timeout_keep_alive=KEEP_ALIVE_S,
        # A station that holds its connection open, or does not answer TLS's farewell, must not hold up the end.
        timeout_graceful_shutdown=_END_SECONDS_MAX,
    )
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    asyncio.sslproto.SSLProtocol.max_size = _TLS_BUFFER_BYTES
    server = uvicorn.Server(config)
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listening]}, name="vian-http", daemon=True)
    thread.start()
    try:
        _wait_until_started(server, thread)
        host, port = listening.getsockname()[:2]
        scheme = "http" if certificate is None else "https"
        yield f"{scheme}://{f'[{host}]' if ':' in host else host}:{port}"
    finally:
        server.should_exit = True
        thread.join(_START_SECONDS_MAX)
        listening.close()


def _wait_until_started(server: uvicorn.Server, thread: threading.Thread) -> None:
    waited = 0.0
    while not server.started:
        thread.join(0.02)
        waited += 0.02
        if not thread.is_alive() or waited > _START_SECONDS_MAX:
            raise WorldFailed("the HTTP server did not start; the log above says why")
