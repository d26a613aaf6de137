"""`vian init`, `sign`, `verify`."""

import stat
from pathlib import Path
from typing import Any

import psycopg
import pytest

from store import Log
from tests.conftest import MakeLog
from tests.store.replicas import deliver
from tests.store.tiered import seal_all
from tests.sync.conftest import CENTRAL_KEY
from tests.sync.test_witnessing import countersign
from tests.vian.conftest import Ran, Run
from tests.vian.samples import GATE, YARD, append, objects, points
from vian.membership import MEMBERSHIP_NAME, Membership


@pytest.fixture
def key_file(tmp_path: Path) -> Path:
    return tmp_path / "keys" / "station.key"


@pytest.fixture
def at(filled: Log, key_file: Path) -> tuple[str, ...]:
    """Options that name the log and the key."""
    return ("--dsn", filled.dsn, "--key-file", str(key_file))


def one(ran: Ran) -> dict[str, Any]:
    assert ran.code == 0, ran.err
    (found,) = objects(ran.out)
    return found


def flip(log: Log, position: int) -> None:
    with psycopg.connect(log.dsn) as owner:
        owner.execute("alter table segments disable trigger all")
        owner.execute(
            "update segments set payload = set_byte(payload, 20, get_byte(payload, 20) # 1) where position = %s",
            (position,),
        )


# Init.


def test_init_makes_a_key_that_is_its_owners_alone_and_names_it(at: tuple[str, ...], key_file: Path, run: Run) -> None:
    made = one(run("init", *at, "--json"))
    assert stat.S_IMODE(key_file.stat().st_mode) == 0o600
    assert (made["station"], made["key_file"], made["position"]) == ("brno", str(key_file), 3)
    assert (key_file.parent / "public-keys" / f"{made['key_id']}.pem").exists()
    again = run("init", *at)
    assert f"key id:      {made['key_id']}\npublic key:  {made['public_key']}\n" in again.out


def test_init_makes_an_embedded_log_with_its_key_beside_it(tmp_path: Path, run: Run) -> None:
    made = one(run("init", "--data-dir", tmp_path / "log", "--station", "brno-2", "--json"))
    assert (made["station"], made["position"]) == ("brno-2", 0)
    assert (tmp_path / "log" / "station.key").exists()
    assert run("streams", "--data-dir", tmp_path / "log").code == 0


def test_a_key_that_others_may_read_is_refused_with_the_command_that_mends_it(
    at: tuple[str, ...], key_file: Path, run: Run
) -> None:
    run("init", *at)
    key_file.chmod(0o644)
    for command in (("init",), ("init", "--new-key"), ("sign",)):
        ran = run(*command, *at)
        assert ran.code == 1
        assert f"got 0644. Next: chmod 600 {key_file}" in ran.words


def test_a_new_key_is_named_by_the_old_one(at: tuple[str, ...], key_file: Path, run: Run, filled: Log) -> None:
    assert run("init", "--new-key", *at).code == 2
    old = one(run("init", *at, "--json"))
    one(run("sign", *at, "--json"))
    new = one(run("init", "--new-key", *at, "--json"))
    assert new["key_id"] != old["key_id"]
    append(filled, points(1, first_frame=35))
    assert one(run("sign", *at, "--json"))["key_id"] == new["key_id"]
    (signed,) = one(run("verify", *at, "--json"))["signed"]
    assert (signed["key_id"], signed["is_key_known"], signed["checkpoints"]) == (new["key_id"], True, 3)
    assert sorted(path.stem for path in (key_file.parent / "public-keys").iterdir()) == sorted(
        [old["key_id"], new["key_id"]]
    )


