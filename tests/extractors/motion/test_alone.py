"""The tracker alone, on boxes whose identity is known."""

import numpy as np

from extractors.motion import DetectedFrame, Detections, MotionConfig, track_detections
from tests.extractors.motion.runs import scored

FRAMES, FPS = 120, 10


def walkers() -> np.ndarray:
    """`frame id x1 y1 x2 y2` of two who cross, and one who stands."""
    rows = []
    for frame in range(FRAMES):
        for number, (x, y) in enumerate(((40 + 4 * frame, 200), (520 - 4 * frame, 230), (300, 330)), start=1):
            rows.append((frame, number, x - 15, y - 80, x + 15, y))
    return np.array(rows, float)


def detected(truth: np.ndarray, seed: int = 3, miss: float = 0.15) -> list[DetectedFrame]:
    """The truth with noise, misses, doubtful scores, and now and then a box of nothing."""
    random = np.random.default_rng(seed)
    frames = []
    for frame in range(FRAMES):
        boxes = truth[truth[:, 0] == frame][:, 2:]
        boxes = boxes[random.random(len(boxes)) > miss] + random.normal(0, 1.5, 4)
        sure = random.uniform(0.4, 1, len(boxes))
        if random.random() < 0.2:
            corner = random.uniform(0, 400, 2)
            boxes = np.vstack([boxes, np.tile(corner, 2) + np.array([0, 0, 30, 80])])
            sure = np.append(sure, 0.9)
        frames.append(DetectedFrame(frame, frame * 1_000_000 // FPS, Detections.clear(boxes, sure)))
    return frames


def tracked(frames: list[DetectedFrame]) -> np.ndarray:
    return track_detections(frames, MotionConfig(), width=560, height=360)


def test_who_crosses_and_who_stands_keeps_the_track() -> None:
    truth = walkers()
    found = scored(truth, tracked(detected(truth))[:, :6])
    assert found.switches == 0
    assert found.idf1 > 0.95
    assert found.mota > 0.9


def test_misses_are_bridged_on_the_straight_way() -> None:
    truth = walkers()[walkers()[:, 1] == 1]
    frames = detected(truth, miss=0)
    for gone in (50, 51, 52):
        frames[gone] = DetectedFrame(gone, gone * 1_000_000 // FPS, Detections.none())
    rows = tracked(frames)
    longest = rows[rows[:, 1] == rows[rows[:, 0] == 49][0, 1]]
    bridge = longest[(longest[:, 0] >= 50) & (longest[:, 0] <= 52)]
    assert bridge[:, 6].tolist() == [0, 0, 0]
    x = (longest[:, 2] + longest[:, 4])[(longest[:, 0] >= 49) & (longest[:, 0] <= 53)]
    np.testing.assert_allclose(np.diff(x, n=2), 0, atol=1e-3)


def test_the_same_boxes_give_the_same_tracks() -> None:
    np.testing.assert_array_equal(tracked(detected(walkers())), tracked(detected(walkers())))


def test_no_boxes_give_no_tracks() -> None:
    assert tracked([]).shape == (0, 7)
    assert tracked([DetectedFrame(0, 0, Detections.none())]).shape == (0, 7)
