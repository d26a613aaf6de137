"""What Prometheus reads of a station and of central."""

from pathlib import Path

import httpx
import pytest
from prometheus_client.parser import text_string_to_metric_families

from events import station_name
from store import Log, LogUnavailable
from sync.central.contacts import Contacts
from sync.central.registry import Registry
from tests.sync.test_contacts import hello
from tests.vian.samples import GATE, START, append, points
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.metrics import LOOK_EVERY_S, METRICS, OTHERS, STREAMS_MAX, Metrics, Watched

BRNO, CENTRAL = station_name("brno"), station_name("central")
Samples = dict[tuple[str, tuple[tuple[str, str], ...]], float]


def samples(text: bytes) -> Samples:
    """Every sample of a text: its name and labels, and its value."""
    families = text_string_to_metric_families(text.decode())
    return {(s.name, tuple(sorted(s.labels.items()))): s.value for each in families for s in each.samples}


def metrics_of(watched: Watched) -> Samples:
    return samples(Metrics(watched, utc_now, lambda: 0.0).text())


def test_a_station_says_what_waits(log: Log) -> None:
    append(log, points(20))
    found = metrics_of(Watched(log, BRNO))
    assert found["vian_sync_backlog_events", (("stream", str(GATE)),)] == 20
    assert found["vian_sync_backlog_bytes", (("stream", str(GATE)),)] > 20
    assert found["vian_sync_stopped", (("stream", str(GATE)),)] == 0
    assert found["vian_log_position", ()] == 1
    assert found["vian_log_available", ()] == 1


def test_central_says_how_its_stations_stand_and_what_it_refused(log: Log) -> None:
    Contacts(log, lambda: 0.0).greeted(hello(7), 2, utc_now())
    watched = Watched(log, CENTRAL, Registry(log, CENTRAL, utc_now), lambda: {("hello", "replayed"): 3})
    found = metrics_of(watched)
    assert found["vian_station_behind_events", (("station", "brno-2"),)] == 7
    assert found["vian_station_last_contact_seconds", (("station", "brno-2"),)] >= 0
    assert found["vian_sync_refusals_total", (("code", "replayed"), ("endpoint", "hello"))] == 3


def test_every_metric_is_told_of_and_stands_in_the_docs(log: Log) -> None:
    append(log, points(2))
    told = {name for name, _ in metrics_of(Watched(log, BRNO))}
    registry = Registry(log, CENTRAL, utc_now)
    told |= {name for name, _ in metrics_of(Watched(log, CENTRAL, registry, lambda: {("hello", "replayed"): 1}))}
    assert told <= METRICS.keys()
    page = (Path(__file__).parents[2] / "docs" / "operations.md").read_text()
    assert [name for name in METRICS if f"| `{name}`" not in page] == []


def test_many_streams_are_few_series(log: Log) -> None:
    count = STREAMS_MAX + 5
    for number in range(count):
        append(log, points(1), GATE.of("brno", f"cam-{number:04}", "track_point"))
    found = metrics_of(Watched(log, BRNO))
    series = {labels for name, labels in found if name == "vian_sync_backlog_events"}
    assert len(series) == STREAMS_MAX + 1
    assert found["vian_sync_backlog_events", (("stream", OTHERS),)] == 5


def test_a_log_that_is_away_is_a_figure(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    def away() -> int:
        raise LogUnavailable("away")

    monkeypatch.setattr(log, "head", away)
    found = metrics_of(Watched(log, BRNO))
    assert found["vian_log_available", ()] == 0
    assert ("vian_log_position", ()) not in found


def test_the_log_is_not_looked_at_for_every_reader(log: Log) -> None:
    clock = [0.0]
    metrics = Metrics(Watched(log, BRNO), lambda: START, lambda: clock[0])
    before = metrics.text()
    append(log, points(1))
    clock[0] = LOOK_EVERY_S - 0.1
    assert metrics.text() == before
    clock[0] = LOOK_EVERY_S
    assert metrics.text() != before


@pytest.mark.parametrize(
    "address, is_public, may",
    [
        ("127.0.0.1", False, True),
        ("::1", False, True),
        ("192.0.2.7", False, False),
        ("testclient", False, False),
        (None, False, False),
        ("192.0.2.7", True, True),
    ],
)
def test_other_machines_read_them_only_where_that_is_set(log: Log, address: str, is_public: bool, may: bool) -> None:
    assert Metrics(Watched(log, BRNO), utc_now, lambda: 0.0, is_public=is_public).may_read(address) is may


def test_they_are_served_beside_the_rest(log: Log) -> None:
    metrics = Metrics(Watched(log, BRNO), utc_now, lambda: 0.0)
    with serving(create_app(log, metrics=metrics), bind("127.0.0.1", 0)) as address:
        answer = httpx.get(f"{address}/metrics")
        assert "/metrics" in httpx.get(address).json()["paths"]
    assert answer.headers["content-type"].startswith("text/plain; version=0.0.4")
    assert samples(answer.content)["vian_log_position", ()] == 0
