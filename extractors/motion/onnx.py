"""A detector that is the user's own model file (ONNX), run by onnxruntime on the processor.

Contract: the model takes one picture, `(1, 3, height, width)` float RGB from 0 to 1, letterboxed with grey,
and gives one table of candidates of the YOLO kind without a separate objectness: `(1, 4 + classes, n)`, each
candidate `x y w h` of its middle in pixels of the input and a score for every class; or, with suppression
built in, `(1, n, 6)`: `x1 y1 x2 y2 score class`. Which of the two it is follows from the shape; another one
is refused when the model is opened. No model comes with ViAn.

One thread, so that the same picture gives the same boxes. `onnxruntime` is the extra `vian[onnx]`.
"""

import hashlib
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from extractors.errors import DetectorFailed
from extractors.media import Image
from extractors.motion.blobs import BoxesXyxy, xyxy
from extractors.motion.detection import Detections

GREY = 114
"""What surrounds a letterboxed picture, as in the training of the usual models."""
OVERLAP_MAX = 0.6
"""Of two boxes that overlap more (intersection over union), the surer one is kept."""
SCORE_MIN = 0.1
"""Candidates below this are not looked at; the tracker takes nothing below."""
SIDE = 640
"""Side of the input, px, where the model leaves it open."""


@dataclass(frozen=True, slots=True)
class Letterbox:
    """How a picture was fitted into the model's input."""

    scale: float
    """pixels of the input for one of the picture"""
    left: int
    top: int


class OnnxDetector:
    """Objects as a model file finds them; a `extractors.motion.detection.Detector`."""

    def __init__(self, path: Path, classes: Collection[int] | None = None) -> None:
        """Open the model.

        Args:
            path: The model file.
            classes: Numbers of the classes that are objects here; all by default.

        Raises:
            DetectorFailed: onnxruntime is missing, or the file is no model that this can read.
        """
        self._path, self._classes = path, classes
        try:
            model = path.read_bytes()
        except OSError as error:
            raise DetectorFailed(f"{path} cannot be read: {error.strerror}. Next: name a model file") from error
        self.sha256 = hashlib.sha256(model).hexdigest()
        self._session = _session(path, model)
        given = self._session.get_inputs()[0]
        if len(self._session.get_inputs()) != 1 or len(given.shape) != 4 or given.type != "tensor(float)":
            raise DetectorFailed(
                f"{path}: the model's input must be one picture, float (1, 3, height, width), got {given.type} "
                f"{given.shape}. Next: export the model to ONNX with a float input"
            )
        self._name = given.name
        self._height, self._width = (side if isinstance(side, int) else SIDE for side in given.shape[2:])

    def detect(self, image: Image) -> Detections:
        """The objects in one picture.

        Raises:
            DetectorFailed: The model stopped, or gave a table of another shape.
        """
        fitted, box = letterboxed(image, self._width, self._height)
        picture = np.ascontiguousarray(fitted[None, :, :, ::-1].transpose(0, 3, 1, 2), np.float32) / 255
        try:
            table = self._session.run(None, {self._name: picture})[0]
        except Exception as error:  # onnxruntime raises classes of its own, which share no base of theirs
            raise DetectorFailed(f"{self._path}: the model stopped on a picture: {error}") from error
        boxes, scores, classes = self._candidates(np.asarray(table, np.float64))
        keep = scores >= SCORE_MIN
        if self._classes is not None:
            keep &= np.isin(classes, tuple(self._classes))
        return suppressed(unfitted(boxes[keep], box), scores[keep])

    def _candidates(self, table: npt.NDArray[np.float64]) -> tuple[BoxesXyxy, Any, Any]:
        """Boxes in px of the input, scores and classes of all candidates."""
        if table.ndim == 3 and table.shape[2] == 6:
            return table[0, :, :4], table[0, :, 4], table[0, :, 5].astype(int)
        if table.ndim == 3 and table.shape[1] > 4:
            x, y, w, h = table[0, :4]
            scores = table[0, 4:]
            return xyxy(np.stack([x, y + h / 2, w, h], axis=1)), scores.max(axis=0), scores.argmax(axis=0)
        raise DetectorFailed(
            f"{self._path}: the model's output must be (1, 4 + classes, n) or (1, n, 6), got {table.shape}. "
            "Next: export the model without a head of its own kind"
        )


def letterboxed(image: Image, width: int, height: int) -> tuple[Image, Letterbox]:
    """The picture in the middle of one of this size, as large as it fits, and how."""
    scale = min(width / image.shape[1], height / image.shape[0])
    size = (max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale)))
    left, top = (width - size[0]) // 2, (height - size[1]) // 2
    whole = np.full((height, width, 3), GREY, np.uint8)
    whole[top : top + size[1], left : left + size[0]] = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return whole, Letterbox(scale, left, top)


def unfitted(boxes_xyxy: BoxesXyxy, box: Letterbox) -> BoxesXyxy:
    """Boxes of the input in px of the picture, `(n, 4)`."""
    return np.asarray((boxes_xyxy - [box.left, box.top, box.left, box.top]) / box.scale)


def suppressed(boxes_xyxy: BoxesXyxy, scores: npt.NDArray[np.float64]) -> Detections:
    """The detections without those that a surer one overlaps, surest first."""
    if not len(scores):
        return Detections.none()
    corner_wh = np.concatenate([boxes_xyxy[:, :2], boxes_xyxy[:, 2:] - boxes_xyxy[:, :2]], axis=1)
    kept = np.asarray(cv2.dnn.NMSBoxes(corner_wh.tolist(), scores.tolist(), 0.0, OVERLAP_MAX), int).ravel()
    return Detections.clear(boxes_xyxy[kept], scores[kept])


def _session(path: Path, model: bytes) -> Any:
    try:
        import onnxruntime
    except ImportError as error:
        raise DetectorFailed("a model needs onnxruntime. Next: pip install 'vian[onnx]'") from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # as above
        raise DetectorFailed(f"{path} cannot be opened as an ONNX model: {error}. Next: name a model file") from error
