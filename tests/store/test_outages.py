"""The database dies, stops or fills its disk while it is appended to: nothing is lost, nothing is doubled."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from events import Catalogue, EventBatch, StreamName, TrackPoint, decode, schema_of
from store import Appender, Log, LogUnavailable, Projector, Subscription, open_log, verify
from store.embedded import EmbeddedServer
from tests.store.disks import fill
from tests.store.samples import GATE, NOON, PRODUCER, YARD, owner, points, query
from tests.store.servers import kill_server

NOISE = StreamName.of("brno", "noise", "track_point")

KILL_ONCE = (
    "copy (select 1) to program "
    "'cat > /dev/null; mkdir killed 2> /dev/null && kill -9 $(head -n 1 postmaster.pid) $PPID || true'"
)
"""Run by the server in its data directory: kills its first process and the one that serves us, once."""


def frames(log: Log, stream: StreamName) -> list[int]:
    return [n for s in log.read(stream) for n in decode(s, log.catalogue).data.column("frame").to_pylist()]


def assert_whole(log: Log, last: int) -> None:
    """Both streams hold the frames 1 to `last`, once; positions have no hole; chain and rows agree."""
    assert frames(log, GATE) == frames(log, YARD) == list(range(1, last + 1))
    segments = list(log.read_all())
    assert [segment.position for segment in segments] == list(range(1, len(segments) + 1))
    assert verify(log).broken == []
    projector = Projector(log)
    projector.catch_up()
    projector.close()
    assert query(log, "select count(*), count(distinct id) from events") == [(2 * last, 2 * last)]


def append_frame(appender: Appender, frame: int) -> None:
    appender.append([(GATE, points(frame, frame)), (YARD, points(frame, frame))])


def test_a_server_killed_in_the_middle_of_an_append_is_started_again(data_dir: Path) -> None:
    waits: list[LogUnavailable] = []
    with open_log(data_dir=data_dir) as log:
        with owner(log) as connection:
            connection.execute(
                "create function kill_server() returns trigger language plpgsql security definer as "
                f"$$ begin if new.position > 8 then {KILL_ONCE}; end if; return new; end $$"
            )
            connection.execute(
                "create trigger kill_server before insert on segments for each row execute function kill_server()"
            )
        appender = Appender(log, PRODUCER, on_wait=waits.append)
        with Subscription(log, "reader") as subscription:
            for frame in range(1, 11):
                append_frame(appender, frame)
            assert [segment.position for segment in subscription.poll().segments] == list(range(1, 21))
        assert (data_dir / "pg" / "killed").is_dir(), "the server was never killed"
        assert len(waits) == 1
        assert_whole(log, 10)


def test_a_server_killed_between_two_appends_is_started_again(data_dir: Path) -> None:
    waits: list[LogUnavailable] = []
    with open_log(data_dir=data_dir) as log:
        appender = Appender(log, PRODUCER, on_wait=waits.append)
        for frame in range(1, 7):
            if frame in (3, 5):
                kill_server(data_dir)
            append_frame(appender, frame)
        assert len(waits) == 2
        assert_whole(log, 6)


def test_an_external_database_that_stops_and_is_back_is_waited_for(data_dir: Path) -> None:
    elsewhere = EmbeddedServer(data_dir)
    open_log(dsn=elsewhere.dsn).close()
    waits: list[LogUnavailable] = []
    pauses: list[float] = []

    def be_back_at_the_third_pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 3:
            elsewhere.ensure_running()

    with Log(elsewhere.dsn, Catalogue.shipped()) as log, Subscription(log, "reader") as subscription:
        appender = Appender(log, PRODUCER, on_wait=waits.append, sleep=be_back_at_the_third_pause)
        append_frame(appender, 1)
        assert len(subscription.poll(30).segments) == 2
        subscription.poll(0.01)
        elsewhere.close()
        with pytest.raises(LogUnavailable, match="is away"):
            subscription.poll()
        append_frame(appender, 2)
        append_frame(appender, 3)
        assert [segment.position for segment in subscription.poll().segments] == [3, 4, 5, 6]
        assert (len(waits), len(pauses)) == (1, 3)
        assert_whole(log, 3)
    elsewhere.close()


def test_a_new_log_on_a_full_disk_is_refused_and_succeeds_when_there_is_room(small_disk: Path) -> None:
    ballast = fill(small_disk, leave_mib=8)
    with pytest.raises(LogUnavailable, match=r"cannot be made in .*No space left on device.* MiB free on that disk"):
        open_log(data_dir=small_disk / "log")
    assert [path.name for path in (small_disk / "log").iterdir()] == ["pg.lock"]
    ballast.unlink()
    with open_log(data_dir=small_disk / "log") as log:
        assert log.head() == 0


def test_a_server_that_died_on_a_full_disk_is_told_of_with_the_room_left(small_disk: Path) -> None:
    with open_log(data_dir=small_disk / "log") as log:
        ballast = fill(small_disk, leave_mib=3)
        kill_server(small_disk / "log")
        with pytest.raises(
            LogUnavailable, match=r"its disk is full \([23] MiB free, .*Next: make room; what waits goes on"
        ):
            log.head()
        ballast.unlink()
        assert log.with_retry(log.head) == 0


def test_a_disk_that_fills_while_events_come_is_waited_for_until_there_is_room(small_disk: Path) -> None:
    waits: list[str] = []
    with open_log(data_dir=small_disk / "log") as log:
        ballast = fill(small_disk, leave_mib=12)
        appender = Appender(
            log,
            PRODUCER,
            on_wait=lambda error: waits.append(str(error)),
            sleep=lambda _: ballast.unlink(missing_ok=True),
        )
        frame = 0
        while ballast.exists():
            frame += 1
            assert frame < 100, "the disk never filled"
            append_frame(appender, frame)
            appender.append([(NOISE, noise(frame))])
        append_frame(appender, frame + 1)
        assert len(waits) == 1
        assert frames(log, GATE) == frames(log, YARD) == list(range(1, frame + 2))
        assert log.stream_head(NOISE).sequence == frame * len(noise(1))
        assert [segment.position for segment in log.read_all()] == list(range(1, 3 * frame + 3))
        assert verify(log).broken == []


def noise(seed: int) -> EventBatch:
    """A megabyte of events that do not compress."""
    choose = np.random.default_rng(seed)
    count = 30_000
    columns = {
        field.name: pa.array(choose.random(count, np.float32)) if field.type == pa.float32() else pa.array([1] * count)
        for field in schema_of(TrackPoint)
    }
    columns["time"] = pa.array([NOON] * count, pa.timestamp("us", tz="UTC"))
    return EventBatch(TrackPoint, pa.RecordBatch.from_pydict(columns, schema=schema_of(TrackPoint)))
