"""SORT and ByteTrack of the package `trackers`, run in an environment of its own.

    PYTHON -m benchmarks.trackers_peer NAME FPS DETECTIONS RESULT

Never imported by ours: the package brings `opencv-python`, which writes over the headless OpenCV. Detections
and result are files as MOTChallenge has them. Parameters are the package's own, but for the frame rate.
"""

import sys
from pathlib import Path

import numpy as np
import supervision
from trackers import ByteTrackTracker, SORTTracker

TRACKERS = {"SORT": SORTTracker, "ByteTrack": ByteTrackTracker}


def main() -> None:
    """Track the detections named on the command line."""
    name, fps, given, result = sys.argv[1:]
    rows = np.loadtxt(given, delimiter=",", ndmin=2)
    tracker = TRACKERS[name](frame_rate=float(fps))
    lines = []
    for frame in range(1, int(rows[:, 0].max()) + 1):
        here = rows[rows[:, 0] == frame]
        boxes = np.concatenate([here[:, 2:4], here[:, 2:4] + here[:, 4:6]], axis=1).astype(np.float32)
        found = tracker.update(supervision.Detections(xyxy=boxes, confidence=here[:, 6].astype(np.float32)))
        numbers = found.tracker_id if found.tracker_id is not None else np.zeros(0, int)
        for number, (x1, y1, x2, y2) in zip(numbers, found.xyxy, strict=True):
            if number >= 0:  # the package counts from 0, and gives -1 to what is not confirmed
                lines.append(f"{frame},{number + 1},{x1:.3f},{y1:.3f},{x2 - x1:.3f},{y2 - y1:.3f},1,-1,-1,-1\n")
    Path(result).write_text("".join(lines))


if __name__ == "__main__":
    main()
