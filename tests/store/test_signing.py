"""Signed checkpoints: what is signed, by whom, and what verification then finds."""

import random
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import psycopg
import pytest

from events import StreamName, batch_of, encode
from store import (
    BadProof,
    ChainBroken,
    Covered,
    Log,
    SignedCheckpoint,
    Signer,
    StationKey,
    Verified,
    known_keys,
    load_key,
    make_key,
    verify,
)
from store.keys import keep_public
from store.proof import NO_HASH, SOURCE, checkpoint_of, event_of, heads_hash, statement_bytes, statement_hash
from store.signing import PRODUCER
from tests.store.samples import GATE, NOON, YARD, append, draft, on_both, owner

CHECKPOINTS = StreamName.of("brno", SOURCE, "checkpoint_signed")
FOREIGN = StreamName.of("plzen", "roof", "track_point")


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    make_key(tmp_path / "station.key")
    return tmp_path / "station.key"


@pytest.fixture
def signer(log: Log, key_file: Path) -> Signer:
    return signer_of(log, key_file)


def signer_of(log: Log, key_file: Path, station: str = "brno") -> Signer:
    times = (NOON + timedelta(minutes=minute) for minute in range(1000))
    return Signer(log, station, lambda: load_key(key_file), lambda: next(times))


def signed(signer: Signer) -> SignedCheckpoint:
    checkpoint = signer.sign()
    assert checkpoint is not None
    return checkpoint


def breaks(log: Log, **options: Any) -> list[ChainBroken]:
    return verify(log, station="brno", **options).broken


@pytest.fixture
def tampering(log: Log) -> "Iterator[psycopg.Connection[Any]]":
    with owner(log) as connection:
        connection.execute("alter table segments disable trigger user")
        yield connection


# What is signed.


@on_both
def test_a_checkpoint_says_where_all_streams_stand(log: Log, signer: Signer) -> None:
    append(log, GATE, 2, 3)
    append(log, YARD, 4)
    heads = log.streams()
    statement = signed(signer).statement
    assert (statement.station, statement.epoch, statement.position, statement.time) == ("brno", 1, 3, NOON)
    assert sorted(statement.heads, key=lambda head: head.stream) == heads
    assert (log.head(), log.stream_head(CHECKPOINTS).sequence) == (4, 1)


def test_a_checkpoint_names_the_one_before(log: Log, signer: Signer) -> None:
    append(log, GATE, 1)
    first = signed(signer)
    append(log, GATE, 1)
    second = signed(signer)
    assert first.statement.previous == NO_HASH
    assert second.statement.previous == statement_hash(first.statement)
    assert (second.sequence, second.statement.position) == (2, 3)
    assert CHECKPOINTS in {head.stream for head in second.statement.heads}


def test_nothing_is_signed_where_nothing_but_checkpoints_came(log: Log, signer: Signer) -> None:
    assert signer.sign() is None
    append(log, GATE, 1)
    signed(signer)
    assert signer.sign() is None
    assert log.head() == 2


def test_two_signers_follow_each_other(log: Log, signer: Signer, key_file: Path) -> None:
    other = signer_of(log, key_file)
    append(log, GATE, 1)
    signed(signer)
    append(log, GATE, 1)
    assert signed(other).sequence == 2
    append(log, GATE, 1)
    assert signed(signer).sequence == 3
    assert breaks(log) == []


def test_a_signer_that_lost_the_race_signs_behind_the_winner(log: Log, signer: Signer, key_file: Path) -> None:
    append(log, GATE, 1)
    while not signer.step():
        pass
    signed(signer_of(log, key_file))
    append(log, GATE, 1)
    assert signed(signer).sequence == 2
    assert breaks(log) == []


def test_events_lead_to_the_checkpoint_and_back(log: Log, signer: Signer) -> None:
    append(log, GATE, 1)
    checkpoint = signed(signer)
    event = event_of(checkpoint.statement, checkpoint.signature)
    assert checkpoint_of(event, "brno", 1) == checkpoint
    assert event.heads_hash == heads_hash(checkpoint.statement.heads).hex()


def test_a_log_of_too_many_streams_is_told(log: Log, signer: Signer) -> None:
    append(log, GATE, 1)
    checkpoint = signed(signer)
    heads = checkpoint.statement.heads * 50_000
    with pytest.raises(BadProof, match=r"at most 4194304 bytes of heads, got \d+ for 50000 streams\. Next: sign on"):
        event_of(replace(checkpoint.statement, heads=heads), checkpoint.signature)


