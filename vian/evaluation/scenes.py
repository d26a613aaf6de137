"""Scenes with a known horizon: a folder of many, or one video with a truth file.

A folder holds `tracks.csv` (`scene,frame,t,id,x,y,w,h`; x and y are the box's upper left corner, t in s)
and `truth.json` (a scene's `width`, `height` and `horizon` with `a` and `b`: y = a x + b).
"""

import io
import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeVar

import numpy as np
import pyarrow as pa
import pyarrow.csv
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from extractors.media import Image
from vian.errors import WorldFailed, WrongUsage
from vian.evaluation.boxes import Boxes, boxes_of
from vian.evaluation.files import text_of
from vian.evaluation.lines import Horizon
from vian.evaluation.tsai import horizon_of, read_camera

TRACKS, TRUTH = "tracks.csv", "truth.json"
SECONDS_MAX = 1e10
"""Times beyond this are mistakes: some centuries from the first frame, s."""
_TYPES = {"scene": pa.string(), **dict.fromkeys(("frame", "id"), pa.int64())} | dict.fromkeys(
    ("t", "x", "y", "w", "h"), pa.float64()
)
T = TypeVar("T")
Finite = Annotated[float, Field(allow_inf_nan=False)]
Side = Annotated[int, Field(ge=1, le=100_000)]


class _Line(BaseModel):
    model_config = ConfigDict(frozen=True)
    a: Finite
    b: Finite


class SceneTruth(BaseModel):
    """The truth of one scene, as the file has it; what else it says is left alone."""

    model_config = ConfigDict(frozen=True)
    width: Side
    height: Side
    horizon: _Line

    @property
    def line(self) -> Horizon:
        """The true horizon."""
        return Horizon(self.horizon.a, self.horizon.b)


_Truths: TypeAdapter[dict[str, SceneTruth]] = TypeAdapter(dict[str, SceneTruth])


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """One camera's tracks and its true horizon."""

    name: str
    width: int
    height: int
    boxes: Boxes
    truth: Horizon
    picture: Image | None = None
    """a frame of it, where there is one"""


def read_scenes(folder: Path) -> list[Scene]:
    """The scenes of a folder, in order of name.

    Raises:
        WorldFailed: A file is not there or cannot be read.
        WrongUsage: A file does not hold what it should, or a scene lacks tracks or truth.
    """
    missing = [name for name in (TRACKS, TRUTH) if not (folder / name).is_file()]
    if missing:
        raise WorldFailed(
            f"{folder}: no {' and no '.join(missing)} in it, wanted {TRACKS} and {TRUTH}. "
            "Next: give such a folder, or a video with --truth FILE"
        )
    truths = _truths(folder / TRUTH)
    found = dict(_tracks(folder / TRACKS))
    odd = sorted(set(truths) ^ set(found))
    if odd:
        raise WrongUsage(
            f"{folder}: scene {odd[0]} is in one of {TRACKS} and {TRUTH} alone, wanted it in both. "
            "Next: complete the two files"
        )
    return [Scene(name, t.width, t.height, found[name], t.line) for name, t in sorted(truths.items())]


def read_truth(path: Path, width: int, height: int) -> Horizon:
    """The true horizon in a frame of this size: from `vian truth horizon`, or from a Tsai calibration (`.xml`).

    Raises:
        WorldFailed: The file cannot be read.
        WrongUsage: It holds no horizon, or that of a frame of other proportions.
    """
    if path.suffix.lower() == ".xml":
        camera = read_camera(path)
        own, line = (camera.width, camera.height), horizon_of(camera)
    else:
        truth = _validated(path, TypeAdapter(SceneTruth))
        own, line = (truth.width, truth.height), truth.line
    check_proportions(path, own, (width, height))
    return line.scaled(width / own[0], height / own[1])


def check_proportions(path: Path, own: tuple[int, int], wanted: tuple[int, int]) -> None:
    """Refuse a truth of a frame that is no smaller or larger copy of this one.

    Raises:
        WrongUsage: The proportions differ.
    """
    # A pixel of rounding in either side is no other picture.
    if abs(own[0] * wanted[1] - wanted[0] * own[1]) > max(own[0] + own[1], wanted[0] + wanted[1]):
        raise WrongUsage(
            f"{path}: for frames of {own[0]}x{own[1]} px, got some of {wanted[0]}x{wanted[1]}. "
            "Next: give the truth of this picture, uncut"
        )


def _truths(path: Path) -> dict[str, SceneTruth]:
    found = _validated(path, _Truths)
    if not found:
        raise WrongUsage(f"{path}: no scene in it. Next: add `name: {{width, height, horizon: {{a, b}}}}`")
    return found


def _validated(path: Path, adapter: TypeAdapter[T]) -> T:
    try:
        return adapter.validate_python(json.loads(text_of(path)))
    except json.JSONDecodeError as error:
        raise WrongUsage(f"{path}: not JSON: {error}. Next: mend that place") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the whole"
        raise WrongUsage(
            f"{path}: {where}: {first['msg']}. Next: give width, height and horizon {{a, b}}, as `vian truth horizon`"
        ) from error


def _tracks(path: Path) -> Iterator[tuple[str, Boxes]]:
    table = _table(path)
    names = np.asarray(table["scene"].to_pylist(), str)
    frame, number, t, x, y, w, h = (
        table[name].to_numpy(zero_copy_only=False) for name in ("frame", "id", "t", "x", "y", "w", "h")
    )
    bad = np.flatnonzero(~(np.abs(np.asarray(t, float)) <= SECONDS_MAX))
    if len(bad):
        raise WrongUsage(f"{path}: line {bad[0] + 2} has no time that can be. Next: mend or drop that line")
    xyxy = np.stack([x, y, x + w, y + h], axis=1).astype(float)
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        times_us = np.round(t[rows] * 1e6).astype(np.int64)
        boxes = boxes_of(f"{path}, scene {name}", frame[rows], number[rows], xyxy[rows], np.ones(len(rows)), times_us)
        yield str(name), boxes


def _table(path: Path) -> pa.Table:
    wanted = ",".join(_TYPES)
    try:
        table = pyarrow.csv.read_csv(
            io.BytesIO(f"{text_of(path)}\n".encode()), convert_options=pyarrow.csv.ConvertOptions(column_types=_TYPES)
        )
    except pa.ArrowInvalid as error:
        raise WrongUsage(f"{path}: {error}; wanted {wanted}. Next: mend that place") from error
    lacking = [name for name in _TYPES if name not in table.column_names]
    if lacking:
        raise WrongUsage(f"{path}: no column {', '.join(lacking)}; wanted {wanted}. Next: name the columns so")
    if not table.num_rows:
        raise WrongUsage(f"{path}: no row in it. Next: give a file with tracks")
    return table
