"""Both tiers as one: every read gives the same whichever segments are sealed, and damage is found and named."""

import random
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from events import Segment, StreamName
from store import (
    Appender,
    ArchiveUnavailable,
    ChainBroken,
    Log,
    Projector,
    SealedFileDamaged,
    Subscription,
    Verified,
    coldtier,
    sealing,
    verify,
)
from store.log import CONNECTIONS_MAX
from store.places import Place
from store.reading import Filter
from store.sealing import Sealer
from tests.conftest import MakeLog
from tests.store.samples import GATE, NOON, PRODUCER, YARD, append, draft, on_both, owner, points, query
from tests.store.test_sealing import LATER
from tests.store.tiered import seal_all, tiered

ROOF = StreamName.of("plzen", "roof", "track_point")


def fill(log: Log) -> Log:
    """Positions 1 to 12: three streams in turn, of 1, 2 and 3 events a segment; one of them has two epochs."""
    for turn in range(4):
        append(log, GATE, 1)
        append(log, YARD, 2)
        log.append([draft(ROOF, 3 * turn + 1, 3 * turn + 3)], epochs=[1 + turn // 2])
    return log


@pytest.fixture
def filled(log: Log, monkeypatch: pytest.MonkeyPatch) -> Log:
    monkeypatch.setattr(sealing, "GROUP_SEGMENTS_MAX", 2)
    return fill(log)


def seal_up_to(log: Log, folder: Path, position: int) -> None:
    """Seal the positions up to one, in files of about three segments."""
    after = next((each.recorded_at for each in log.read_all(position + 1)), LATER)
    list(Sealer(log, str(folder), file_bytes=1_500).seal(after))
    assert log.archive.sealed_position() == position


def everything(log: Log) -> dict[str, object]:
    """What each way of reading gives."""
    streams = [(GATE, 1), (YARD, 1), (ROOF, 1), (ROOF, 2)]
    last = log.head()
    return {
        "all": list(log.read_all()),
        "from": [[each.position for each in log.read_all(first)] for first in range(1, last + 2)],
        "to": [[each.position for each in log.read_all(to_position=end)] for end in range(last + 1)],
        "type": list(log.read_all(types=["track_ended"])),
        "source": list(log.read_all(sources=["yard", "roof"])),
        "station": list(log.read_all(3, stations=["plzen"])),
        "time": list(log.read_all(since=NOON + timedelta(milliseconds=120), until=NOON + timedelta(milliseconds=200))),
        "page": [log.page(first, last, Filter(sources=["gate", "roof"]), 3) for first in range(1, last + 1)],
        "stream": {
            (str(stream), epoch, at): list(log.read(stream, at, epoch=epoch))
            for stream, epoch in streams
            for at in range(1, 14)
        },
        "newest epoch": list(log.read(ROOF)),
        "nothing": [list(log.read(StreamName.of("no", "such", "stream"))), list(log.read(GATE, 99))],
        "heads": log.heads(),
        "head at": [log.stream_head(s, epoch=e, at_position=at) for s, e in streams for at in [*range(last + 1), None]],
    }


@on_both
def test_every_read_gives_the_same_wherever_the_segments_are(filled: Log, tmp_path: Path) -> None:
    wanted = everything(filled)
    for sealed in (1, 6, 11, 12):
        seal_up_to(filled, tmp_path, sealed)
        assert everything(filled) == wanted, f"sealed up to {sealed}"
    assert verify(filled).is_sound
    assert (verify(filled).segments, verify(filled).streams) == (12, 4)


def test_every_read_goes_on_from_file_to_file_however_many(
    filled: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("FILES_AT_A_TIME", "FILES_KEPT", "GROUPS_KEPT"):
        monkeypatch.setattr(coldtier, name, 1)
    wanted = everything(filled)
    seal_all(filled, tmp_path, file_bytes=1)
    assert everything(filled) == wanted


def test_another_handle_that_knows_nothing_of_the_sealing_reads_the_same(filled: Log, tmp_path: Path) -> None:
    wanted = list(filled.read_all())
    with Log(filled.dsn, filled.catalogue) as other:
        at_all, at_stream = iter(other.read_all()), iter(other.read(GATE))
        first, first_of_stream = next(at_all), next(at_stream)
        assert list(other.page(1, 3, Filter(), 9)) == wanted[:3]
        seal_all(filled, tmp_path)
        assert list(other.page(2, 12, Filter(), 4)) == wanted[1:5]
        assert [first, *at_all] == wanted
        assert [first_of_stream, *at_stream] == [each for each in wanted if each.stream == GATE]


def test_a_range_that_moves_between_two_pages_is_read_once(
    filled: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("store.log.READ_SEGMENTS", 2)
    wanted = list(filled.read_all())
    for turn in (1, 3, 5):
        found: list[Segment] = []
        for segment in filled.read_all():
            found.append(segment)
            if len(found) == turn:
                seal_up_to(filled, tmp_path, 2 * turn)
        assert found == wanted


def test_a_subscriber_that_lags_behind_what_is_sealed_misses_nothing(filled: Log, tmp_path: Path) -> None:
    wanted = list(filled.read_all())
    with Subscription(filled, "slow", limit=2) as subscription:
        found = subscription.poll().segments
        seal_up_to(filled, tmp_path, 9)
        while not (delivery := subscription.poll()).is_caught_up:
            found += delivery.segments
        assert found + delivery.segments == wanted
        append(filled, GATE, 1)
        seal_all(filled, tmp_path)
        assert [segment.position for segment in subscription.poll().segments] == [13]


def test_rows_are_projected_from_sealed_segments_too(filled: Log, tmp_path: Path) -> None:
    seal_up_to(filled, tmp_path, 7)
    projector = Projector(filled)
    projector.catch_up()
    projector.close()
    assert query(filled, "select count(*), count(distinct position) from track_point") == [(24, 12)]


def test_only_files_that_can_hold_what_is_wanted_are_opened(
    filled: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seal_all(filled, tmp_path, file_bytes=1)
    opened: list[int] = []
    real = coldtier.ColdTier._opened

    def counting(self: coldtier.ColdTier, file: coldtier.SealedFile, first: int) -> coldtier.SealedReader:
        opened.append(file.first_position)
        return real(self, file, first)

    monkeypatch.setattr(coldtier.ColdTier, "_opened", counting)
    for read, wanted in (
        (lambda log: log.read_all(sources=["yard"]), [2, 5, 8, 11]),
        (lambda log: log.read_all(since=NOON + timedelta(milliseconds=40 * 9)), [9, 12]),
        (lambda log: log.read_all(4, to_position=5), [4, 5]),
        (lambda log: log.read(YARD, 5), [8, 11]),
        (lambda log: [log.stream_head(GATE, at_position=9)], []),
    ):
        opened.clear()
        with Log(filled.dsn, filled.catalogue) as log:
            assert list(read(log))
        assert opened == wanted


# Damage.


@pytest.fixture
def sealed(filled: Log, tmp_path: Path) -> Path:
    """The folder of the archive of positions 1 to 12, in several files."""
    seal_all(filled, tmp_path)
    return tmp_path


def fresh(log: Log) -> Log:
    """Another handle, which has nothing in memory."""
    return Log(log.dsn, log.catalogue)


def flip(path: Path, offset: int, bit: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 1 << bit
    path.write_bytes(data)


def test_one_flipped_bit_anywhere_in_a_sealed_file_is_found_and_located(filled: Log, sealed: Path) -> None:
    files = {
        Path(path).name: (first, last)
        for path, first, last in query(filled, "select path, first_position, last_position from sealed_files")
    }
    choose = random.Random(20260101)
    with fresh(filled) as log:
        assert verify(log).is_sound
    for number in range(60):
        name = choose.choice(sorted(files))
        path = sealed / "_sealed" / name
        whole = path.read_bytes()
        offset = number if number < 8 else choose.randrange(len(whole))
        flip(path, offset, choose.randrange(8))
        with fresh(filled) as log:
            found = verify(log)
        first, last = files[name]
        assert not found.is_sound, (name, offset)
        assert any(first <= (fault.position or 0) <= last for fault in found.broken), (name, offset, found.broken)
        assert any(name in str(fault) for fault in found.broken), (offset, found.broken)
        path.write_bytes(whole)
    with fresh(filled) as log:
        assert verify(log).is_sound


def corrupted(path: Path, column: str) -> None:
    """Flip a bit of the last value of a column in the file's first row group, which is stored as it is."""
    file = pq.ParquetFile(path)
    value = file.read_row_group(0).column(column).to_pylist()[-1]
    data = path.read_bytes()
    flip(path, data.index(value) + len(value) - 1, 0)


@pytest.mark.parametrize("column, said", [("payload", "the payload's hash is"), ("chain_hash", "the chain hash is")])
def test_a_changed_segment_is_named_by_its_position(filled: Log, sealed: Path, column: str, said: str) -> None:
    corrupted(sorted((sealed / "_sealed").glob("*"))[0], column)
    with fresh(filled) as log:
        found = verify(log)
    file, segment = found.broken
    assert (segment.stream, segment.position) == (YARD, 2)
    assert said in str(segment)
    assert "has changed: its SHA-256 is" in str(file)


def test_a_changed_payload_is_not_given_out(filled: Log, sealed: Path) -> None:
    path = sorted((sealed / "_sealed").glob("*"))[0]
    corrupted(path, "payload")
    with fresh(filled) as log, pytest.raises(ChainBroken, match=f"position 2, .*in the sealed file {path}"):
        list(log.read_all())
    with fresh(filled) as log:
        assert [segment.position for segment in log.read_all(3)] == list(range(3, 13))


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-4])])
def test_a_file_that_is_gone_or_cut_off_is_named_with_the_next_step(
    filled: Log, sealed: Path, harm: Callable[[Path], object]
) -> None:
    path = sorted((sealed / "_sealed").glob("*"))[1]
    ((first, last),) = query(
        filled, "select first_position, last_position from sealed_files where path like %s", f"%{path.name}"
    )
    copy = path.read_bytes()
    harm(path)
    with fresh(filled) as log:
        assert [segment.position for segment in log.read_all(to_position=first - 1)] == list(range(1, first))
        with pytest.raises(SealedFileDamaged, match=rf"positions {first} to {last}: the sealed file {path} .*Next: "):
            list(log.read_all())
        found = verify(log)
        assert [str(fault) for fault in found.broken if path.name in str(fault)] != []
        assert {fault.position for fault in found.broken} == {first}
        assert found.segments == 12 - (last - first + 1)
        path.write_bytes(copy)
        assert len(list(log.read_all())) == 12, "the file was brought back while the log was open"


@pytest.mark.parametrize("harm", [Path.unlink, lambda path: path.write_bytes(path.read_bytes()[:-4])])
def test_a_verification_that_goes_on_still_misses_files_that_were_verified_before(
    filled: Log, sealed: Path, harm: Callable[[Path], object]
) -> None:
    before = verify(filled).verified
    assert before is not None
    path = sorted((sealed / "_sealed").glob("*"))[1]
    copy = path.read_bytes()
    harm(path)
    with fresh(filled) as log:
        (fault,) = verify(log, before=before).broken
        assert isinstance(fault, SealedFileDamaged)
        assert path.name in str(fault)
        path.write_bytes(copy)
        again = verify(log, before=before)
        assert (again.is_sound, again.segments) == (True, 0)
        sealed.rename(sealed.with_name(f"{sealed.name}-elsewhere"))
        with pytest.raises(ArchiveUnavailable, match="is not at"):
            verify(log, before=before)


def test_a_verification_that_goes_on_reads_each_file_that_was_sealed_since(
    filled: Log, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []
    digest = Place.digest

    def noted(place: Place, path: str) -> tuple[bytes, int]:
        read.append(path)
        return digest(place, path)

    monkeypatch.setattr(Place, "digest", noted)
    before = verify(filled).verified
    assert before is not None
    seal_all(filled, tmp_path)
    read.clear()
    after = verify(filled, before=Verified.from_text(before.to_text("this"), "this"))
    assert after.segments == 0
    assert after.verified is not None
    assert read == [path for (path,) in query(filled, "select path from sealed_files order by first_position")]
    read.clear()
    assert verify(filled, before=Verified.from_text(after.verified.to_text("this"), "this")).is_sound
    assert read == []
    path = tmp_path / query(filled, "select max(path) from sealed_files")[0][0]
    flip(path, path.stat().st_size // 2, 0)
    (fault,) = verify(filled, before=before).broken
    assert path.name in str(fault)


def test_an_archive_that_is_away_is_told_and_can_come_back(filled: Log, sealed: Path) -> None:
    moved = sealed.with_name("elsewhere")
    sealed.rename(moved)
    with fresh(filled) as log:
        for read in (log.read_all, lambda: log.read(GATE)):
            with pytest.raises(ArchiveUnavailable, match=f"is not at {sealed}. Next: mount or bring back"):
                list(read())
        with pytest.raises(ArchiveUnavailable):
            verify(log)
        assert log.head() == 12
        append(log, GATE, 1)
        assert [segment.position for segment in log.read_all(13)] == [13]
        shutil.move(moved, sealed)
        assert len(list(log.read_all())) == 13


CHANGES = {
    "sealed_ranges": [
        "first_sequence = first_sequence + 1", "last_sequence = last_sequence + 1", "last_position = last_position - 1",
        "first_position = first_position + 1", "time_min = time_min - interval '1 us'", "time_max = 'infinity'",
        "chain_hash = set_byte(chain_hash, 5, get_byte(chain_hash, 5) # 1)",
    ],
    "sealed_files": [
        "segments = segments + 1", "events = events + 1", "time_min = time_min - interval '1 us'", "bytes = bytes + 1",
        "sha256 = set_byte(sha256, 5, get_byte(sha256, 5) # 1)", "last_position = last_position + 1", "path = 'x'",
    ],
}  # fmt: skip


def test_a_changed_index_is_found_and_the_file_named(filled: Log, sealed: Path) -> None:
    with owner(filled) as connection, fresh(filled) as log:
        for table, changes in CHANGES.items():
            connection.execute(f"alter table {table} disable trigger user")
            key = "file" if table == "sealed_ranges" else "first_position"
            for change in changes:
                connection.execute(f"create table saved as select * from {table}")
                last = "(select max(first_position) from sealed_files)"
                connection.execute(f"update {table} set {change} where {key} = {last}")
                found = verify(log)
                ((first,),) = connection.execute(f"select {last}").fetchall()
                assert any((fault.position or 0) >= first for fault in found.broken), (change, found.broken)
                connection.execute(f"alter table {table} disable trigger all")
                connection.execute(f"delete from {table}")
                connection.execute(f"insert into {table} select * from saved")
                connection.execute("drop table saved")
        assert verify(log).is_sound


# Other places.


@pytest.mark.parametrize("scheme", ["file", "memory"])
def test_the_archive_may_lie_in_any_file_system_that_pyarrow_or_fsspec_knows(
    make_log: MakeLog, tmp_path: Path, scheme: str
) -> None:
    log = fill(make_log())
    wanted = everything(log)
    url = f"file://{tmp_path}/archive" if scheme == "file" else f"memory:/{tmp_path}"
    list(Sealer(log, url, file_bytes=1_500).seal(LATER))
    assert query(log, "select count(*) from segments") == [(0,)]
    assert everything(log) == wanted
    assert verify(log).is_sound


def test_an_appender_that_says_sealed_events_again_stores_nothing_twice(log: Log, tmp_path: Path) -> None:
    tiered(log, tmp_path)
    for _ in range(2):
        appender = Appender(log, PRODUCER)
        appender.resume_at(GATE, 0)
        for first in (1, 3, 5):
            appender.append([(GATE, points(first, first + 1))])
    assert [segment.header.first_sequence for segment in log.read(GATE)] == [1, 3, 5]
    assert query(log, "select count(*) from segments") == [(0,)]
    assert verify(log).is_sound


def test_more_threads_than_connections_that_send_sealed_segments_again_do_not_wait_for_each_other(
    log: Log, tmp_path: Path
) -> None:
    append(log, GATE, 2, 2)
    seal_all(log, tmp_path)
    sent = [draft(GATE, 1, 2), draft(GATE, 3, 4)]
    with ThreadPoolExecutor(3 * CONNECTIONS_MAX) as pool:
        answers = [pool.submit(log.append, sent, [0, 2]) for _ in range(3 * CONNECTIONS_MAX)]
        assert all(each.was_there for answer in answers for each in answer.result(30))