def test_a_broken_log_is_not_signed(log: Log, signer: Signer, tampering: "psycopg.Connection[Any]") -> None:
    append(log, GATE, 1, 1, 1)
    tampering.execute("update segments set event_count = 2 where position = 2")
    with pytest.raises(BadProof, match=r"nothing was signed.*position 2.*vian verify --full"):
        signer.sign()
    tampering.execute("delete from segments where position > 1")
    with pytest.raises(BadProof, match="positions 2 to 3 are missing"):
        signer.sign()
    assert log.head() == 3


# What verification says of it.


@on_both
def test_verification_says_what_signatures_cover(log: Log, signer: Signer, key_file: Path) -> None:
    append(log, GATE, 2)
    append(log, YARD, 3)
    signed(signer)
    append(log, GATE, 9)
    key = load_key(key_file)
    found = verify(log, station="brno", trusted=known_keys(key_file))
    assert found.broken == []
    assert found.covered == (Covered(GATE.station, key.id, True, 1, NOON, 2, streams=2, events=5),)
    assert not verify(log, station="brno").covered[0].is_known


def test_a_changed_time_of_recording_is_found_between_two_checkpoints(
    log: Log, signer: Signer, tampering: "psycopg.Connection[Any]"
) -> None:
    for _ in range(3):
        append(log, GATE, 1, 1)
        signed(signer)
    tampering.execute("update segments set recorded_at = recorded_at + interval '1 microsecond' where position = 5")
    (broken,) = breaks(log)
    assert (broken.stream, broken.position) == (CHECKPOINTS, 3)
    assert "the order or a recorded_at of positions 3 to 5 is not what checkpoint 2 signed" in str(broken)


def test_streams_that_changed_places_are_found(log: Log, signer: Signer, tampering: "psycopg.Connection[Any]") -> None:
    append(log, GATE, 1)
    append(log, YARD, 1)
    signed(signer)
    for here, there in ((1, -1), (2, 1), (-1, 2)):
        tampering.execute("update segments set position = %s where position = %s", (there, here))
    (broken,) = breaks(log)
    assert "the order or a recorded_at of positions 1 to 2" in str(broken)


def test_history_that_was_written_anew_contradicts_what_was_signed(
    log: Log, make_log: Callable[[], Log], signer: Signer, key_file: Path
) -> None:
    append(log, GATE, 1)
    checkpoint = signed(signer)
    other = make_log()
    append(other, GATE, 1)
    append(other, YARD, 1)  # not signed
    event = event_of(checkpoint.statement, checkpoint.signature)
    other.append([encode(CHECKPOINTS, batch_of([event]), PRODUCER)], [0])
    assert breaks(other) != []


def test_a_log_that_was_cut_and_continued_is_found(
    log: Log, signer: Signer, tampering: "psycopg.Connection[Any]"
) -> None:
    append(log, GATE, 1, 1)
    signed(signer)
    tampering.execute("delete from segments where position = 2")
    tampering.execute("update segments set position = 2 where position = 3")
    tampering.execute(
        "update streams set sequence = 1, chain_hash = (select chain_hash from segments where position = 1) "
        "where source = 'gate'"
    )
    tampering.execute("update log_head set position = 2")
    assert {str(broken.stream) for broken in breaks(log)} == {str(GATE), str(CHECKPOINTS)}


def test_a_forged_signature_is_found(log: Log, signer: Signer, key_file: Path, tmp_path: Path) -> None:
    append(log, GATE, 1)
    checkpoint = signed(signer)
    event = event_of(checkpoint.statement, checkpoint.signature[:-1] + bytes([checkpoint.signature[-1] ^ 1]))
    log.append([encode(CHECKPOINTS, batch_of([event]), PRODUCER)], [1])
    (broken,) = breaks(log)
    assert (broken.stream, broken.position, broken.first_sequence) == (CHECKPOINTS, 3, 2)
    assert "its signature is not that of key" in str(broken)


def test_a_checkpoint_that_does_not_follow_the_one_before_is_found(log: Log, signer: Signer, key_file: Path) -> None:
    append(log, GATE, 1)
    first, key = signed(signer), load_key(key_file)
    statement = replace(first.statement, position=2, heads=tuple(log.streams()), previous=bytes(32))
    event = event_of(statement, key.sign(statement_bytes(statement)))
    log.append([encode(CHECKPOINTS, batch_of([event]), PRODUCER)], [1])
    (broken,) = breaks(log)
    assert (broken.stream, broken.first_sequence) == (CHECKPOINTS, 2)
    assert "it follows checkpoint 0000" in str(broken)


