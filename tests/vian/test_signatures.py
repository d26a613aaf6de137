"""What signs by itself in `vian serve`, and which station and key it signs for."""

from collections.abc import Callable
from pathlib import Path

import psycopg
import pytest

from events import StreamName
from store import Log, make_key
from store.proof import checkpoint_stream
from tests.vian.samples import GATE, append, points
from vian.errors import WrongUsage
from vian.settings import Settings, load_settings
from vian.signatures import PeriodicSigner, own_station, signing_station

CHECKPOINTS = checkpoint_stream("brno")


class Clock:
    """Seconds that pass when told."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def settings(tmp_path: Path) -> Callable[..., Settings]:
    def make(**given: object) -> Settings:
        key_file = tmp_path / "keys" / "station.key"
        make_key(key_file)
        return load_settings(key_file=key_file, **given)

    return make


def stepped(log: Log, signer: PeriodicSigner) -> int:
    """How many checkpoints there are after the signer looked, and did what was due."""
    for _ in range(5):
        signer()
    return log.stream_head(CHECKPOINTS).sequence


def test_it_signs_when_the_time_is_up_and_events_came(
    log: Log, clock: Clock, settings: Callable[..., Settings]
) -> None:
    append(log, points(1))
    signer = PeriodicSigner(log, settings(sign_every_min=10), clock, lambda: None)
    clock.now = 3600
    assert stepped(log, signer) == 0, "nothing came"
    append(log, points(1))
    assert stepped(log, signer) == 1
    append(log, points(1))
    clock.now += 599
    assert stepped(log, signer) == 1
    clock.now += 1
    assert stepped(log, signer) == 2
    clock.now += 3600
    assert stepped(log, signer) == 2


def test_it_signs_after_so_many_segments(log: Log, clock: Clock, settings: Callable[..., Settings]) -> None:
    append(log, points(1))
    signer = PeriodicSigner(log, settings(sign_every_min=0, sign_every_segments=3), clock, lambda: None)
    clock.now = 1e9
    for _ in range(2):
        append(log, points(1))
    assert stepped(log, signer) == 0
    append(log, points(1))
    assert stepped(log, signer) == 1


def test_a_log_that_is_not_sound_is_told_and_recording_goes_on(
    log: Log, clock: Clock, settings: Callable[..., Settings], capsys: pytest.CaptureFixture[str]
) -> None:
    signer = PeriodicSigner(log, settings(sign_every_min=1), clock, lambda: None)
    append(log, points(1))
    with psycopg.connect(log.dsn) as owner:
        owner.execute("alter table segments disable trigger all")
        owner.execute("update segments set event_count = 2")
    clock.now = 60
    assert stepped(log, signer) == 0
    assert "nothing was signed, the log is not sound" in capsys.readouterr().out
    append(log, points(1), StreamName.of("brno", "yard", "track_point"))


def test_the_station_that_signs_is_the_one_that_was_set_or_the_only_one(
    log: Log, settings: Callable[..., Settings]
) -> None:
    assert signing_station(log, settings(station="new")) == "new"
    append(log, points(1))
    assert signing_station(log, settings()) == "brno"
    assert signing_station(log, settings(station="central")) == "central"
    append(log, points(1), StreamName.of("plzen", "gate", "track_point"))
    with pytest.raises(WrongUsage, match=r"This log has brno, plzen\. Next: give --station NAME"):
        signing_station(log, settings())


def test_the_own_station_is_known_by_name_or_key(
    log: Log, clock: Clock, settings: Callable[..., Settings], tmp_path: Path
) -> None:
    append(log, points(1), GATE)
    assert own_station(log, settings()) is None
    signer = PeriodicSigner(log, settings(sign_every_segments=1), clock, lambda: None)
    append(log, points(1))
    assert stepped(log, signer) == 1
    assert own_station(log, settings()) == "brno"
    elsewhere = tmp_path / "elsewhere" / "station.key"
    assert own_station(log, load_settings(key_file=elsewhere)) is None
    assert own_station(log, load_settings(key_file=elsewhere, station="brno")) == "brno"
