"""Tracks from files: MOTChallenge text, and the XML of the PETS annotations.

MOTChallenge counts frames from 1 and gives left, top, width, height; PETS counts from 0 and gives
middles. Both become boxes with frames from 0.
"""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from vian.errors import WorldFailed, WrongUsage
from vian.evaluation.boxes import Boxes, Floats, Ints, boxes_of

BYTES_MAX = 256 * 2**20
"""A longer file is no list of boxes that one evaluation takes, bytes."""
MOT_COLUMNS_MIN = 6


def text_of(path: Path) -> str:
    """The file's text.

    Raises:
        WorldFailed: It is not there or cannot be read.
        WrongUsage: It is empty, too long, or not text.
    """
    try:
        size = path.stat().st_size
        if size > BYTES_MAX:
            raise WrongUsage(f"{path}: {size} bytes, at most {BYTES_MAX} are read. Next: cut it into parts")
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise WorldFailed(f"{path}: {(error.strerror or str(error)).lower()}. Next: check the name") from error
    except UnicodeDecodeError as error:
        raise WrongUsage(f"{path}: not a text file. Next: give the file that the command's help names") from error
    if not text.strip():
        raise WrongUsage(f"{path}: the file is empty. Next: give one with data")
    return text


def read_boxes(path: Path, *, fps: float, is_truth: bool = False) -> Boxes:
    """Boxes of a MOTChallenge file, or of a PETS annotation where the name ends with `.xml`.

    Args:
        path: The file.
        fps: Frames per second, from which times follow.
        is_truth: Whether rows whose seventh column is 0 are left out, as MOTChallenge's ground truth has them.

    Raises:
        WorldFailed: The file cannot be read.
        WrongUsage: It does not hold what it should.
    """
    return _pets(path, fps) if path.suffix.lower() == ".xml" else _mot(path, fps, is_truth=is_truth)


def write_mot(boxes: Boxes, path: Path) -> None:
    """Write the boxes as a MOTChallenge result."""
    sizes = boxes.xyxy[:, 2:] - boxes.xyxy[:, :2]
    rows = np.column_stack([boxes.frame + 1, boxes.track_id, boxes.xyxy[:, :2], sizes, boxes.confidence])
    np.savetxt(path, rows, fmt="%d,%d,%.3f,%.3f,%.3f,%.3f,%.6f,-1,-1,-1")


def _mot(path: Path, fps: float, *, is_truth: bool) -> Boxes:
    lines = [line for line in text_of(path).splitlines() if line.strip()]
    wanted = "frame,id,left,top,width,height[,score,...]"
    widths = {line.count(",") + 1 for line in lines}
    if len(widths) > 1 or min(widths) < MOT_COLUMNS_MIN:
        raise WrongUsage(
            f"{path}: rows of {', '.join(map(str, sorted(widths)))} columns, wanted {wanted} in each. "
            "Next: give a file as MOTChallenge has it"
        )
    try:
        rows = np.loadtxt(lines, delimiter=",", ndmin=2, usecols=range(min(min(widths), 7)))
    except ValueError as error:
        raise WrongUsage(f"{path}: {error}; wanted numbers, {wanted}. Next: drop headers and mend that row") from error
    confidence = rows[:, 6] if rows.shape[1] > MOT_COLUMNS_MIN else np.ones(len(rows))
    if is_truth:
        rows, confidence = rows[confidence != 0], confidence[confidence != 0]
    xyxy = np.concatenate([rows[:, 2:4], rows[:, 2:4] + rows[:, 4:6]], axis=1)
    times_us = _times(rows[:, 0] - 1, fps)
    return boxes_of(path, rows[:, 0] - 1, rows[:, 1], xyxy, confidence, times_us)


def _pets(path: Path, fps: float) -> Boxes:
    try:
        root = ElementTree.fromstring(text_of(path))
        rows = np.array(
            [
                (frame.attrib["number"], item.attrib["id"], *(box.attrib[name] for name in ("xc", "yc", "w", "h")))
                for frame in root.iter("frame")
                for item in frame.iter("object")
                for box in item.iter("box")
            ],
            float,
        ).reshape(-1, 6)
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise WrongUsage(
            f"{path}: not an annotation as PETS has it ({error!r}), wanted frame/objectlist/object/box with xc, yc, w, "
            "h. Next: give that, or a MOTChallenge file named *.txt"
        ) from error
    if not len(rows):
        raise WrongUsage(f"{path}: no boxes in it, wanted frame/objectlist/object/box. Next: give another annotation")
    middle, half = rows[:, 2:4], rows[:, 4:6] / 2
    xyxy = np.concatenate([middle - half, middle + half], axis=1)
    return boxes_of(path, rows[:, 0], rows[:, 1], xyxy, np.ones(len(rows)), _times(rows[:, 0], fps))


def _times(frames: Floats, fps: float) -> Ints:
    # What is no number is refused with its row afterwards.
    return np.asarray(np.round(np.nan_to_num(frames, posinf=0, neginf=0) / fps * 1e6), np.int64)
