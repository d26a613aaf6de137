"""docs/reference/evidence.md says what the code does."""

import json
from pathlib import Path

from vian.evidence import bundle as code
from vian.evidence import verifier

PAGE = (Path(__file__).parents[3] / "docs/reference/evidence.md").read_text(encoding="utf-8")


def test_every_magic_and_format_is_told() -> None:
    for magic in (code.SEGMENTS_MAGIC, code.ORDER_MAGIC, code.SEAL_MAGIC):
        assert f"`{magic.decode()}`" in PAGE
    assert f"`{code.FORMAT}`" in PAGE
    assert verifier.SEAL_HEAD in PAGE


def test_every_key_that_an_export_writes_is_told(bundle: Path) -> None:
    manifest = json.loads((bundle / "manifest.json").read_text())
    checkpoints = json.loads((bundle / "checkpoints.json").read_text())
    keys = {*manifest, *(key for item in manifest["items"] for key in item), *checkpoints[0]}
    assert [key for key in sorted(keys) if f"`{key}`" not in PAGE] == []


def test_every_file_that_an_export_writes_is_told(bundle: Path) -> None:
    names = {
        path.name if path.parent == bundle else f"{path.parent.name}/" for path in bundle.rglob("*") if path.is_file()
    }
    assert [name for name in sorted(names) if f"`{name}" not in PAGE] == []


def test_the_seal_is_laid_out_as_told(bundle: Path) -> None:
    told = [line.strip().rsplit(" ", 1)[0] for line in PAGE.split("    VIAN EVIDENCE SEAL 1\n")[1].splitlines()[:4]]
    written = [line.rsplit(" ", 1)[0] for line in (bundle / "seal.txt").read_text().splitlines()[1:]]
    assert [line.removesuffix(" HEX or") for line in told] == written


def test_every_exit_code_is_told() -> None:
    for number in (verifier.SOUND, 1, verifier.USAGE, verifier.UNCHECKED, verifier.UNSIGNED):
        assert f"| {number} |" in PAGE
