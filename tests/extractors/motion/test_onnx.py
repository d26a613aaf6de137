"""A model file that says always the same, written byte by byte: no model and no exporter is needed."""

import struct
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from extractors.errors import DetectorFailed
from extractors.media import Frame
from extractors.motion import MotionConfig, extract
from extractors.motion.onnx import OnnxDetector, letterboxed, suppressed, unfitted
from tests.extractors.motion.runs import Run

pytest.importorskip("onnxruntime")

FLOAT = 1


def _varint(value: int) -> bytes:
    low, rest = value & 0x7F, value >> 7
    return bytes([low | 0x80]) + _varint(rest) if rest else bytes([low])


def _field(number: int, value: bytes | str | int) -> bytes:
    """One field of a protobuf message: a number, or text or a message with its length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _value(name: str, shape: tuple[int, ...]) -> bytes:
    dimensions = b"".join(_field(1, _field(1, size)) for size in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, FLOAT) + _field(2, dimensions)))


def model(path: Path, table: np.ndarray, shape: tuple[int, ...] = (1, 3, 64, 64)) -> Path:
    """A model that gives this table, whatever the picture (ONNX's protobuf, opset 17)."""
    data = b"".join(struct.pack("<f", value) for value in table.ravel())
    tensor = b"".join(_field(1, size) for size in table.shape) + _field(2, FLOAT) + _field(8, "table") + _field(9, data)
    node = _field(1, "table") + _field(2, "found") + _field(4, "Identity")
    graph = _field(1, node) + _field(2, "always") + _field(5, tensor)
    graph += _field(11, _value("picture", shape)) + _field(12, _value("found", table.shape))
    path.write_bytes(_field(1, 8) + _field(7, graph) + _field(8, _field(2, 17)))
    return path


# Middle, size and scores of two classes, by column; the second overlaps the first.
CANDIDATES = np.array([[[20, 21, 50], [30, 30, 30], [10, 10, 8], [20, 20, 20], [0.9, 0.8, 0.1], [0.0, 0.0, 0.8]]])
IMAGE = np.zeros((64, 128, 3), np.uint8)  # fits at half its size: 16 px of grey above and below


def test_candidates_become_boxes_of_the_picture(tmp_path: Path) -> None:
    found = OnnxDetector(model(tmp_path / "m.onnx", CANDIDATES)).detect(IMAGE)
    np.testing.assert_allclose(found.boxes_xyxy, [[30, 8, 50, 48], [92, 8, 108, 48]], atol=1e-4)
    np.testing.assert_allclose(found.scores, [0.9, 0.8], atol=1e-6)


def test_other_classes_are_left_out(tmp_path: Path) -> None:
    found = OnnxDetector(model(tmp_path / "m.onnx", CANDIDATES), [1]).detect(IMAGE)
    np.testing.assert_allclose(found.scores, [0.8], atol=1e-6)


def test_a_table_with_suppression_built_in_is_read(tmp_path: Path) -> None:
    table = np.array([[[15.0, 20, 25, 40, 0.9, 0], [0, 0, 0, 0, 0, 0]]])
    found = OnnxDetector(model(tmp_path / "m.onnx", table)).detect(IMAGE)
    np.testing.assert_allclose(found.boxes_xyxy, [[30, 8, 50, 48]], atol=1e-4)


def test_what_a_model_sees_is_tracked_even_if_it_stands(tmp_path: Path) -> None:
    detector = OnnxDetector(model(tmp_path / "m.onnx", CANDIDATES))
    pictures = [Frame(i, 100_000 * i, IMAGE) for i in range(20)]
    found = Run(list(extract(pictures, MotionConfig(), start_time=datetime(2026, 1, 1, tzinfo=UTC), detector=detector)))
    assert [(end.points, end.reason) for end in found.ends] == [(20, "end_of_video")] * 2


@pytest.mark.parametrize(
    "table, shape, message",
    [
        (np.zeros((1, 4)), (1, 3, 64, 64), r"output must be \(1, 4 \+ classes, n\) or \(1, n, 6\), got \(1, 4\)"),
        (CANDIDATES, (3, 64, 64), r"input must be one picture, float \(1, 3, height, width\), got"),
    ],
)
def test_a_model_of_another_kind_is_refused(
    tmp_path: Path, table: np.ndarray, shape: tuple[int, ...], message: str
) -> None:
    with pytest.raises(DetectorFailed, match=message):
        OnnxDetector(model(tmp_path / "m.onnx", table, shape)).detect(IMAGE)


def test_what_is_no_model_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "m.onnx"
    with pytest.raises(DetectorFailed, match=r"m.onnx cannot be read: No such file or directory. Next: name a model"):
        OnnxDetector(path)
    path.write_bytes(b"no model")
    with pytest.raises(DetectorFailed, match=r"m.onnx cannot be opened as an ONNX model: .* Next: name a model file"):
        OnnxDetector(path)


def test_a_letterbox_is_undone() -> None:
    fitted, box = letterboxed(np.full((90, 160, 3), 7, np.uint8), 64, 64)
    assert (fitted.shape, fitted[0, 0, 0], fitted[32, 32, 0]) == ((64, 64, 3), 114, 7)
    np.testing.assert_allclose(unfitted(np.array([[0.0, 14, 64, 50]]), box), [[0, 0, 160, 90]])


def test_nothing_suppresses_nothing() -> None:
    assert len(suppressed(np.zeros((0, 4)), np.zeros(0))) == 0
