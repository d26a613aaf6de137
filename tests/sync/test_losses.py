"""A station's disk that is nearly full: what goes first, what is recorded as lost, when recording stops and goes on."""

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from events import (
    Draft,
    EventBatch,
    LossRecorded,
    SegmentsPruned,
    Station,
    StreamName,
    TrackPoint,
    decode,
    encode,
    events_of,
    schema_of,
)
from store import DiskNearlyFull, Log, Projector, open_log, verify
from store.room import Room
from sync.keeping.countersigning import VOID
from sync.keeping.losses import DiskWatch
from sync.keeping.pruning import Proof
from sync.plans.deriving import Deriver
from sync.plans.entries import derived_name
from sync.plans.plan import GiveUp, Plan
from sync.plans.planning import set_plan
from tests.store.disks import fill
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append
from tests.store.tiered import seal_all
from tests.sync.test_pruning import countersign, pruned_of, signed, whole

BRNO = Station("brno")
NOW = datetime.now(UTC)
MIB = 2**20
NOISE = StreamName.of("brno", "noise", "track_point")


class Disk:
    """A disk that has as much room as the test says."""

    def __init__(self, log: Log, min_mib: int = 64, folder: Path = Path("/")) -> None:
        self.free_mib = 1000
        log.room = Room(log._fetched, folder, lambda _: self.free_mib * MIB)
        log.room.bytes_min = min_mib * MIB


def watch(log: Log, *policy: GiveUp) -> DiskWatch:
    return DiskWatch(log, BRNO, lambda: policy, Proof(log, BRNO, signed))


def give_up(stream: str, days: int = 0) -> GiveUp:
    return GiveUp(stream=stream, older_than=timedelta(days=days))


def work(disk_watch: DiskWatch, now: datetime = NOW) -> None:
    while disk_watch.step(now):
        pass


def losses(log: Log) -> list[LossRecorded]:
    segments = log.read_all(types=[LossRecorded.type_name])
    events = [event for segment in segments for event in events_of(decode(segment, log.catalogue))]
    return [event for event in events if isinstance(event, LossRecorded)]


def test_with_room_nothing_goes(log: Log) -> None:
    Disk(log)
    append(log, GATE, 3)
    work(watch(log, give_up("*/*/*")))
    assert whole(log, GATE) == [True]


def test_without_a_policy_recording_stops_before_the_disk_is_full_and_goes_on_by_itself(log: Log) -> None:
    disk = Disk(log)
    append(log, GATE, 3)
    disk.free_mib = 63
    work(watch(log))
    for record in (lambda: append(log, GATE, 1), lambda: Projector(log).step()):
        with pytest.raises(DiskNearlyFull, match=r"63 MiB free, and 64 MiB must stay free \(setting disk_free_mb_min"):
            record()
    assert whole(log, GATE) == [True]
    disk.free_mib = 64
    append(log, GATE, 1)


