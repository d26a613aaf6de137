"""Connections to central take turns."""

from collections.abc import Iterator

import httpx
import pytest
from fastapi import FastAPI, Request

from sync.station.deadlines import bounded
from sync.station.rotation import CONNECTIONS, take_turns
from tests.sync.conftest import Serve

Ports = list[int]


@pytest.fixture
def client(serve: Serve) -> Iterator[httpx.Client]:
    """A client whose connections take turns, to a server that says from which port it was asked."""
    app = FastAPI()

    @app.get("/port")
    async def port(request: Request) -> int:
        assert request.client is not None
        return request.client.port

    with httpx.Client(base_url=serve(app)) as made:
        take_turns(made, httpx.create_ssl_context())
        yield made


def test_each_connection_is_used_in_turn_and_kept(client: httpx.Client) -> None:
    ports = [client.get("/port").json() for _ in range(2 * CONNECTIONS)]
    assert len(set(ports[:CONNECTIONS])) == CONNECTIONS
    assert ports[:CONNECTIONS] == ports[CONNECTIONS:]


def test_what_is_under_way_is_passed_by(client: httpx.Client) -> None:
    with client.stream("GET", "/port") as busy:
        taken = busy.extensions["network_stream"].get_extra_info("client_addr")[1]
        others = {client.get("/port").json() for _ in range(4)}
    assert taken not in others


def test_their_requests_have_deadlines_too(client: httpx.Client) -> None:
    bounds = bounded(client)
    with client.stream("GET", "/port"):
        bounds.abort()
    assert client.get("/port").status_code == 200


def test_a_connection_that_fails_is_not_lost_to_the_others(client: httpx.Client) -> None:
    for _ in range(2 * CONNECTIONS):
        with pytest.raises(httpx.ConnectError):
            client.get("http://127.0.0.1:1/")
    assert client.get("/port").status_code == 200