def test_a_replacement_that_was_interrupted_goes_on(
    at: tuple[str, ...], key_file: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run("init", *at)
    with monkeypatch.context() as patched:
        patched.setattr("vian.signatures.Path.replace", _killed)
        with pytest.raises(RuntimeError):
            run("init", "--new-key", *at)
    coming = key_file.with_name("station.key.next").read_bytes()
    assert run("sign", *at).code == 0
    assert run("init", "--new-key", *at).code == 0
    assert key_file.read_bytes() == coming
    assert run("verify", *at).code == 0


def _killed(*_: object) -> None:
    raise RuntimeError


# Sign.


def test_sign_says_what_it_signed_and_does_nothing_twice(at: tuple[str, ...], run: Run) -> None:
    key = one(run("init", *at, "--json"))["key_id"]
    signed = run("sign", *at)
    assert signed.out == f"signed: checkpoint 1 of station brno, 2 streams up to position 3, with key {key}\n"
    assert run("sign", *at).out == "nothing new to sign\n"


def test_sign_without_a_key_names_the_next_command(at: tuple[str, ...], run: Run) -> None:
    ran = run("sign", *at)
    assert ran.code == 1
    assert "there is no key in" in ran.words
    assert "Next: vian init" in ran.words


def test_sign_asks_for_the_station_where_there_are_several(filled: Log, at: tuple[str, ...], run: Run) -> None:
    append(filled, points(1), type(GATE).of("plzen", "gate", "track_point"))
    assert "This log has brno, plzen. Next: give --station NAME" in run("init", *at).words
    one(run("init", *at, "--station", "brno", "--json"))
    assert one(run("sign", *at, "--station", "brno", "--json"))["station"] == "brno"


def test_a_log_that_is_not_sound_is_not_signed(filled: Log, at: tuple[str, ...], run: Run) -> None:
    run("init", *at)
    flip(filled, 2)
    ran = run("sign", *at)
    assert ran.code == 1
    assert "nothing was signed, the log is not sound: station brno: stream brno/yard/track_point" in ran.words


# Verify.


def test_verify_says_that_all_is_sound(at: tuple[str, ...], run: Run) -> None:
    ran = run("verify", *at)
    assert ran.out == "sound: 40 events in 3 segments of 2 streams, up to position 3\n"
    assert "no signature covers it. Next: vian init, then vian sign" in ran.words


def test_verify_says_what_signatures_cover(filled: Log, at: tuple[str, ...], run: Run) -> None:
    key = one(run("init", *at, "--json"))["key_id"]
    run("sign", *at)
    append(filled, points(7), YARD)
    _, signed = run("verify", *at).out.splitlines()
    assert signed.startswith(
        "signed: station brno, 40 events of 2 streams, order and times of recording up to position 3; 1 checkpoints"
    )
    assert signed.endswith(f"key {key} (known here)")
    elsewhere = run("verify", "--dsn", filled.dsn, "--full", "--station", "brno")
    assert "(not known here: compare it with what the station's vian init says)" in elsewhere.out
    other = run("verify", "--dsn", filled.dsn, "--station", "oslo")
    assert (
        "their order is not judged here, since what it signs are positions of the station's own log "
        "(in that log: vian verify --station brno)"
    ) in other.out


def test_verify_reads_what_came_since_and_all_of_it_when_told(filled: Log, at: tuple[str, ...], run: Run) -> None:
    assert one(run("verify", *at, "--json"))["segments_read"] == 3
    append(filled, points(1), YARD)
    assert one(run("verify", *at, "--json")) == {
        "sound": True, "segments": 4, "events": 41, "streams": 2, "position": 4, "segments_read": 1,
        "segments_without_payload": 0, "gaps": [], "signed": [],
    }  # fmt: skip
    assert run("verify", *at).out.endswith(
        "; up to position 4 it was found sound before and not read again (--full does)\n"
    )
    assert one(run("verify", "--full", *at, "--json"))["segments_read"] == 4


def test_verify_finds_a_flipped_byte_in_what_was_verified_when_told_to_read_all(
    filled: Log, at: tuple[str, ...], run: Run
) -> None:
    one(run("verify", *at, "--json"))
    flip(filled, 2)
    assert run("verify", *at).code == 0
    assert run("verify", "--full", *at).code == 1


def test_a_damaged_note_of_what_was_verified_does_not_count(at: tuple[str, ...], run: Run, tmp_path: Path) -> None:
    one(run("verify", *at, "--json"))
    (note,) = tmp_path.rglob("verified/*.json")
    note.write_text(note.read_text().replace("brno", "brn0"))
    ran = run("verify", *at)
    assert "the whole log is read" in ran.words
    assert ran.code == 0
    assert "found sound before" not in ran.out
    assert run("verify", *at).words.count("the whole log is read") == 0


def test_verify_names_station_stream_and_position_of_a_flipped_byte(filled: Log, at: tuple[str, ...], run: Run) -> None:
    flip(filled, 2)
    ran = run("verify", *at)
    assert ran.code == 1
    assert ran.out.startswith("broken: station brno: stream brno/yard/track_point, position 2, from sequence 1: ")
    assert "the log does not verify: 1 breaks. Next: keep this database as it is" in ran.words
    (broken,) = objects(run("verify", *at, "--json").out)
    assert (broken["sound"], broken["station"], broken["stream"], broken["position"]) == (False, "brno", str(YARD), 2)


@pytest.mark.parametrize("is_sealed", [True, False])
def test_damage_to_the_newest_checkpoint_is_found_and_named(
    filled: Log, at: tuple[str, ...], run: Run, tmp_path: Path, is_sealed: bool
) -> None:
    run("init", *at)
    run("sign", *at)
    if is_sealed:
        seal_all(filled, tmp_path / "archive")
        newest = max((tmp_path / "archive" / "_sealed").iterdir())
        newest.write_bytes(newest.read_bytes()[:-64])
    else:
        with psycopg.connect(filled.dsn) as owner:
            owner.execute("alter table segments disable trigger all")
            owner.execute("update segments set payload = substr(payload, 9) where position = 4")
    ran = run("verify", "--full", *at)
    assert ran.code == 1
    assert "the log does not verify: " in ran.words
    assert ran.out.startswith("broken: ")


def test_an_empty_log_is_sound(log: Log, run: Run) -> None:
    assert run("verify", "--dsn", log.dsn).out.startswith("sound: 0 events")


def test_what_is_not_here_is_told_and_is_no_break(filled: Log, make_log: MakeLog, run: Run) -> None:
    replica = make_log()
    sent = list(filled.read(GATE))
    deliver(replica, sent, 1)
    first, last = sent[1].header.first_sequence, sent[1].header.last_sequence
    ran = run("verify", "--dsn", replica.dsn)
    assert ran.code == 0
    assert f"not here: {GATE}, epoch 1, sequences 1 to {first - 1}: the station began behind them" in ran.out
    (said,) = objects(run("verify", "--dsn", replica.dsn, "--full", "--json").out)
    gap = {"stream": str(GATE), "epoch": 1, "first_sequence": 1, "last_sequence": first - 1}
    assert (said["sound"], said["events"], said["gaps"]) == (True, last - first + 1, [gap])
    (stream,) = objects(run("streams", "--dsn", replica.dsn, "--json").out)
    assert (stream["sequence"], stream["not_here"]) == (last, f"1 to {first - 1}")


@pytest.mark.parametrize("is_forged", [False, True])
def test_verify_checks_what_central_countersigned(
    filled: Log, at: tuple[str, ...], key_file: Path, run: Run, *, is_forged: bool
) -> None:
    run("init", *at)
    member = Membership(
        address="https://c.example", station="brno-2", central="central", public_key=CENTRAL_KEY.public.hex()
    )
    (key_file.parent / MEMBERSHIP_NAME).write_text(member.model_dump_json())
    countersign(filled, **({"checkpoint_sequence": 2} if is_forged else {}))
    ran = run("verify", *at)
    if is_forged:
        assert ran.code == 1
        assert "whose signature it does not bear" in ran.out
    else:
        assert "countersigned: 1 signatures of central, and the newest fits this log" in ran.out