def test_what_central_holds_goes_first_and_is_no_loss(log: Log, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sync.keeping.losses.SEGMENTS_MAX", 2)
    disk = Disk(log)
    append(log, GATE, 3, 2)
    append(log, YARD, 4, 4)
    countersign(log, (YARD, 4))
    disk.free_mib = 40
    work(watch(log, give_up("*/gate/track_point"), give_up("*/yard/*")))
    assert whole(log, GATE) == whole(log, YARD) == [False, False]
    assert pruned_of(log) == [(str(YARD), 1, 4, 1)]
    lost = [(each.stream, each.what, each.count, each.first_sequence, each.last_sequence) for each in losses(log)]
    assert lost == [(str(GATE), "segments", 2, 1, 5), (str(YARD), "segments", 1, 5, 8)]
    (first, _) = losses(log)
    assert first.policy == "give_up: */gate/track_point, older than 0 s"
    assert first.reason == "the disk had 40 MiB free, 64 MiB must stay free, and central lacks them"
    assert (first.lost_from_at, first.lost_until_at) == (NOON + timedelta(seconds=0.04), NOON + timedelta(seconds=0.2))
    found = verify(log, station="brno")
    assert (found.is_sound, found.hollow) == (True, 4)


def test_what_central_lost_while_the_disk_stays_low_is_recorded_as_lost(
    log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sync.keeping.losses.SEGMENTS_MAX", 1)
    disk = Disk(log)
    append(log, GATE, 3, 3, 3)
    countersign(log, (GATE, 9))
    disk.free_mib = 40
    disk_watch = watch(log, give_up("*/gate/*"))
    while not pruned_of(log):
        assert disk_watch.step(NOW)
    position = log.head()
    with log.transaction() as transaction:
        transaction.save_checkpoint(VOID, position)
    work(disk_watch)
    assert pruned_of(log) == [(str(GATE), 1, 3, 1)]
    assert [(each.first_sequence, each.last_sequence) for each in losses(log)] == [(4, 6), (7, 9)]


def test_what_happened_too_recently_and_what_no_entry_names_stays_and_then_recording_stops(log: Log) -> None:
    disk = Disk(log)
    append(log, GATE, 3)
    append(log, YARD, 3)
    disk.free_mib = 40
    work(watch(log, give_up("*/gate/*", days=7)), NOON + timedelta(days=6))
    assert (whole(log, GATE), whole(log, YARD)) == ([True], [True])
    with pytest.raises(DiskNearlyFull):
        append(log, GATE, 1)


def test_what_went_is_credit_that_recording_uses_up(log: Log) -> None:
    disk = Disk(log, min_mib=8)
    log.append([noise(number) for number in range(4)])
    size = log.room.credit()
    assert size == 0
    disk.free_mib = 5
    disk_watch = watch(log, give_up("*/noise/*"))
    work(disk_watch)
    assert len(losses(log)) == 1, "as much as is needed, and no more"
    assert log.room.credit() > MIB
    log.append([noise(9)])
    work(disk_watch)
    assert [each.last_sequence for each in losses(log)] > [1]
    disk.free_mib = 3  # less than half: what was taken off did not help
    with pytest.raises(DiskNearlyFull):
        log.append([noise(10)])
    disk.free_mib = 100
    work(disk_watch)
    assert log.room.credit() == 0


def test_sealed_files_on_the_same_disk_go_first_and_are_recorded_too(log: Log, tmp_path: Path) -> None:
    disk = Disk(log, folder=tmp_path)
    append(log, GATE, 30, 20)
    append(log, YARD, 2)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    append(log, GATE, 10)
    countersign(log, (GATE, 30))
    (before,) = log.archive.files()
    disk.free_mib = 40
    work(watch(log, give_up("*/gate/*")))
    assert (whole(log, GATE), whole(log, YARD)) == ([False] * 3, [True])
    assert pruned_of(log) == [(str(GATE), 1, 30, 1)]
    assert [(each.first_sequence, each.last_sequence) for each in losses(log)] == [(31, 50), (51, 60)]
    found = verify(log, station="brno")
    assert (found.is_sound, found.hollow) == (True, 3)
    (after,) = log.archive.files()
    assert after.bytes < before.bytes
    assert [path.name for path in (tmp_path / "_sealed").iterdir()] == [Path(after.path).name]


def test_sealed_files_that_give_this_disk_no_room_or_need_too_much_stay(log: Log, tmp_path: Path) -> None:
    disk = Disk(log, folder=tmp_path)
    append(log, GATE, 30)
    append(log, YARD, 2)
    seal_all(log, tmp_path, file_bytes=1_000_000)
    disk.free_mib = 0  # no room for what stays of the file to be written anew
    work(watch(log, give_up("*/gate/*")))
    assert whole(log, GATE) == [True]
    disk.free_mib = 40
    Disk(log, folder=Path("/proc")).free_mib = 40
    work(watch(log, give_up("*/gate/*")))
    assert whole(log, GATE) == [True]


def test_what_a_derived_stream_waits_for_goes_last_of_all_and_the_loss_says_so(log: Log) -> None:
    disk = Disk(log)
    append(log, GATE, 3)
    entries = [{"stream": "*/gate/*", "where": "true"}, {"stream": "*/*/*"}]
    planned = set_plan(log, BRNO, Plan.of({"entries": entries}), "", NOW)
    deriver = Deriver(log, BRNO)
    while deriver.step():
        pass
    append(log, GATE, 3)
    append(log, YARD, 3)
    disk.free_mib = 40
    work(watch(log, give_up("*/gate/*"), give_up("*/yard/*")))
    assert [(each.stream, each.first_sequence) for each in losses(log)] == [
        (str(GATE), 1),
        (str(YARD), 1),
        (str(GATE), 4),
    ]
    name = derived_name(GATE, planned.plan.entries[0])
    reasons = [each.reason.split("lacks them")[1] for each in losses(log)]
    assert reasons == ["", "", f"; {name} had not been derived from them"]
    disk.free_mib = 1000
    append(log, GATE, 2)
    while deriver.step():
        pass
    deriver.check()
    assert [each.header.event_count for each in log.read(name)] == [3, 2]


def test_a_policy_that_changes_counts_at_the_next_step(log: Log) -> None:
    disk = Disk(log)
    append(log, GATE, 3)
    policy: list[GiveUp] = []
    disk_watch = DiskWatch(log, BRNO, lambda: policy, Proof(log, BRNO, signed))
    disk.free_mib = 40
    work(disk_watch)
    policy.append(give_up("*/gate/*"))
    work(disk_watch, NOW + timedelta(seconds=61))
    assert whole(log, GATE) == [False]


def test_proofs_are_never_given_up(log: Log) -> None:
    disk = Disk(log)
    append(log, GATE, 3)
    countersign(log, (GATE, 3))
    disk.free_mib = 40
    work(watch(log, give_up("*/*/*")))
    assert {each.stream.type for each in log.read_all()} == {"checkpoint_countersigned", SegmentsPruned.type_name}


def test_on_a_real_small_disk_more_is_recorded_than_it_holds_and_postgresql_never_finds_it_full(
    small_disk: Path,
) -> None:
    made = [noise(number) for number in range(4)]
    with open_log(data_dir=small_disk / "log") as log:
        fill(small_disk, leave_mib=34)
        log.room.bytes_min = 24 * MIB
        disk_watch = watch(log, give_up("*/noise/*"))
        stopped = record_until_stopped(log, made * 50)
        assert stopped < 34, "the disk takes so much at most"
        for number in range(60):
            work(disk_watch)
            log.append([made[number % 4]])
        lost = sum(each.count or 0 for each in losses(log))
        assert lost > 30
        found = verify(log, station="brno")
        assert (found.is_sound, found.hollow, found.streams) == (True, lost, 2)


def record_until_stopped(log: Log, made: Sequence[Draft]) -> int:
    for number, draft in enumerate(made):
        try:
            log.append([draft])
        except DiskNearlyFull:
            return number
    pytest.fail("recording never stopped")


def noise(seed: int) -> Draft:
    """A megabyte of events that do not compress."""
    choose = np.random.default_rng(seed)
    count = 30_000
    columns = {
        field.name: pa.array(choose.random(count, np.float32)) if field.type == pa.float32() else pa.array([1] * count)
        for field in schema_of(TrackPoint)
    }
    columns["time"] = pa.array([NOON] * count, pa.timestamp("us", tz="UTC"))
    batch = EventBatch(TrackPoint, pa.RecordBatch.from_pydict(columns, schema=schema_of(TrackPoint)))
    return encode(NOISE, batch, PRODUCER)
