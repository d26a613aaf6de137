"""The background under what stands still, kept as it was.

Contract: a region is held from the moment a track stands until it moves on or ends; in between the
background model is not updated there (`mask` says where), and `fill` decides foreground by the
difference to the remembered background. What turns out to be no object but the hole that one left in
a wrong background (a ghost) is named by `ghosts`, and must not be held any longer.

Source of the ghost test: edges at an object's outline belong to the picture, edges at a ghost's outline
to the background; after R. Cucchiara et al., "Detecting Moving Objects, Ghosts, and Shadows in Video
Streams", PAMI 2003.
"""

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from extractors.media import Image

Mask = npt.NDArray[np.uint8]
Box = npt.NDArray[np.float64]
Region = tuple[int, int, int, int]

FOREGROUND = 255
MARGIN = 0.15
"""A held region is the box and this share of its size on each side."""
DIFFERENCE = 20
"""Grey levels by which a pixel must differ from the held background, in some channel, to be foreground, at least."""
GHOST_EDGES = 2.0
"""The background's edges along the outline are stronger than the picture's by this factor for a ghost."""
OUTLINE = np.ones((3, 3), np.uint8)


class HeldBackground:
    """Regions in which the background is remembered, by track."""

    def __init__(self, width: int, height: int) -> None:
        self._width, self._height = width, height
        self._regions: dict[int, Region] = {}
        self._background = np.zeros((height, width, 3), np.uint8)
        self._mask = np.zeros((height, width), np.uint8)

    @property
    def mask(self) -> Mask | None:
        """Where the model must not learn, 255; None when nothing is held."""
        return self._mask if self._regions else None

    def hold(self, standing: dict[int, Box], dominant: Callable[[], Image]) -> None:
        """Hold these regions and no others.

        Args:
            standing: Boxes `(4,)` px, within the picture, by track.
            dominant: Gives the background as it is known now; called only when a region is new.
        """
        regions = {track: self._region(track, box) for track, box in standing.items()}
        if regions == self._regions:
            return
        mask = np.zeros_like(self._mask)
        for x1, y1, x2, y2 in regions.values():
            mask[y1:y2, x1:x2] = FOREGROUND
        is_new = (mask > 0) & (self._mask == 0)
        if is_new.any():
            self._background[is_new] = dominant()[is_new]
        self._regions, self._mask = regions, mask

    def fill(self, image: Image, mask: Mask, difference: float) -> None:
        """Write into the mask what is foreground in the held regions: what differs by more, grey levels."""
        for x1, y1, x2, y2 in self._regions.values():
            here = np.s_[y1:y2, x1:x2]
            blue, green, red = cv2.split(cv2.absdiff(image[here], self._background[here]))
            largest = cv2.max(cv2.max(blue, green), red)
            mask[here] = cv2.threshold(largest, difference, FOREGROUND, cv2.THRESH_BINARY)[1]

    def ghosts(self, image: Image, mask: Mask) -> frozenset[int]:
        """Tracks whose regions hold no object, but the hole that one left in the background."""
        return frozenset(
            track
            for track, (x1, y1, x2, y2) in self._regions.items()
            if _is_ghost(image[y1:y2, x1:x2], self._background[y1:y2, x1:x2], mask[y1:y2, x1:x2])
        )

    def _region(self, track: int, box: Box) -> Region:
        region = self._regions.get(track)
        if region and region[0] <= box[0] and region[1] <= box[1] and box[2] <= region[2] and box[3] <= region[3]:
            return region
        dx, dy = MARGIN * (box[2] - box[0]), MARGIN * (box[3] - box[1])
        return (
            max(0, int(box[0] - dx)),
            max(0, int(box[1] - dy)),
            min(self._width, int(box[2] + dx) + 1),
            min(self._height, int(box[3] + dy) + 1),
        )


def _is_ghost(image: Image, background: Image, mask: Mask) -> bool:
    outline = cv2.morphologyEx(cv2.medianBlur(mask, 5), cv2.MORPH_GRADIENT, OUTLINE) > 0
    if not outline.any():
        return False
    return bool(_edges(background)[outline].mean() > GHOST_EDGES * _edges(image)[outline].mean())


def _edges(image: Image) -> npt.NDArray[np.float32]:
    """Strength of the edges, `(height, width)`."""
    grey = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    dx = cv2.Sobel(grey, cv2.CV_32F, 1, 0)
    dy = cv2.Sobel(grey, cv2.CV_32F, 0, 1)
    return np.asarray(cv2.magnitude(dx, dy), np.float32)
