"""Evidence of streams that the log holds with gaps."""

import json
from pathlib import Path

import pytest

from events import StreamName
from store import Log
from tests.conftest import MakeLog
from tests.store.replicas import deliver
from tests.vian.conftest import Run
from tests.vian.evidence.conftest import signer_of, track
from tests.vian.samples import GATE
from vian.evidence import verifier

CHECKPOINTS = StreamName.of("brno", "log", "checkpoint_signed")


def export(run: Run, log: Log, key_file: Path, out: Path, *options: object) -> Path:
    ran = run(
        *("evidence", "export", "--dsn", log.dsn, "--stream", str(GATE), "--out", out, "--key-file", key_file), *options
    )
    assert ran.code == 0, ran.err
    return out


def items_of(bundle: Path) -> list[tuple[list[list[int]], int | None]]:
    items = json.loads((bundle / "manifest.json").read_text())["items"]
    return [
        (item["ranges"], item["base"] and item["base"]["sequence"]) for item in items if item["stream"] == str(GATE)
    ]


def test_each_run_of_a_stream_verifies_alone(
    log: Log, make_log: MakeLog, key_file: Path, tmp_path: Path, run: Run
) -> None:
    origin = make_log()
    for _ in range(8):
        track(origin, 10)
    sent = list(origin.read(GATE))
    signer = signer_of(log, key_file)
    for number in (7, 0, 4, 3, 1):  # what fills a gap is signed later than what is above it
        deliver(log, sent, number)
        assert signer.sign() is not None
    bundle = export(run, log, key_file, tmp_path / "all")
    assert items_of(bundle) == [([[1, 20]], None), ([[31, 50]], 30), ([[71, 80]], 70)]
    assert json.loads((bundle / "manifest.json").read_text())["missing"] == [
        f"{GATE} in epoch 1, sequences 21 to 30",
        f"{GATE} in epoch 1, sequences 51 to 70",
    ]
    told: list[str] = []
    assert verifier.verify(bundle, told.append) == verifier.SOUND, told
    assert "begins behind sequence 70" in "\n".join(told)
    part = export(run, log, key_file, tmp_path / "part", "--from", "33", "--to", "36")
    assert (items_of(part), verifier.verify(part, told.append)) == ([([[33, 36]], 30)], verifier.SOUND)
    deliver(log, sent, 2, 5)
    assert signer.sign() is not None
    merged = export(run, log, key_file, tmp_path / "merged", "--from", "15", "--to", "55")
    assert (items_of(merged), verifier.verify(merged, told.append)) == ([([[15, 55]], None)], verifier.SOUND)


def test_a_stations_signature_covers_a_run_that_its_central_began_later(
    log: Log, make_log: MakeLog, key_file: Path, tmp_path: Path, run: Run
) -> None:
    origin = make_log()
    signer = signer_of(origin, key_file)
    for _ in range(3):
        track(origin, 10)
        assert signer.sign() is not None
    deliver(log, list(origin.read(GATE)), 1, 2)
    deliver(log, list(origin.read(CHECKPOINTS)), 0, 1, 2)
    bundle = export(run, log, tmp_path / "none.key", tmp_path / "bundle", "--from", "12", "--to", "14")
    told: list[str] = []
    assert verifier.verify(bundle, told.append) == verifier.UNSIGNED  # the export itself has no key
    assert "begins behind sequence 10, and holds to sequence 20, as checkpoint 2 signed it" in "\n".join(told)


@pytest.mark.parametrize("change", ["hash", "sequence", "none"])
def test_a_base_that_was_changed_in_the_manifest_is_found(
    log: Log, make_log: MakeLog, key_file: Path, tmp_path: Path, run: Run, change: str
) -> None:
    origin = make_log()
    for _ in range(4):
        track(origin, 10)
    deliver(log, list(origin.read(GATE)), 2, 3)
    bundle = export(run, log, key_file, tmp_path / "bundle")
    manifest = json.loads((bundle / "manifest.json").read_text())
    (item,) = manifest["items"]
    item["base"] = {
        "hash": {**item["base"], "chain_hash": "11" * 32},
        "sequence": {**item["base"], "sequence": 10},
        "none": None,
    }[change]
    report = verifier.Report(lambda _: None)
    checkpoints = verifier.read_checkpoints(bundle, manifest, report)
    with pytest.raises(verifier.Bad):
        verifier.check_item(bundle, item, checkpoints, {}, report)
