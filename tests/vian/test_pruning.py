"""What keeps the disk in `vian serve` and `vian sync`, from the settings and the plan that counts."""

import json
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from events import CheckpointCountersigned, EventError, LossRecorded, station_name
from store import Log, LogUnavailable, StationKey, StoreError
from store.room import Room
from sync.keeping.countersigned import countersigned_bytes
from sync.plans.plan import Plan
from sync.plans.planning import set_plan
from tests.store.samples import GATE, NOON, append
from vian.clock import utc_now
from vian.membership import Membership, save_membership
from vian.options import open_from
from vian.pruning import DiskKeeper, disk_watch_for, signed_by_central
from vian.settings import Settings

MIB = 2**20
BRNO = station_name("brno")


def test_the_policy_of_the_plan_that_counts_is_applied_without_a_restart(log: Log) -> None:
    log.room = Room(log._fetched, Path("/"), lambda _: 40 * MIB)
    log.room.bytes_min = 64 * MIB
    append_at = utc_now()
    watch = disk_watch_for(log, Settings(station="brno"))
    log.room.bytes_min = 0
    append(log, GATE, 3)
    log.room.bytes_min = 64 * MIB
    while watch.step(append_at):
        pass
    assert len(list(log.read(GATE))) == 1
    data = {"entries": [{"stream": "*/*/*"}], "give_up": [{"stream": "*/gate/*", "older_than": "1 d"}]}
    log.room.bytes_min = 0
    set_plan(log, BRNO, Plan.of(data), "https://central.example", utc_now())
    log.room.bytes_min = 64 * MIB
    while watch.step(append_at + timedelta(minutes=2)):
        pass
    assert list(log.read(GATE)) == []
    assert len(list(log.read_all(types=[LossRecorded.type_name]))) == 1


class Step:
    """A watch or a pruner that does what the test says."""

    def __init__(self, *answers: bool | Exception) -> None:
        self.answers = list(answers)
        self.calls = 0

    def step(self, _: object) -> bool:
        self.calls += 1
        answer = self.answers.pop(0) if self.answers else False
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def keep() -> Callable[[Step, Step], tuple[DiskKeeper, list[float]]]:
    def make(watch: Step, pruner: Step) -> tuple[DiskKeeper, list[float]]:
        pauses: list[float] = []
        return DiskKeeper(watch, pruner, lambda: NOON, pauses.append), pauses  # type: ignore[arg-type]

    return make


Keep = Callable[[Step, Step], tuple[DiskKeeper, list[float]]]


def test_room_goes_before_what_is_old(keep: Keep) -> None:
    watch, pruner = Step(True, False), Step(True)
    keeper, pauses = keep(watch, pruner)
    keeper()
    assert (watch.calls, pruner.calls, pauses) == (1, 0, [])
    keeper()
    assert (watch.calls, pruner.calls, pauses) == (2, 1, [])
    keeper()
    assert pauses == [1.0]


@pytest.mark.parametrize("error", [StoreError("x"), EventError("x")])
def test_what_cannot_be_taken_off_stays_and_is_tried_again_later(keep: Keep, error: Exception) -> None:
    watch, pruner = Step(), Step(error)
    keeper, pauses = keep(watch, pruner)
    keeper()
    keeper()
    assert (watch.calls, pruner.calls, pauses) == (2, 1, [1.0, 1.0])


def test_a_database_that_is_away_is_waited_for(keep: Keep) -> None:
    keeper, _ = keep(Step(LogUnavailable("away")), Step())
    with pytest.raises(LogUnavailable):
        keeper()


def test_what_must_stay_free_comes_from_the_settings(log: Log) -> None:
    with open_from(Settings(dsn=log.dsn, disk_free_mb_min=77)) as opened:
        assert opened.room.bytes_min == 77 * MIB


def test_central_is_believed_by_the_key_that_the_station_was_enrolled_under(tmp_path: Path) -> None:
    own, other = (StationKey(Ed25519PrivateKey.generate()) for _ in range(2))
    settings = Settings(data_dir=tmp_path, station="brno")

    def countersigned(key: StationKey) -> CheckpointCountersigned:
        signed = countersigned_bytes("brno", 1, bytes(32), [], NOON, key.public)
        return CheckpointCountersigned(
            time=NOON,
            of_station="brno",
            checkpoint_sequence=1,
            statement_hash="00" * 32,
            held="[]",
            key_id=key.id,
            algorithm="ed25519",
            signature=key.sign(signed),
        )

    assert not signed_by_central(settings)(countersigned(own))
    save_membership(
        settings,
        Membership(address="https://c.example", station="brno", central="central", public_key=own.public.hex()),
    )
    believed = signed_by_central(settings)
    assert [believed(countersigned(key)) for key in (own, other)] == [True, False]
    held = json.dumps([["brno", 1, "gate", "track_point", 9, "ab" * 32]])
    forged = countersigned(own).model_copy(update={"held": held})
    assert not believed(forged)
