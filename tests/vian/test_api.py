from contextlib import AbstractContextManager

import httpx
import pytest
import uvicorn
from fastapi import FastAPI

from store import Log, LogUnavailable
from sync.central.router import Limits
from sync.protocol.grants import Grants, token_hash
from sync.station.rotation import REST_S
from tests.vian.samples import append, points
from vian.api import KEEP_ALIVE_S, bind, create_app, serving
from vian.errors import WorldFailed
from vian.version import VERSION

TOKEN = "a-token-of-brno-that-nobody-guesses"


def served(log: Log, grants: Grants | None = None, host: str = "127.0.0.1") -> AbstractContextManager[str]:
    return serving(create_app(log, grants), bind(host, 0))


def test_health_says_where_the_log_stands(log: Log) -> None:
    append(log, points(1))
    with served(log) as address:
        answer = httpx.get(f"{address}/health")
    assert answer.json() == {"status": "ok", "version": VERSION, "position": 1}


def test_a_connection_outlives_a_stations_use_of_it() -> None:
    assert REST_S < KEEP_ALIVE_S


@pytest.mark.parametrize("grants", [None, Grants({"brno": token_hash(TOKEN)})])
def test_the_root_lists_what_is_served(log: Log, grants: Grants | None) -> None:
    with served(log, grants) as address:
        answer = httpx.get(address).json()
        served_paths = {path for path in answer["paths"] if httpx.options(f"{address}{path}").status_code == 405}
    assert answer["program"] == "vian"
    assert served_paths == answer["paths"].keys()
    assert {"/health", "/openapi.json"} <= served_paths
    assert ("/sync/v1/hello" in served_paths) == (grants is not None)


def test_no_page_is_served_that_needs_the_internet(log: Log) -> None:
    with served(log) as address:
        assert [httpx.get(f"{address}/{page}").status_code for page in ("docs", "redoc")] == [404, 404]


def test_health_is_503_while_the_database_is_away(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def away() -> int:
        raise LogUnavailable("the password is hunter2")

    monkeypatch.setattr(log, "head", away)
    with served(log) as address:
        answer = httpx.get(f"{address}/health")
    assert answer.status_code == 503
    assert answer.json() == {"status": "the database is away", "version": VERSION}


@pytest.mark.parametrize("grants, status", [(None, 404), (Grants({"brno": token_hash(TOKEN)}), 401)])
def test_only_a_central_server_takes_segments(log: Log, grants: Grants | None, status: int) -> None:
    with served(log, grants) as address:
        assert httpx.post(f"{address}/sync/v1/hello").status_code == status


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_an_application_is_served_while_the_block_runs(log: Log, host: str) -> None:
    with served(log, host=host) as address:
        assert httpx.get(f"{address}/health").json()["status"] == "ok"
    with pytest.raises(httpx.ConnectError):
        httpx.get(f"{address}/health")


def test_a_port_in_use_is_told_with_the_way_out() -> None:
    with bind("127.0.0.1", 0) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(WorldFailed, match=rf"port {port}: Address already in use\. Next: .*--port"):
            bind("127.0.0.1", port)


def test_a_host_that_is_none_of_ours_is_told() -> None:
    with pytest.raises(WorldFailed, match=r"cannot listen on 192\.0\.2\.1 port 0: "):
        bind("192.0.2.1", 0)


def test_a_server_that_does_not_start_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uvicorn.Server, "run", lambda self, sockets: None)
    with pytest.raises(WorldFailed, match="the HTTP server did not start"), serving(FastAPI(), bind("127.0.0.1", 0)):
        pass


def test_the_limits_that_are_given_hold(log: Log) -> None:
    app = create_app(log, Grants({"brno": token_hash(TOKEN)}), limits=Limits(hello_bytes_max=1234))
    with serving(app, bind("127.0.0.1", 0)) as address:
        headers = {"authorization": f"Bearer {TOKEN}"}
        answer = httpx.post(f"{address}/sync/v1/hello", content=b"x" * 1235, headers=headers)
    assert answer.status_code == 413
    assert "1234 bytes" in answer.json()["wanted"]
