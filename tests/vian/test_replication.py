from contextlib import ExitStack
from datetime import UTC
from pathlib import Path

import httpx
import pytest
from structlog.testing import capture_logs

from events import SHIPPED, StreamName
from store import Log, make_key
from sync.errors import PlanError
from tests.conftest import MakeLog
from tests.vian.samples import START, append, points
from vian.api import bind, create_app, serving
from vian.clock import utc_now
from vian.errors import WrongUsage
from vian.membership import Membership, save_membership
from vian.peers import peer_by_token, peer_of
from vian.replication import PACE, Telling, load_plan, pace_of, station_daemon
from vian.settings import Settings, load_settings
from vian.stations import add_station, read_grants

TOKEN = "a-token-of-brno-that-nobody-guesses"


def test_the_default_plan_sends_everything_and_situations_before_points() -> None:
    plan = load_plan(None)
    found = {each.type_name: plan.entry_for(StreamName.of("brno", "gate", each.type_name)) for each in SHIPPED}
    priorities = {name: entry.priority for name, entry in found.items() if entry is not None}
    assert priorities.keys() == found.keys()
    assert priorities["situation_detected"] == priorities["rule_deployed"] == min(priorities.values())
    assert priorities["situation_detected"] < priorities["track_ended"] < priorities["track_point"]


def test_a_plan_comes_from_its_file() -> None:
    Path("plan.yaml").write_text("entries: [{stream: '*/*/situation_detected', priority: situations}]\n")
    plan = load_plan(Path("plan.yaml"))
    assert plan.entry_for(StreamName.of("brno", "gate", "track_point")) is None


def test_a_plan_that_is_not_there_is_told() -> None:
    with pytest.raises(PlanError, match=r"gone\.yaml"):
        load_plan(Path("gone.yaml"))


@pytest.mark.parametrize(
    "central", ["central.example", "ftp://x", "http://", "", "http://central.example", "http://[::2]"]
)
def test_an_address_that_is_none_or_not_safe_is_told_with_an_example(central: str) -> None:
    token_file().write_text(TOKEN)
    said = r"(such as https://central\.example:8470, got '|must be reached over https, got .*Next: give central a cert)"
    with pytest.raises(WrongUsage, match=said):
        peer_of(load_settings(station="brno", central=central, token_file=token_file()))


@pytest.mark.parametrize("central", ["http://127.0.0.1:8470", "http://[::1]", "http://localhost:80", "https://x:1"])
def test_a_station_with_a_token_speaks_protocol_1_where_it_is_safe(central: str) -> None:
    token_file().write_text(TOKEN)
    peer = peer_of(load_settings(station="brno", central=central, token_file=token_file()))
    assert peer is not None
    with httpx.Client(base_url=peer.address) as client:
        assert peer.link(client, "").protocol == 1


def test_an_enrolled_station_speaks_protocol_2_whatever_tokens_it_has(tmp_path: Path) -> None:
    settings = load_settings(station="brno", data_dir=tmp_path, token_file=token_file())
    key = make_key(tmp_path / "station.key")
    public = "ab" * 32
    member = Membership(address="https://central.example:1", station="brno", central="c", public_key=public)
    save_membership(settings, member)
    peer = peer_of(settings)
    assert peer is not None
    assert (peer.address, peer.public_key) == ("https://central.example:1", bytes.fromhex(public))
    with httpx.Client(base_url=peer.address) as client:
        assert peer.link(client, "").protocol == 2
    moved = peer_of(settings.model_copy(update={"central": "https://elsewhere:2"}))
    assert moved is not None
    assert moved.address == "https://elsewhere:2"
    (tmp_path / "station.key").unlink()
    with pytest.raises(WrongUsage, match=r"there is no key in .*Next: vian init"):
        peer_of(settings)
    assert key.id


def test_another_daemon_beside_it_is_told_once(log: Log, make_log: MakeLog, tmp_path: Path) -> None:
    append(log, points(3))
    add_station(tmp_path / "stations.toml", "brno", token_file())
    app = create_app(make_log(), read_grants(tmp_path / "stations.toml"))
    with serving(app, bind("127.0.0.1", 0)) as address, ExitStack() as stack:
        peer = peer_by_token(address, token_file().read_text().strip())
        pair = [stack.enter_context(station_daemon(log, "brno", peer, load_plan(None))) for _ in range(2)]  # by mistake
        telling = Telling(pair[0])
        with capture_logs() as told:
            for number in range(4):
                append(log, points(1), StreamName.of("brno", f"yard-{number}", "track_point"))
                for daemon in pair:
                    daemon.catch_up()
                telling(pair[0].step())
    assert [each["event"] for each in told] == ["another daemon runs for this station too"]
    assert told[0]["next"] == "stop all vian sync and vian serve of this station but one"


def test_a_station_that_is_neither_enrolled_nor_has_a_token_is_told(tmp_path: Path) -> None:
    settings = load_settings(station="brno", data_dir=tmp_path)
    assert peer_of(settings) is None
    with pytest.raises(
        WrongUsage, match=r"not enrolled at https://x\. Next: vian station invite brno on central, then"
    ):
        peer_of(settings.model_copy(update={"central": "https://x"}))


def token_file() -> Path:
    return Path("brno.token")


def test_a_log_of_another_station_is_not_sent_under_this_name(log: Log) -> None:
    append(log, points(1))
    said = "this log has no streams of station typo, but of brno. Next: give --station brno "
    said += "if central knows that name, else vian station invite brno there; or extract with --station typo"
    peer = peer_by_token("http://x", TOKEN)
    with pytest.raises(WrongUsage, match=said), station_daemon(log, "typo", peer, load_plan(None)):
        pass
    assert len(log.streams()) == 1


def test_an_empty_log_may_become_any_stations(log: Log) -> None:
    peer = peer_by_token("http://central", TOKEN)
    with station_daemon(log, "brno", peer, load_plan(None), now=lambda: START) as daemon:
        assert daemon.step().did == "planned"


def test_the_clock_is_in_utc() -> None:
    assert utc_now().tzinfo is UTC


def test_the_settings_say_how_much_a_daemon_sends_at_a_time() -> None:
    assert pace_of(Settings()) == PACE
    given = Settings(sync_latency_s=1, sync_request_kb_max=64, sync_in_flight=1, sync_hello_s=60)
    pace = pace_of(given)
    assert (pace.latency_s, pace.request_bytes, pace.in_flight, pace.hello_s) == (1, 65536, 1, 60)
