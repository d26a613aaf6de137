"""A calibration from a file: the fields of `camera_calibrated` that say where pixels lie on the ground."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Protocol

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from events import CameraCalibrated, events_of
from extractors.calibration import CalibrationConfig, CalibrationFold
from vian.errors import WrongUsage
from vian.evaluation.boxes import Boxes
from vian.evaluation.files import text_of

Floats = npt.NDArray[np.float64]
Number = Annotated[float, Field(allow_inf_nan=False)]
Row = tuple[Number, Number, Number]


class _Read(BaseModel):
    model_config = ConfigDict(frozen=True)
    homography: tuple[Row, Row, Row]
    width: Annotated[int, Field(ge=1, le=100_000)]
    height: Annotated[int, Field(ge=1, le=100_000)]


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """Where a camera's pixels lie on the ground."""

    width: int
    """of the frame, px"""
    height: int
    """of the frame, px"""
    matrix: Floats
    """`(3, 3)`: (X, Y, W) = H (x, y, 1) of px; X/W and Y/W in m, where W > 0"""


class Calibrator(Protocol):
    """Finds where a camera's pixels lie on the ground, from boxes of what moved."""

    def calibrate(self, boxes: Boxes, width: int, height: int) -> Calibration | None:
        """The calibration; None to abstain. Nothing is kept between calls."""
        ...


class TrackCalibration:
    """The calibrator that ships: `extractors.calibration`, with its parameters for the kind of boxes."""

    def __init__(self, *, is_of_blobs: bool) -> None:
        """Choose the parameters.

        Args:
            is_of_blobs: Whether the boxes are those of the motion extractor; else of detectors and annotators.
        """
        self._config = CalibrationConfig() if is_of_blobs else CalibrationConfig.of_boxes()

    def calibrate(self, boxes: Boxes, width: int, height: int) -> Calibration | None:
        """The last calibration that it says, or none."""
        fold = CalibrationFold(self._config, (width, height))
        fold.add_points(boxes.time_us, boxes.track_id, boxes.xyxy, boxes.confidence)
        said = [event for batch in fold.finish() for event in events_of(batch)]
        if not said:
            return None
        last = said[-1]
        assert isinstance(last, CameraCalibrated), "the fold says nothing else"
        return Calibration(last.width, last.height, np.array(json.loads(last.homography)))


def read_calibration(path: Path) -> Calibration:
    """The calibration of a file.

    Raises:
        WorldFailed: It cannot be read.
        WrongUsage: It does not hold what it should.
    """
    try:
        said = json.loads(text_of(path))
        if isinstance(said, dict) and isinstance(said.get("homography"), str):
            said["homography"] = json.loads(said["homography"])  # as the event has it
        read = _Read.model_validate(said)
    except json.JSONDecodeError as error:
        raise WrongUsage(f"{path}: not JSON: {error}. Next: mend that place") from error
    except ValidationError as error:
        first = error.errors()[0]
        raise WrongUsage(
            f"{path}: {'.'.join(map(str, first['loc'])) or 'the whole'}: {first['msg']}; wanted homography (3 x 3), "
            "width and height. Next: mend that place"
        ) from error
    matrix = np.array(read.homography)
    if abs(np.linalg.det(matrix / np.abs(matrix).max(initial=1e-300))) < 1e-15:
        raise WrongUsage(f"{path}: the homography cannot be inverted. Next: give one of a camera")
    return Calibration(read.width, read.height, matrix)
