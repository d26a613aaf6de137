"""`vian evidence`: what is exported, that it verifies alone, and that any change is found."""

import hashlib
import json
import random
import re
import subprocess
import sys
import venv
from pathlib import Path
from typing import Any

import duckdb
import psycopg
import pytest

from events import MatchedRange, StreamName
from store import Log
from store.payloads import take_off
from tests.store.tiered import seal_all
from tests.vian.conftest import Ran, Run
from tests.vian.evidence.conftest import RULE, SITUATION, VIDEO, Export, fill, say, situation, started, track
from tests.vian.samples import GATE, YARD
from vian.evidence import verifier


def manifest_of(directory: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((directory / "manifest.json").read_text())
    return found


def alone(directory: Path, *arguments: str, python: str = sys.executable, is_bare: bool = True) -> Ran:
    """The directory's own verifier, without any package but Python's own."""
    command = [python, *(("-I", "-S") if is_bare else ("-I",)), str(directory / "verify.py"), *arguments]
    ran = subprocess.run(command, capture_output=True, text=True, cwd="/")
    return Ran(ran.returncode, ran.stdout, ran.stderr)


# What is exported.


def test_a_situation_comes_with_all_that_it_rests_on(bundle: Path) -> None:
    manifest = manifest_of(bundle)
    assert {(item["stream"], tuple(map(tuple, item["ranges"]))) for item in manifest["items"]} == {
        ("brno/gate/situation_detected", ((1, 1),)),
        ("brno/gate/track_point", ((13, 25),)),
        ("brno/gate/process_started", ((1, 1),)),
        ("brno/gate/video_added", ((1, 1),)),
        ("brno/rules/rule_deployed", ((1, 1),)),
    }
    (points,) = (item for item in manifest["items"] if item["stream"] == str(GATE))
    assert points["why"] == ["lineage: entry", "lineage: dwell"]
    assert points["frames"] == [12, 24]
    assert points["producers"] == [
        {"name": "motion", "version": "1.0.0", "configuration_sha256": bytes(range(32)).hex()}
    ]
    assert manifest["situation"]["situation"] == SITUATION
    assert [(video["video"], video["process"]) for video in manifest["videos"]] == [(VIDEO, "p1")]
    assert manifest["missing"] == []
    assert (manifest["exported_by"], manifest["reason"]) == ("officer", "case 12")
    assert (bundle / "rule.yaml").read_text() == RULE


def test_every_file_stands_in_the_manifest_with_its_hash(bundle: Path) -> None:
    files = manifest_of(bundle)["files"]
    found = {path.relative_to(bundle).as_posix(): path for path in bundle.rglob("*") if path.is_file()}
    assert set(found) - set(files) == {"manifest.json", "seal.txt"}
    for name, said in files.items():
        content = found[name].read_bytes()
        assert (said["sha256"], said["bytes"]) == (hashlib.sha256(content).hexdigest(), len(content))


def test_the_events_are_decoded_for_anyone(bundle: Path) -> None:
    path = bundle / "events" / "brno.gate.track_point.1"
    rows = json.loads(path.with_suffix(".1.json").read_text())
    assert [row["sequence"] for row in rows] == list(range(13, 26))
    assert rows[0]["frame"] == 12
    columns = duckdb.sql(f"select sequence, position, frame from '{path}.parquet'").fetchall()
    assert columns == [(row["sequence"], row["position"], row["frame"]) for row in rows]


def test_what_was_not_asked_for_comes_without_its_payload(bundle: Path, signed_log: Log) -> None:
    held = b"".join(path.read_bytes() for path in bundle.rglob("*") if path.is_file())
    before, *asked, behind, later = signed_log.read(GATE)
    assert [segment.payload in held for segment in asked] == [True, True]
    assert behind.payload_hash in held, "the chain goes on to what was signed"
    assert not any(segment.payload in held for segment in (before, behind, later))
    assert not any(segment.payload in held for segment in signed_log.read(YARD))


@pytest.mark.parametrize(
    "bounds, first, last",
    [
        ((), 1, 45),
        (("--from", "7"), 7, 45),
        (("--from", "7", "--to", "12"), 7, 12),
        (("--to", "900"), 1, 45),
        (("--from", "2026-01-01T10:00:05Z", "--to", "2026-01-01T10:00:15Z"), 6, 15),
        (("--from", "9", "--to", "2026-01-01T10:00:15Z"), 9, 15),
    ],
)
def test_a_stream_is_exported_between_sequences_or_times(
    export: Export, bounds: tuple[str, ...], first: int, last: int
) -> None:
    directory = export("--stream", str(GATE), *bounds)
    (points,) = (item for item in manifest_of(directory)["items"] if item["stream"] == str(GATE))
    assert (points["ranges"], points["events"]["count"]) == ([[first, last]], last - first + 1)
    assert alone(directory).code == 3


def test_evidence_is_signed_up_to_its_end(export: Export, signed_log: Log) -> None:
    track(signed_log, 10)
    directory = export("--stream", str(GATE), "--from", "46")
    assert alone(directory, is_bare=False).out.endswith("INTACT AND SIGNED\n")


@pytest.mark.parametrize(
    "arguments, said",
    [
        ((), "give either --situation or --stream"),
        (("--situation", SITUATION, "--stream", str(GATE)), "give either --situation or --stream"),
        (("--situation", SITUATION, "--from", "1"), "--from, --to and --epoch go with --stream"),
        (("--situation", "3f9"), "--situation wants an identity, or its first 6 characters or more; got '3f9'"),
        (("--situation", "abcdef"), "no situation begins with 'abcdef'. Next: vian tail --type situation_detected"),
        (("--stream", "brno/gate"), "a stream is written station/source/type"),
        (("--stream", "brno/gone/track_point"), "there is no stream brno/gone/track_point; known: brno/gate"),
        (("--stream", str(GATE), "--from", "50"), "has no events from 50 to its end; it has sequences 1 to 45"),
        (("--stream", str(GATE), "--from", "noon"), "--from must be a time such as"),
    ],
)
def test_what_cannot_be_exported_is_told(
    signed_log: Log, run: Run, tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    ran = run("evidence", "export", *arguments, "--dsn", signed_log.dsn, "--out", tmp_path / "none")
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.words
    assert not (tmp_path / "none").exists()


def test_two_situations_that_begin_alike_are_not_guessed(signed_log: Log, run: Run) -> None:
    say(signed_log, situation().model_copy(update={"situation": SITUATION[:8] + "0" * 56}))
    ran = run("evidence", "export", "--situation", SITUATION[:8], "--dsn", signed_log.dsn)
    assert "2 situations begin with '3f9c2a71'" in ran.words


def test_a_directory_that_is_there_is_left_alone(bundle: Path, run: Run, signed_log: Log) -> None:
    ran = run("evidence", "export", "--situation", SITUATION, "--dsn", signed_log.dsn, "--out", bundle)
    assert ran.code == 2
    assert f"{bundle} is there already. Next: give another directory" in ran.words
    assert list(bundle.parent.glob(".*.partial")) == []


# It verifies alone.


def test_the_verifier_needs_nothing_but_python(bundle: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "bare", with_pip=False)
    ran = alone(bundle, python=str(tmp_path / "bare" / "bin" / "python"), is_bare=False)
    assert ran.code == 3, ran.out + ran.err
    assert "INTACT, SIGNATURES NOT CHECKED" in ran.out
    assert ran.err == ""


def test_with_cryptography_the_signatures_are_checked(bundle: Path) -> None:
    (key,) = manifest_of(bundle)["keys"]
    ran = alone(bundle, "--key", key, is_bare=False)
    assert ran.code == 0, ran.out + ran.err
    assert ran.out.endswith("INTACT AND SIGNED\n")


def test_what_was_noted_at_the_export_can_be_held_against_it(bundle: Path) -> None:
    digest = hashlib.sha256((bundle / "manifest.json").read_bytes()).hexdigest()
    assert alone(bundle, "--manifest", digest).code == 3
    assert "--manifest says 0000" in alone(bundle, "--manifest", "0" * 64).out
    other = alone(bundle, "--key", "0" * 32)
    assert (other.code, "BAD       seal.txt: it was not signed with key 0000" in other.out) == (1, True)
    assert alone(bundle, "--key", "short").code == 2
    assert alone(bundle, "nowhere").code == 2


def test_evidence_without_any_key_says_that_it_is_not_signed(log: Log, tmp_path: Path, run: Run) -> None:
    fill(log, lambda: None)
    out = tmp_path / "unsigned"
    ran = run("evidence", "export", "--situation", SITUATION, "--dsn", log.dsn, "--out", out)
    assert "not signed throughout" in ran.out
    assert "there is no key: the export itself is not signed. Next, if it shall be: vian init" in ran.words
    verified = alone(out)
    assert verified.code == 4
    (listed,) = re.findall(r"; (\d+) files beside manifest and seal, ", " ".join(ran.out.split()))
    assert f"{listed} of {listed} files are those of the manifest" in verified.out
    assert "INTACT, BUT NOT SIGNED THROUGHOUT" in verified.out


def test_a_log_that_another_station_signed_gives_evidence_too(
    signed_log: Log, run: Run, tmp_path: Path, key_file: Path
) -> None:
    ran = run("evidence", "export", "--stream", str(GATE), "--dsn", signed_log.dsn, "--out", tmp_path / "central",
              "--station", "central", "--json")  # fmt: skip
    assert ran.code == 0
    (points, *_) = manifest_of(tmp_path / "central")["items"]
    assert (points["to_checkpoint"], points["order"]) == (4, None)
    assert "BAD" not in alone(tmp_path / "central").out


def test_both_lives_of_a_restored_station_can_be_exported(
    signed_log: Log, run: Run, tmp_path: Path, key_file: Path
) -> None:
    with psycopg.connect(signed_log.dsn) as owner:
        owner.execute("update log_head set epoch = 2")
    with Log(signed_log.dsn, signed_log.catalogue) as restored:
        say(restored, started("p2"))
        track(restored, 10)
    whole = {1: [[1, 45]], 2: [[1, 10]]}
    questions: dict[tuple[str, ...], tuple[dict[int, Any], set[int]]] = {
        ("--situation", SITUATION): ({1: [[13, 25]]}, {1}),
        ("--stream", str(GATE)): (whole, {1, 2}),
        ("--stream", str(GATE), "--epoch", "1"): ({1: [[1, 45]]}, {1}),
        ("--stream", str(GATE), "--epoch", "1", "--from", "7", "--to", "12"): ({1: [[7, 12]]}, {1}),
        ("--stream", str(GATE), "--to", "2026-01-01T10:00:05Z"): ({1: [[1, 5]], 2: [[1, 5]]}, {1, 2}),
        ("--stream", str(GATE), "--from", "2026-01-01T10:00:30Z"): ({1: [[31, 45]]}, {1}),
    }
    for number, (question, (ranges, processes)) in enumerate(questions.items()):
        out = tmp_path / f"restored-{number}"
        ran = run("evidence", "export", *question, "--dsn", signed_log.dsn, "--key-file", key_file, "--out", out)
        assert ran.code == 0, ran.err
        items = manifest_of(out)["items"]
        assert {item["epoch"]: item["ranges"] for item in items if item["stream"] == str(GATE)} == ranges
        assert {item["epoch"] for item in items if item["stream"] == "brno/gate/process_started"} == processes
        assert alone(out, is_bare=False).out.endswith("INTACT AND SIGNED\n")


def test_a_situation_may_rest_on_events_of_an_earlier_life(
    signed_log: Log, run: Run, tmp_path: Path, key_file: Path
) -> None:
    with psycopg.connect(signed_log.dsn) as owner:
        owner.execute("update log_head set epoch = 2")
    identity = "ab" * 32
    before, since = (13, 25), (3, 5)
    lineage = tuple(
        MatchedRange(variable="a", stream=str(GATE), first_sequence=first, last_sequence=last, events=2)
        for first, last in (before, since)
    )
    with Log(signed_log.dsn, signed_log.catalogue) as restored:
        track(restored, 10)
        say(restored, situation().model_copy(update={"situation": identity, "lineage": lineage}))
        track(restored, 30)
    out, options = tmp_path / "out", ("--dsn", signed_log.dsn, "--key-file", key_file)
    assert run("evidence", "export", "--situation", identity, "--out", out, *options).code == 0
    items = [item for item in manifest_of(out)["items"] if item["stream"] == str(GATE)]
    assert {item["epoch"]: item["ranges"] for item in items} == {1: [list(before)], 2: [list(since)]}
    assert alone(out, is_bare=False).out.endswith("INTACT AND SIGNED\n")


def test_a_sequence_of_several_lives_is_not_guessed(signed_log: Log, run: Run) -> None:
    with psycopg.connect(signed_log.dsn) as owner:
        owner.execute("update log_head set epoch = 2")
    with Log(signed_log.dsn, signed_log.catalogue) as restored:
        track(restored, 10)
    for arguments, said in (
        (("--to", "7"), "epoch 1 with sequences 1 to 45, epoch 2 with sequences 1 to 10. Next: say which by --epoch"),
        (("--epoch", "3"), f"{GATE} has no events of epoch 3; it has epoch 1 with sequences 1 to 45, epoch 2"),
        (("--epoch", "2", "--from", "11"), "has no events from 11 to its end; it has sequences 1 to 10"),
    ):
        ran = run("evidence", "export", "--stream", GATE, *arguments, "--dsn", signed_log.dsn)
        assert ran.code == 2
        assert said in ran.words


def test_sealed_segments_are_evidence_like_the_others(
    signed_log: Log, run: Run, tmp_path: Path, key_file: Path
) -> None:
    seal_all(signed_log, tmp_path / "archive")
    options = ("--dsn", signed_log.dsn, "--key-file", key_file)
    assert json.loads(run("verify", *options, "--json").out)["signed"][0]["checkpoints"] == 4
    track(signed_log, 1)
    out = tmp_path / "sealed"
    assert run("evidence", "export", "--situation", SITUATION, *options, "--out", out).code == 0
    assert alone(out, is_bare=False).out.endswith("INTACT AND SIGNED\n")
    again = json.loads(run("verify", *options, "--json").out)
    assert (again["signed"][0]["checkpoints"], again["segments_read"]) == (5, 2)


# Any change is found.


def test_one_changed_byte_in_any_file_is_found_and_named(bundle: Path) -> None:
    chosen = random.Random(7)
    for path in sorted(each for each in bundle.rglob("*") if each.is_file()):
        content = path.read_bytes()
        name = path.relative_to(bundle).as_posix()
        places = {0, len(content) - 1, *(chosen.randrange(len(content)) for _ in range(5))}
        for number, at in enumerate(places):
            flipped = bytes([content[at] ^ 1 << chosen.randrange(8)])
            path.write_bytes(content[:at] + flipped + content[at + 1 :])
            assert name in {each for each, _ in alone_here(bundle)}, (name, at)
            # The verifier itself is what is run in the directory; the others are run there once each.
            if number == 0 or name == "verify.py":
                ran = alone(bundle)
                assert (ran.code, name in ran.out + ran.err) == (1, True), (name, at, ran.out, ran.err)
        path.write_bytes(content)
    assert alone(bundle).code == 3


def test_only_the_changed_file_is_named(bundle: Path, run: Run) -> None:
    for name in ("events/brno.gate.track_point.1.json", "seal.txt", "manifest.json", "README.md"):
        path = bundle / name
        content = path.read_bytes()
        path.write_bytes(content[:40] + bytes([content[40] ^ 2]) + content[41:])
        ran = run("evidence", "verify", bundle, "--json")
        assert ran.code == 1
        assert {each["file"] for each in json.loads(ran.out)["faults"]} == {name}
        path.write_bytes(content)


def test_a_file_that_is_missing_or_was_added_is_named(bundle: Path) -> None:
    (bundle / "rule.yaml").unlink()
    (bundle / "events" / "more.json").write_text("[]")
    (bundle / "link").symlink_to("/etc/passwd")
    out = alone(bundle).out
    assert "BAD       rule.yaml: it is missing" in out
    assert "BAD       events/more.json: it was added" in out
    assert "BAD       link: it is no plain file" in out


def reseal(bundle: Path, *changed: str) -> None:
    """What a forger without the key would do: make manifest and seal fit again."""
    manifest = manifest_of(bundle)
    for name in changed:
        content = (bundle / name).read_bytes()
        manifest["files"][name] = {"sha256": hashlib.sha256(content).hexdigest(), "bytes": len(content)}
    text = json.dumps(manifest)
    (bundle / "manifest.json").write_text(text)
    head, _, *rest = (bundle / "seal.txt").read_text().splitlines()[:-1]
    body = "".join(
        f"{line}\n" for line in (head, f"manifest sha256 {hashlib.sha256(text.encode()).hexdigest()}", *rest)
    )
    (bundle / "seal.txt").write_text(f"{body}seal sha256 {hashlib.sha256(body.encode()).hexdigest()}\n")


def test_a_forger_who_makes_the_manifest_fit_is_found_by_the_signature(bundle: Path) -> None:
    path = "events/brno.gate.track_point.1.json"
    (bundle / path).write_text("[]\n")
    reseal(bundle, path)
    assert alone(bundle).code == 3, "without cryptography nobody can tell"
    ran = alone(bundle, is_bare=False)
    assert ran.code == 1
    assert "BAD       seal.txt: a signature is not that of key" in ran.out


def test_a_forger_who_makes_the_manifest_fit_breaks_the_chain(bundle: Path) -> None:
    path = "segments/brno.gate.track_point.1.bin"
    content = (bundle / path).read_bytes()
    # Each byte of a segment counts: the kind, the header, the hashes, the payload, position, time of recording.
    for at in range(8, len(content), 41):
        (bundle / path).write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        reseal(bundle, path)
        ran = alone_here(bundle)
        assert [each for each, _ in ran] == [path], (at, ran)
    (bundle / path).write_bytes(content)
    reseal(bundle, path)
    assert alone_here(bundle) == []


def alone_here(bundle: Path) -> list[tuple[str, str]]:
    """The faults that the verifier finds without signatures, in this process."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(verifier, "Ed25519PublicKey", None)
        return verifier.examine(bundle, lambda _: None, None, None).bad


def test_a_forger_cannot_drop_wanted_events(bundle: Path) -> None:
    path = "segments/brno.gate.track_point.1.bin"
    manifest = manifest_of(bundle)
    (points,) = (item for item in manifest["items"] if item["segments"] == path)
    points["ranges"] = [[5, 25]]
    (bundle / "manifest.json").write_text(json.dumps(manifest))
    reseal(bundle)
    assert alone_here(bundle) == [(path, "events 5 to 25 are not all there")]


def test_a_forger_cannot_cut_the_chain_short(bundle: Path) -> None:
    path = "segments/brno.gate.track_point.1.bin"
    content = (bundle / path).read_bytes()
    last = max(segment["at"] for segment in verifier.segments_in(path, content))
    (bundle / path).write_bytes(content[:last])
    reseal(bundle, path)
    assert alone_here(bundle) == [(path, "the chain does not reach what checkpoint 3 signed at 35")]


def test_a_forger_cannot_change_when_or_in_which_order_it_was_recorded(bundle: Path) -> None:
    for path in sorted((bundle / "order").iterdir()):
        content, name = path.read_bytes(), f"order/{path.name}"
        for at in range(0, len(content), 11):
            path.write_bytes(content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :])
            reseal(bundle, name)
            assert name in {each for each, _ in alone_here(bundle)}, at
        path.write_bytes(content)
        reseal(bundle, name)


@pytest.mark.parametrize(
    "change",
    [
        lambda said: said[1].update(time_us=said[1]["time_us"] + 1),
        lambda said: said[1].update(position=said[1]["position"] + 1),
        lambda said: said[0]["heads"][0].__setitem__(4, 7),
        lambda said: said.pop(1),
        lambda said: said[-1].update(order_hash="00" * 32),
    ],
)
def test_a_forger_cannot_change_what_was_signed(bundle: Path, change: Any) -> None:
    path = bundle / "checkpoints.json"
    said = json.loads(path.read_text())
    change(said)
    path.write_text(json.dumps(said))
    reseal(bundle, "checkpoints.json")
    ran = alone(bundle, is_bare=False)
    assert ran.code == 1
    assert "BAD       checkpoints.json" in ran.out


def test_evidence_verify_checks_by_the_installed_copy(bundle: Path, run: Run) -> None:
    (bundle / "verify.py").write_text("print('INTACT AND SIGNED')\n")
    assert alone(bundle).out == "INTACT AND SIGNED\n"
    ran = run("evidence", "verify", bundle)
    assert ran.code == 1
    assert "BAD       verify.py: it was changed" in ran.out
    assert "NOT INTACT: verify.py" in ran.words


def test_evidence_verify_refuses_nonsense(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    ran = run("evidence", "verify", tmp_path / "file")
    assert ran.code == 2
    assert "wanted a directory" in ran.words


def test_names_of_streams_are_those_of_files(bundle: Path) -> None:
    names = {path.stem.rsplit(".", 1)[0] for path in (bundle / "segments").iterdir()}
    assert names == {str(StreamName.parse(item["stream"])).replace("/", ".") for item in manifest_of(bundle)["items"]}


def test_events_whose_payload_left_the_disk_are_named_with_the_next_command(
    signed_log: Log, run: Run, tmp_path: Path
) -> None:
    (position,) = [each.position for each in signed_log.read(GATE) if each.header.first_sequence <= 13][-1:]
    with signed_log.transaction() as transaction:
        take_off(transaction, [position])

    ran = run("evidence", "export", "--situation", SITUATION, "--out", tmp_path / "out", "--dsn", signed_log.dsn)

    assert ran.code == 1
    assert f"of {GATE} have left this disk, pruned or given up" in ran.words
    assert "Next: vian sync repair" in ran.words
