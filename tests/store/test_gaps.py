"""Streams with gaps, and what follows chains: verification, signatures, backups, sealed files."""

import hashlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import psycopg
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from events import Catalogue, Segment, StreamName
from store import (
    BackupDamaged,
    ChainBroken,
    Log,
    Sealer,
    Signer,
    Verified,
    back_up,
    known_keys,
    load_key,
    make_key,
    restore,
    verify,
)
from store import backup_files as files
from store.verification import Gap
from tests.conftest import MakeLog, Server
from tests.store.replicas import deliver
from tests.store.samples import GATE, NOON, YARD, append, on_both, owner, query

LATER = datetime.now(UTC) + timedelta(days=2)


@pytest.fixture
def origin(make_log: MakeLog) -> Log:
    """The station's own log."""
    return make_log()


@pytest.fixture
def sent(origin: Log) -> list[Segment]:
    """What a station has to send: ten segments of ten events."""
    append(origin, GATE, *[10] * 10)
    return list(origin.read(GATE))


@pytest.fixture
def gapped(log: Log, sent: list[Segment]) -> Log:
    """Sequences 1 to 20, 41 to 70 and 91 to 100, the middle of it begun last and met from below; another stream."""
    deliver(log, sent, 0)
    append(log, YARD, 3)
    deliver(log, sent, 9)
    deliver(log, sent, 5, 1)
    deliver(log, sent, 6)
    deliver(log, sent, 4)
    assert [(run.after, run.sequence) for run in log.runs(GATE)] == [(0, 20), (40, 70), (90, 100)]
    return log


@pytest.fixture
def tampering(gapped: Log) -> "Iterator[psycopg.Connection[Any]]":
    """What the database's owner can do who has disabled the triggers."""
    with owner(gapped) as connection:
        for table in ("segments", "stream_bases"):
            connection.execute(f"alter table {table} disable trigger user")
        yield connection


def the_break(log: Log) -> ChainBroken:
    (broken,) = verify(log).broken
    return broken


# Verification.


@on_both
def test_a_gap_that_was_meant_is_named_and_is_no_break(gapped: Log) -> None:
    found = verify(gapped)
    assert found.broken == []
    assert found.gaps == (Gap(GATE, 1, 21, 40), Gap(GATE, 1, 71, 90))
    assert (found.segments, found.events, found.streams) == (7, 63, 2)


def test_a_gap_without_a_base_is_a_break(gapped: Log, tampering: "psycopg.Connection[Any]") -> None:
    tampering.execute("delete from stream_bases where sequence = 90")
    broken = the_break(gapped)
    assert (broken.stream, broken.position) == (GATE, 3)
    assert "sequences 11 to 90 are missing" in str(broken)