# Keys.


def test_a_key_file_is_its_owners_alone(key_file: Path) -> None:
    assert key_file.stat().st_mode & 0o777 == 0o600
    for mode in (0o640, 0o604, 0o666):
        key_file.chmod(mode)
        with pytest.raises(BadProof, match=f"mode 0600.*got {mode:04o}. Next: chmod 600 {key_file}"):
            load_key(key_file)


def test_a_key_is_made_once(key_file: Path) -> None:
    key = load_key(key_file)
    assert make_key(key_file).id == key.id
    assert known_keys(key_file) == {key.id: key.public}
    assert key.public not in key_file.read_bytes()


@pytest.mark.parametrize("content", [b"", b"no key", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n"])
def test_a_file_that_holds_no_key_is_refused(key_file: Path, content: bytes) -> None:
    key_file.write_bytes(content)
    with pytest.raises(BadProof, match="must hold an Ed25519 key"):
        load_key(key_file)


def test_a_missing_key_is_told_with_the_next_command(tmp_path: Path) -> None:
    with pytest.raises(BadProof, match=r"there is no key in .*\. Next: vian init"):
        load_key(tmp_path / "none.key")


def successor_of(key_file: Path) -> tuple[Path, StationKey]:
    path = key_file.with_name("next.key")
    return path, make_key(path)


def test_a_key_that_its_predecessor_names_may_sign(log: Log, signer: Signer, key_file: Path) -> None:
    append(log, GATE, 1)
    path, new = successor_of(key_file)
    assert signer.sign(successor=new.public) is not None
    append(log, GATE, 1)
    signed(signer_of(log, path))
    found = verify(log, station="brno")
    assert found.broken == []
    assert [(each.key_id, each.checkpoints) for each in found.covered] == [(new.id, 2)]


def test_a_key_that_nobody_named_may_not_sign(log: Log, signer: Signer, key_file: Path, tmp_path: Path) -> None:
    append(log, GATE, 1)
    signed(signer)
    append(log, GATE, 1)
    stranger = tmp_path / "elsewhere" / "station.key"
    make_key(stranger)
    signed(signer_of(log, stranger))
    (broken,) = breaks(log)
    assert "did not name as its successor" in str(broken)
    keep_public(key_file, load_key(stranger).public)
    assert breaks(log, trusted=known_keys(key_file)) == []


def test_a_key_that_was_replaced_may_not_sign_again(log: Log, signer: Signer, key_file: Path) -> None:
    append(log, GATE, 1)
    path, new = successor_of(key_file)
    signer.sign(successor=new.public)
    append(log, GATE, 1)
    signed(signer_of(log, path))
    append(log, GATE, 1)
    signed(signer_of(log, key_file))
    (broken,) = breaks(log, trusted=known_keys(key_file))
    assert broken.first_sequence == 3


def test_a_first_key_that_the_station_does_not_know_is_found(log: Log, signer: Signer, tmp_path: Path) -> None:
    append(log, GATE, 1)
    signed(signer)
    other = tmp_path / "other" / "station.key"
    make_key(other)
    (broken,) = breaks(log, trusted=known_keys(other))
    assert "which is not among this station's" in str(broken)


# A station that was restored.


def test_a_restored_log_signs_on_from_the_newest_checkpoint_that_it_has(
    log: Log, signer: Signer, key_file: Path, make_log: Callable[[], Log]
) -> None:
    append(log, GATE, 1)
    first = signed(signer)
    with owner(log) as connection:
        connection.execute("update log_head set epoch = 2")
    restored = Log(log.dsn, log.catalogue)
    append(restored, GATE, 3)
    second = signed(signer_of(restored, key_file))
    append(restored, GATE, 1)
    third = signed(signer_of(restored, key_file))
    restored.close()
    assert (second.sequence, second.statement.epoch) == (1, 2)
    assert second.statement.previous == statement_hash(first.statement)
    assert third.statement.previous == statement_hash(second.statement)
    found = verify(log, station="brno")
    assert (found.broken, found.covered[0].checkpoints, found.covered[0].position) == ([], 3, 5)


# Another log's checkpoints.


def replicate(log: Log, central: Log, *streams: StreamName) -> None:
    for stream in streams:
        at = central.stream_head(stream).sequence
        for segment in log.read(stream, at + 1):
            header = segment.header
            sent = draft(GATE, 1, 1).__class__(
                stream, header.event_count, header.schema_version, header.time_min, header.time_max,
                header.producer, segment.payload, segment.payload_hash,
            )  # fmt: skip
            central.append([sent], [header.first_sequence - 1], chain_hashes=[segment.chain_hash])


@pytest.mark.parametrize("is_checkpoint_first", [True, False])
def test_central_checks_a_stations_heads_whichever_comes_first(
    log: Log, make_log: Callable[[], Log], signer: Signer, is_checkpoint_first: bool
) -> None:
    central = make_log()
    append(central, FOREIGN, 1)
    append(log, GATE, 1, 1)
    signed(signer)
    append(log, GATE, 1)
    signed(signer)
    order = (CHECKPOINTS, GATE) if is_checkpoint_first else (GATE, CHECKPOINTS)
    replicate(log, central, *order)
    (covered,) = verify(central, station="plzen").covered
    assert (covered.station, covered.checkpoints, covered.position, covered.events) == ("brno", 2, None, 4)


@pytest.mark.parametrize("is_checkpoint_first", [True, False])
def test_central_finds_a_stream_that_its_station_did_not_sign(
    log: Log, make_log: Callable[[], Log], signer: Signer, is_checkpoint_first: bool
) -> None:
    central = make_log()
    append(central, FOREIGN, 1)
    append(log, GATE, 1)
    signed(signer)
    if is_checkpoint_first:
        replicate(log, central, CHECKPOINTS)
    central.append([draft(GATE, 7, 7)], [0])
    append(central, GATE, 1)
    if not is_checkpoint_first:
        replicate(log, central, CHECKPOINTS)
    (broken,) = verify(central, station="plzen").broken
    assert broken.stream == GATE
    assert "checkpoint 1 of station brno signed the chain hash" in str(broken)


# From the last verified head.


def test_a_second_run_reads_what_came_since(log: Log, signer: Signer) -> None:
    append(log, GATE, 1, 1)
    signed(signer)
    before = verify(log, station="brno").verified
    append(log, GATE, 1)
    signed(signer)
    append(log, GATE, 2)
    seen: list[int] = []
    found = verify(log, lambda segment: seen.append(segment.position), before=again(before), station="brno")
    assert (seen, found.since, found.segments, found.events, found.broken) == ([4, 5, 6], 3, 3, 4, [])
    assert found.covered == verify(log, station="brno").covered
    assert found.verified == verify(log, station="brno").verified


def again(before: Verified | None) -> Verified:
    """The same, written down and read again."""
    assert before is not None
    return Verified.from_text(before.to_text("this"), "this")


def test_a_head_that_went_back_or_changed_is_found(log: Log, tampering: "psycopg.Connection[Any]") -> None:
    append(log, GATE, 1, 1)
    append(log, YARD, 1)
    before = again(verify(log).verified)
    tampering.execute("delete from segments where position = 2")
    tampering.execute("update segments set position = 2 where position = 3")
    tampering.execute("update log_head set position = 2")
    tampering.execute(
        "update streams set sequence = 1, chain_hash = (select chain_hash from segments where position = 1) "
        "where source = 'gate'"
    )
    assert breaks(log) == []
    (went_back,) = breaks(log, before=before)
    assert "was found sound up to position 3, now it ends at 2" in str(went_back)
    append(log, GATE, 2)
    (changed,) = breaks(log, before=before)
    assert (changed.stream, changed.position) == (GATE, 2)
    assert "it was found sound up to sequence 2" in str(changed)


def test_an_interrupted_run_goes_on_where_it_was(log: Log, signer: Signer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("store.verification._SAVE_SECONDS", 0)
    monkeypatch.setattr("store.walk._PAGE_SEGMENTS_FIRST", 2)
    append(log, GATE, 1, 1)
    append(log, YARD, 1)
    signed(signer)
    saved: list[Verified] = []

    def interrupt(_: object) -> None:
        if saved:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        verify(log, interrupt, station="brno", save=saved.append)
    assert saved[0].position == 2
    found = verify(log, station="brno", before=again(saved[0]))
    assert (found.segments, found.since, found.broken) == (2, 2, [])
    assert found.covered == verify(log, station="brno").covered


@pytest.mark.parametrize(
    "damage", [lambda text: text.replace('"position":1', '"position":2', 1), lambda text: text[:-9]]
)
def test_a_damaged_note_of_what_was_verified_is_refused(log: Log, damage: Callable[[str], str]) -> None:
    append(log, GATE, 1)
    verified = verify(log).verified
    assert verified is not None
    with pytest.raises(BadProof, match="it is damaged"):
        Verified.from_text(damage(verified.to_text("this")), "this")
    with pytest.raises(BadProof, match="it is about another log: this, this one is that"):
        Verified.from_text(verified.to_text("this"), "that")


# One flipped bit.

_NUMBERS = {"first_sequence": 63, "event_count": 31, "schema_version": 31, "position": 63, "stream_id": 63}
_TIMES = ("time_min", "time_max", "recorded_at")
_BYTES = ("payload", "payload_hash", "chain_hash", "configuration_hash")
_TEXTS = ("producer", "producer_version")


def flip(column: str, bit: int) -> str:
    """SQL that flips one bit of a column's value; a time's 64 bits are microseconds since 2000."""
    if column in _NUMBERS:
        kind = "bigint" if _NUMBERS[column] == 63 else "integer"
        return f"{column} = {column} # (1::{kind} << {bit % _NUMBERS[column]})"
    if column in _TIMES:
        # Up to bit 50, about 35 years, so that PostgreSQL still calls it a time.
        since = "(extract(epoch from {0} - timestamptz '2000-01-01Z') * 1000000)::bigint"
        return (
            f"{column} = timestamptz '2000-01-01Z' "
            f"+ ((({since.format(column)}) # (1::bigint << {bit % 51})) * interval '1 microsecond')"
        )
    if column in _BYTES:
        at = f"{bit} % (8 * octet_length({column}))"
        return f"{column} = set_bit({column}, {at}, 1 - get_bit({column}, {at}))"
    at = f"({bit // 7} % length({column}) + 1)"
    return f"{column} = overlay({column} placing chr(ascii(substr({column}, {at}, 1)) # (1 << ({bit} % 5))) from {at})"


def test_one_flipped_bit_in_any_stored_byte_is_found_and_located(
    log: Log, signer: Signer, tampering: "psycopg.Connection[Any]"
) -> None:
    for _ in range(3):
        append(log, GATE, 2)
        append(log, YARD, 3)
        signed(signer)
    assert breaks(log) == []
    columns = (*_NUMBERS, *_TIMES, *_BYTES, *_TEXTS)
    chosen = random.Random(3)
    tampering.execute("set session_replication_role = replica")  # no foreign keys
    tampering.execute("alter table segments drop constraint segments_not_empty")
    tampering.execute("create table saved as select * from segments")
    for number in range(104):
        column, position, bit = columns[number % len(columns)], chosen.randint(1, 8), chosen.randrange(2**20)
        if column == "position":
            bit = chosen.randint(4, 62)  # the lower ones would give it another segment's place
        tampering.execute(f"update segments set {flip(column, bit)} where position = {position}")
        found = breaks(log)
        assert found, (column, position, bit)
        # A recorded_at is located between two signed positions: 2, 5 and 8 were.
        first = max(1, position // 3 * 3) if column == "recorded_at" else position
        assert any(first == each.position for each in found), (column, position, bit, [str(each) for each in found])
        tampering.execute("truncate segments")
        tampering.execute("insert into segments select * from saved")
    assert breaks(log) == []


def test_a_flipped_bit_in_any_head_is_found(log: Log, signer: Signer, tampering: "psycopg.Connection[Any]") -> None:
    append(log, GATE, 2)
    signed(signer)
    tampering.execute("set session_replication_role = replica")
    for table, column, bits in (("streams", "sequence", 62), ("streams", "epoch", 31), ("log_head", "position", 62)):
        for bit in range(0, bits, 7):
            kind = "integer" if bits == 31 else "bigint"
            change = f"update {table} set {column} = {column} # (1::{kind} << {bit})"
            tampering.execute(change)
            assert breaks(log), (table, column, bit)
            tampering.execute(change)
    assert breaks(log) == []


def test_a_statement_has_one_spelling(signer: Signer, log: Log) -> None:
    append(log, GATE, 1)
    statement = signed(signer).statement
    moved = [*statement.heads][::-1]
    assert heads_hash(moved) == heads_hash(statement.heads)
    assert len(statement_bytes(statement)) == 8 + 2 + 4 + 4 + 8 + 8 + 32 * 5
    assert isinstance(statement.time, datetime)
