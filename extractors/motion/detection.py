"""What is detected in one picture, and what a detector is.

Motion is no detector in this sense: what it makes of a picture rests on those before it and on what the tracks
expect (`extractors.motion.covering`). It gives the same detections.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from extractors.media import Image
from extractors.motion.appearance import LOOKS
from extractors.motion.blobs import BoxesXyxy


@dataclass(frozen=True, slots=True, eq=False)
class Detections:
    """Objects in one picture, `n` of them; px of the analysed picture."""

    boxes_xyxy: BoxesXyxy
    """`(n, 4)` px"""
    scores: npt.NDArray[np.float64]
    """how sure each is, 0 to 1, `(n,)`"""
    doubts: npt.NDArray[np.float64]
    """how many times less than a clear view its box says of position and size, at least 1, `(n,)`"""
    looks: npt.NDArray[np.float64]
    """how each looks, as `extractors.motion.appearance` describes it, `(n, 32)`; NaN where that is unknown"""

    @classmethod
    def none(cls) -> "Detections":
        """Nothing found."""
        return cls.clear(np.zeros((0, 4)), np.zeros(0))

    @classmethod
    def clear(cls, boxes_xyxy: BoxesXyxy, scores: npt.NDArray[np.float64]) -> "Detections":
        """Boxes that are what they seem, of unknown looks."""
        return cls(boxes_xyxy, scores, np.ones(len(scores)), np.full((len(scores), LOOKS), np.nan))

    def where(self, chosen: npt.NDArray[np.bool_]) -> "Detections":
        """Those that are chosen, `(n,)`."""
        return Detections(self.boxes_xyxy[chosen], self.scores[chosen], self.doubts[chosen], self.looks[chosen])

    def __len__(self) -> int:
        return len(self.scores)


def joined(parts: Sequence[Detections]) -> Detections:
    """All of the detections, in their order; one part at least."""
    return Detections(
        np.concatenate([part.boxes_xyxy for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.doubts for part in parts]),
        np.concatenate([part.looks for part in parts]),
    )


class Detector(Protocol):
    """Finds objects in one picture."""

    def detect(self, image: Image) -> Detections:
        """The objects, in any order; the same picture gives the same objects.

        Raises:
            DetectorFailed: The detector cannot work on the picture.
        """
        ...