FLIPPED = "set_byte({0}, 3, get_byte({0}, 3) # 1)"
FLIP = f"update stream_bases set chain_hash = {FLIPPED.format('chain_hash')}"
FLIP_FILLED = f"filled_hash = {FLIPPED.format('filled_hash')}"
LIES: dict[str, tuple[str, int, str]] = {
    "a hash": (f"{FLIP} where sequence = 90", 3, "the chain hash is"),
    "a hash where two runs are one": (f"{FLIP}, {FLIP_FILLED} where sequence = 50", 4, "the chain hash is"),
    "a position": (
        "update stream_bases set position = 2 where sequence = 90",
        3,
        "the base at sequence 90 says that a run begins at position 2",
    ),
    "a sequence": ("update stream_bases set sequence = 80 where sequence = 90", 3, "sequences 11 to 90 are missing"),
    "how far it is filled": (
        "update stream_bases set filled_sequence = 60 where sequence = 90",
        6,
        "its sequences 41 to 70 are not what its head and bases say",
    ),
    "the hash of what is filled": (
        f"update stream_bases set {FLIP_FILLED} where sequence = 90",
        6,
        "its sequences 41 to 70 are not what its head and bases say",
    ),
    "a base where no run begins": (
        "insert into stream_bases select stream_id, 95, chain_hash, 3, 95, chain_hash from stream_bases limit 1",
        3,
        "it has a base at sequence 95, position 3, where no run begins",
    ),
    "a base in a gap": (
        (
            "insert into stream_bases select stream_id, 80, chain_hash, 7, filled_sequence, filled_hash "
            "from stream_bases where sequence = 90"
        ),
        7,
        "it has a base at sequence 80",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_base_that_lies_is_found(gapped: Log, tampering: "psycopg.Connection[Any]", lie: str) -> None:
    change, position, said = LIES[lie]
    tampering.execute("alter table stream_bases drop constraint stream_bases_filled")
    tampering.execute(change)
    broken = the_break(gapped)
    assert (broken.stream, broken.position) == (GATE, position)
    assert said in str(broken)


@pytest.mark.parametrize(
    "position, said",
    [
        (5, "sequences 11 to 20 are missing"),
        (6, "sequences 61 to 70 are missing"),
        (7, "a base at sequence 40, position 7, where no run begins"),
    ],
)
def test_a_segment_that_is_missing_below_a_base_is_found(
    gapped: Log, tampering: "psycopg.Connection[Any]", position: int, said: str
) -> None:
    tampering.execute("delete from segments where position = %s", (position,))
    broken = the_break(gapped)
    assert (broken.stream, broken.position) == (GATE, position)
    assert said in str(broken)


def test_a_verification_goes_on_with_every_open_end(log: Log, sent: list[Segment]) -> None:
    before: Verified | None = None
    for number in (3, 8, 5, 0, 1, 6, 2, 9, 4, 7):
        deliver(log, sent, number)
        found = verify(log, before=before)
        assert (found.broken, found.segments) == ([], 1)
        assert found.gaps == verify(log).gaps
        assert found.verified is not None
        before = Verified.from_text(found.verified.to_text("this"), "this")
        assert before == found.verified
    assert found.gaps == ()


def test_a_lower_run_that_changed_since_is_found(
    gapped: Log, sent: list[Segment], tampering: "psycopg.Connection[Any]"
) -> None:
    before = verify(gapped).verified
    assert before is not None
    tampering.execute("delete from segments where position = 5")
    found = verify(gapped, before=before)
    assert (found.since, [each.position for each in found.broken]) == (0, [5])


# Signatures.


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    make_key(tmp_path / "station.key")
    return tmp_path / "station.key"


@pytest.fixture
def signer_of(key_file: Path) -> Callable[[Log], Signer]:
    times = iter(NOON + timedelta(minutes=minute) for minute in range(1000))
    return lambda log: Signer(log, "brno", lambda: load_key(key_file), lambda: next(times))


def test_every_end_of_a_stream_is_signed_and_the_next_signer_goes_on_from_them(
    log: Log, sent: list[Segment], signer_of: Callable[[Log], Signer], key_file: Path
) -> None:
    lasting = signer_of(log)
    for turn, number in enumerate((3, 8, 5, 0, 1, 6, 2, 9, 4, 7)):
        deliver(log, sent, number)
        signed = (signer_of(log) if turn % 3 else lasting).sign()
        assert signed is not None
        ends = [head.sequence for head in signed.statement.heads if head.stream == GATE]
        assert ends == [run.sequence for run in log.runs(GATE)]
        found = verify(log, station="brno", trusted=known_keys(key_file))
        assert found.broken == []
        assert found.covered[0].events == 10 * (turn + 1) + turn  # the checkpoints before this one, too
    assert found.gaps == ()


def test_a_run_that_was_not_signed_is_found(
    gapped: Log, signer_of: Callable[[Log], Signer], tampering: "psycopg.Connection[Any]", key_file: Path
) -> None:
    assert signer_of(gapped).sign() is not None
    tampering.execute("update stream_bases set chain_hash = filled_hash where sequence = 90")
    assert not verify(gapped, station="brno", trusted=known_keys(key_file)).is_sound


def test_a_stations_signature_covers_what_is_here_of_it(
    origin: Log, log: Log, signer_of: Callable[[Log], Signer]
) -> None:
    append(origin, GATE, *[10] * 4)
    assert signer_of(origin).sign() is not None
    append(origin, GATE, *[10] * 2)
    assert signer_of(origin).sign() is not None
    sent = list(origin.read(GATE))
    checkpoints = list(origin.read(StreamName.of("brno", "log", "checkpoint_signed")))
    deliver(log, sent, 5)
    deliver(log, checkpoints, 0, 1)
    found = verify(log)
    assert (found.broken, found.covered[0].events) == ([], 10 + 1)
    deliver(log, sent, 2, 3, 4)
    found = verify(log)
    assert (found.broken, found.covered[0].events) == ([], 40 + 1)


# Backups.


@on_both
def test_a_backup_brings_runs_and_bases_back(log: Log, sent: list[Segment], tmp_path: Path, server: Server) -> None:
    for number in (8, 3, 0, 5, 2):
        deliver(log, sent, number)
        back_up(log, tmp_path / "backup")
    with restored(server, tmp_path / "backup") as other:
        assert other.standing() == log.standing()
        assert query(other, BASES) == query(log, BASES)
        deliver(other, sent, 1, 4, 6, 7, 9)
        found = verify(other)
        assert (found.broken, found.gaps) == ([], ())


@contextmanager
def restored(server: Server, folder: Path) -> Iterator[Log]:
    """The log that a backup becomes."""
    name = server.create_database()
    try:
        restore(server.dsn(name), folder)
        with Log(server.dsn(name), Catalogue.shipped()) as log:
            yield log
    finally:
        server.drop_database(name)


BASES = """
select s.source, b.sequence, b.chain_hash, b.position, b.filled_sequence, b.filled_hash
from stream_bases b join streams s on s.id = b.stream_id order by 1, 2
"""


def test_a_backup_with_a_base_that_lies_is_refused(gapped: Log, tmp_path: Path, server: Server) -> None:
    manifest = back_up(gapped, tmp_path).manifest
    strange = manifest.bases[0].model_copy(update={"chain_hash": "11" * 32})
    for bases in ((), (strange, *manifest.bases[1:]), manifest.bases[:1]):
        files.write_manifest(tmp_path, manifest.model_copy(update={"bases": bases}))
        name = server.create_database()
        try:
            with pytest.raises(BackupDamaged):
                restore(server.dsn(name), tmp_path)
        finally:
            server.drop_database(name)


def test_a_base_that_lies_does_not_creep_into_a_backup(
    gapped: Log, tampering: "psycopg.Connection[Any]", tmp_path: Path
) -> None:
    tampering.execute("update stream_bases set chain_hash = filled_hash where sequence = 90")
    with pytest.raises(ChainBroken, match="the chain hash is"):
        back_up(gapped, tmp_path)


# Sealed files.


SEALED = [(1, 10, 3), (11, 20, 5), (21, 30, 5), (31, 40, 1), (41, 50, 5), (51, 60, 3), (81, 90, 1)]


@on_both
def test_what_fills_a_gap_is_sealed_later_than_what_is_above_it(log: Log, sent: list[Segment], tmp_path: Path) -> None:
    for number in (8, 3, 0, 5, 2, 4, 1):
        deliver(log, sent, number)
        if number in (3, 5, 1):
            list(Sealer(log, str(tmp_path), file_bytes=2_000 if number == 3 else 1_000_000).seal(LATER))
    assert query(log, "select count(*) from segments") == [(0,)]
    assert query(log, "select first_sequence, last_sequence, file from sealed_ranges order by 1") == SEALED
    assert [segment.header.first_sequence for segment in log.read(GATE)] == [1, 11, 21, 31, 41, 51, 81]
    assert [segment.header.first_sequence for segment in log.read(GATE, 35)] == [31, 41, 51, 81]
    assert [segment.header.first_sequence for segment in log.read(GATE, 61)] == [81]
    assert log.stream_head(GATE, at_position=1).sequence == log.stream_head(GATE, at_position=7).sequence == 90
    found = verify(log)
    assert (found.broken, found.gaps) == ([], (Gap(GATE, 1, 61, 80),))
    assert [each.was_there for each in deliver(log, sent, 0, 3, 8)] == [True] * 3
    deliver(log, sent, 7, 6)
    assert [segment.chain_hash for segment in log.read(GATE)] == [segment.chain_hash for segment in sent[:9]]


def test_sealed_files_of_a_stream_with_gaps_verify_as_the_page_says(
    log: Log, sent: list[Segment], tmp_path: Path
) -> None:
    """docs/reference/archive.md, with pyarrow and hashlib alone."""
    for number in (8, 3, 0, 5, 2, 4, 9, 1):
        deliver(log, sent, number)
    list(Sealer(log, str(tmp_path), file_bytes=3_000).seal(LATER))
    given, known = {}, {0: bytes(32)}
    for path in sorted((tmp_path / "_sealed").iterdir()):
        ends: dict[int, bytes] = {}
        for row in pq.read_table(path).to_pylist():
            before = row["first_sequence"] - 1
            previous = row["previous_chain_hash"]
            if previous is None:
                previous = ends[before]
            else:
                given[before] = previous
            assert hashlib.sha256(previous + row["header"] + row["payload_hash"]).digest() == row["chain_hash"]
            ends[before + row["event_count"]] = known[before + row["event_count"]] = row["chain_hash"]
    assert {before: chain_hash for before, chain_hash in given.items() if known.get(before) != chain_hash} == {
        80: sent[7].chain_hash  # not here yet
    }


# All orders.


@st.composite
def deliveries(draw: st.DrawFn) -> list[tuple[tuple[int, ...], str]]:
    """Every segment of eight, in any order, some again, in calls of one or more; what is done after each call."""
    order = draw(st.permutations(range(8)))
    calls: list[tuple[tuple[int, ...], str]] = []
    while order:
        size = draw(st.integers(1, 3))
        call, order = tuple(order[:size]), order[size:]
        calls.append((call, draw(st.sampled_from(("nothing", "seal", "sign", "send again")))))
    return calls


@given(st.lists(st.integers(1, 3), min_size=8, max_size=8), st.data())
@settings(max_examples=10, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_order_of_delivery_ends_in_the_same_segments(
    log: Log,
    origin: Log,
    server: Server,
    signer_of: Callable[[Log], Signer],
    tmp_path: Path,
    sizes: list[int],
    data: st.DataObject,
) -> None:
    stream = StreamName.of("brno", f"cam-{len(origin.streams())}", "track_point")
    append(origin, stream, *sizes)
    sent = list(origin.read(stream))
    before = verify(log).verified
    calls = data.draw(deliveries())
    moment = data.draw(st.sampled_from(calls))
    for call, then in calls:
        deliver(log, sent, *call)
        if then == "seal":
            list(Sealer(log, str(tmp_path / "archive")).seal(LATER))
        elif then == "sign":
            signer_of(log).sign()
        elif then == "send again":
            assert all(each.was_there for each in deliver(log, sent, *call))
        found = verify(log, before=before)
        assert found.broken == []
        before = found.verified
        if (call, then) == moment:
            back_up(log, tmp_path / "backup")
            with restored(server, tmp_path / "backup") as other:
                assert (other.standing(), list(other.read_all())) == (log.standing(), list(log.read_all()))
                assert query(other, BASES) == query(log, BASES)
        held = [(run.after, run.sequence) for run in log.runs(stream)]
        assert [each for each in found.gaps if each.stream == stream] == gaps_of(stream, held)
    assert [segment.chain_hash for segment in log.read(stream)] == [segment.chain_hash for segment in sent]
    assert len(log.runs(stream)) == 1
    assert verify(log).broken == []


def gaps_of(stream: StreamName, held: list[tuple[int, int]]) -> list[Gap]:
    ends = [0, *(sequence for _, sequence in held)]
    return [Gap(stream, 1, end + 1, after) for end, (after, _) in zip(ends, held, strict=False) if after > end]
