"""`vian truth`: the horizon of marks, and marks that give none."""

import json
from pathlib import Path
from typing import Any

import pytest

from tests.vian.conftest import Run

KERB = [[0, 400, 200, 250], [640, 420, 420, 250]]
WALL = [[0, 300, 300, 200], [10, 200, 300, 150]]


def marks(folder: Path, **said: Any) -> Path:
    file = folder / "marks.json"
    groups = [{"name": "kerb", "segments": KERB}, {"name": "wall", "segments": WALL}]
    file.write_text(json.dumps({"width": 640, "height": 480, "groups": groups} | said))
    return file


def test_the_horizon_is_printed_and_written_as_truth(tmp_path: Path, run: Run) -> None:
    ran = run("truth", "horizon", marks(tmp_path), "--output", tmp_path / "truth.json", "--json")
    assert ran.code == 0
    written = json.loads((tmp_path / "truth.json").read_text())
    assert written == json.loads(ran.out)
    assert (written["width"], written["height"]) == (640, 480)
    (kerb, wall) = written["groups"]
    for group in (kerb, wall):  # two groups fix the line exactly
        x, y = group["vanishing_point"]
        assert y == pytest.approx(written["horizon"]["a"] * x + written["horizon"]["b"])


def test_people_are_told_the_line_and_the_residuals(tmp_path: Path, run: Run) -> None:
    ran = run("truth", "horizon", marks(tmp_path))
    assert "horizon: y = " in ran.out
    assert "kerb" in ran.out


@pytest.mark.parametrize(
    "said, wanted",
    [
        ({"groups": [{"segments": KERB}]}, "wanted two or more of different directions"),
        ({"groups": [{"segments": KERB}, {"segments": WALL[:1]}]}, "wanted two or more"),
        ({"groups": [{"segments": KERB}, {"segments": [[0, 5, 90, 5], [0, 9, 90, 9]]}]}, "parallel in the picture"),
        ({"groups": [{"segments": [[0, 5, 90]]}, {"segments": WALL}]}, "groups.0.segments.0"),
        ({"groups": [{"segments": [[0, 5, 90, float("nan")]]}, {"segments": WALL}]}, "finite number"),
        ({"width": -640}, "width: Input should be greater than or equal to 1"),
        ({"size": 3}, "size: Extra inputs are not permitted"),
    ],
)
def test_marks_that_cannot_be_are_wrong_usage(tmp_path: Path, run: Run, said: dict[str, Any], wanted: str) -> None:
    ran = run("truth", "horizon", marks(tmp_path, **said))
    assert ran.code == 2
    assert wanted in ran.words
    assert "Next: " in ran.words


def test_files_that_are_not_there_or_no_json(tmp_path: Path, run: Run) -> None:
    absent = run("truth", "horizon", tmp_path / "none.json")
    assert (absent.code, "no such file" in absent.words) == (2, True)
    (tmp_path / "text.json").write_text("kerb: 3")
    assert "not JSON" in run("truth", "horizon", tmp_path / "text.json").words
    (tmp_path / "text.json").write_bytes(b"\xff\xfe\x00")
    assert "not a text file" in run("truth", "horizon", tmp_path / "text.json").words
    unwritable = run("truth", "horizon", marks(tmp_path), "-o", tmp_path / "no" / "truth.json")
    assert (unwritable.code, "cannot be written" in unwritable.words) == (1, True)
