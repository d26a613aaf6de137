"""The bad link itself: what it is told to do to the bytes, it does."""

from collections.abc import Iterator

import httpx
import pytest
from fastapi import FastAPI, Request, Response

from tests.sync.conftest import start_http
from tests.sync.proxy import CUT, DELAYED, DOUBLED, GARBLED, OF_BYTES, PAGE, REPLAYED, SILENT, TRUNCATED, Proxy, Weather


@pytest.fixture(scope="module")
def heard() -> list[bytes]:
    return []


@pytest.fixture(scope="module")
def port(heard: list[bytes]) -> Iterator[int]:
    app = FastAPI()

    @app.post("/")
    async def echo(request: Request) -> Response:
        heard.append(await request.body())
        return Response(heard[-1])

    address, stop = start_http(app)
    yield int(address.rsplit(":", 1)[1])
    stop()


def exchange(proxy: Proxy, body: bytes = b"0123456789" * 50) -> bytes | None:
    """What comes back; None if nothing whole does."""
    with httpx.Client(base_url=f"http://127.0.0.1:{proxy.port}", timeout=2) as client:
        try:
            answer = client.post("/", content=body)
            return answer.content if answer.status_code == 200 else None
        except httpx.HTTPError:
            return None


@pytest.mark.parametrize("is_opaque", [False, True])
def test_in_calm_weather_everything_passes(port: int, is_opaque: bool) -> None:
    with Proxy(port, is_opaque=is_opaque) as proxy, httpx.Client(base_url=f"http://127.0.0.1:{proxy.port}") as client:
        for size in (0, 1, 200_000):
            assert client.post("/", content=bytes(size)).content == bytes(size)
        assert not proxy.counts


@pytest.mark.parametrize("is_opaque", [False, True])
@pytest.mark.parametrize("kind", [CUT, TRUNCATED, SILENT])
def test_a_connection_that_ends_in_the_middle_gives_no_answer(port: int, kind: str, is_opaque: bool) -> None:
    weather = Weather(1.0, (kind,), silent_s=0.01)
    with Proxy(port, 1, is_opaque=is_opaque, weather=weather) as proxy:
        assert exchange(proxy) is None
        assert proxy.counts[kind] >= 1
        proxy.set(share=0.0)
        assert exchange(proxy) is not None


@pytest.mark.parametrize("is_opaque", [False, True])
def test_a_delay_changes_nothing(port: int, is_opaque: bool) -> None:
    with Proxy(port, 1, is_opaque=is_opaque, weather=Weather(1.0, (DELAYED,), delay_s=0.001)) as proxy:
        assert exchange(proxy, b"abc") == b"abc"
        assert proxy.counts[DELAYED] >= 1


def test_a_garbled_exchange_is_another_or_none(port: int) -> None:
    with Proxy(port, 1, weather=Weather(1.0, (GARBLED,))) as proxy:
        bodies = {exchange(proxy) for _ in range(20)}
        assert len(bodies) > 10
        assert proxy.counts[GARBLED] == 20


@pytest.mark.parametrize(
    "kind, wanted", [(DOUBLED, [b"1", b"1", b"2", b"2", b"3", b"3"]), (REPLAYED, [b"1", b"1", b"2"])]
)
def test_central_hears_a_request_again(port: int, heard: list[bytes], kind: str, wanted: list[bytes]) -> None:
    heard.clear()
    with Proxy(port, 1, weather=Weather(1.0, (kind,))) as proxy:
        for body in (b"1", b"2", b"3"):
            assert exchange(proxy, body) == body
    assert heard[: len(wanted)] == wanted


def test_a_page_comes_instead_of_central(port: int, heard: list[bytes]) -> None:
    heard.clear()
    with Proxy(port, 1, weather=Weather(1.0, (PAGE,))) as proxy:
        for _ in range(5):
            assert exchange(proxy, b"1") != b"1"
    assert heard == []


def test_a_link_that_is_down_takes_no_connection_and_ends_those_that_are_open(port: int) -> None:
    with Proxy(port) as proxy, httpx.Client(base_url=f"http://127.0.0.1:{proxy.port}") as client:
        client.post("/", content=b"1")
        proxy.set(is_down=True)
        proxy.cut_all()
        with pytest.raises(httpx.HTTPError):
            client.post("/", content=b"1")
        assert exchange(proxy) is None


def test_the_same_seed_does_the_same(port: int) -> None:
    seen = []
    for _ in range(2):
        with Proxy(port, 7, weather=Weather(0.5, OF_BYTES, silent_s=0.01, delay_s=0.001)) as proxy:
            seen.append(([exchange(proxy) for _ in range(10)], dict(proxy.counts)))
    assert seen[0] == seen[1]
