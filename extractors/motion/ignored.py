"""An area of the picture in which motion does not count: a road behind the fence, a screen, a tree.

Contract: a picture file, white where motion is ignored and black where it is watched; it is stretched to the
size of the pictures, so one file does for other resolutions of the same view. What is ignored is taken out of the
foreground before objects are looked for, so an object that enters the area leaves the watched one.
"""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from extractors.errors import MaskUnreadable
from extractors.motion.background import Foreground
from extractors.motion.blobs import BoxesXyxy
from extractors.motion.held import Mask

IGNORED_MIN = 128
"""Grey level from which a pixel of the file is ignored."""
RATIO_TOLERANCE = 0.02
"""How far the file's ratio of sides may be from the pictures', of it: resolutions are rounded."""


@dataclass(frozen=True, slots=True, eq=False)
class IgnoredArea:
    """Where motion does not count."""

    name: str
    """what people call it"""
    mask: Mask
    """`(height, width)`, 255 where it is ignored"""

    @property
    def sha256(self) -> str:
        """Hash of size and pixels, hexadecimal: how a log names the area."""
        return hashlib.sha256(f"{self.mask.shape}".encode() + self.mask.tobytes()).hexdigest()

    def check_fits(self, width: int, height: int) -> None:
        """Whether it has the shape of pictures of this size.

        Raises:
            MaskUnreadable: It has not.
        """
        rows, columns = self.mask.shape
        if abs(columns * height / (rows * width) - 1) > RATIO_TOLERANCE:
            raise MaskUnreadable(
                f"{self.name}: is {columns}x{rows} px, and the video's pictures are {width}x{height}: the sides have "
                "another ratio. Next: draw it on a frame of the video"
            )

    def without(self, foreground: Foreground) -> Foreground:
        """The foreground outside of the area; its share stays that of the whole picture."""
        size = (foreground.mask.shape[1], foreground.mask.shape[0])
        ignored = cv2.resize(self.mask, size, interpolation=cv2.INTER_NEAREST)
        mask = np.where(ignored > 0, 0, foreground.mask).astype(np.uint8)
        return replace(foreground, mask=mask, share=cv2.countNonZero(mask) / mask.size)

    def is_watched(self, boxes_xyxy: BoxesXyxy, width: int, height: int) -> npt.NDArray[np.bool_]:
        """Which objects in a picture of this size stand outside of the area, `(n,)`: the middle of the lower edge."""
        rows, columns = self.mask.shape
        x = (boxes_xyxy[:, 0] + boxes_xyxy[:, 2]) / 2 * columns / width
        y = boxes_xyxy[:, 3] * rows / height - 0.5
        at = np.clip(np.stack([y, x]), 0, [[rows - 1], [columns - 1]]).astype(int)
        return np.asarray(self.mask[at[0], at[1]] == 0)


def read_ignored_area(path: Path) -> IgnoredArea:
    """The area that a picture file shows.

    Raises:
        MaskUnreadable: It is no picture, or leaves nothing to watch.
    """
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
    except OSError as error:
        raise MaskUnreadable(f"{path}: cannot be read: {error.strerror}. Next: check the name") from error
    grey = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if grey is None:
        raise MaskUnreadable(f"{path}: is no picture, wanted a PNG that is white where motion is ignored")
    mask = np.where(np.asarray(grey) >= IGNORED_MIN, 255, 0).astype(np.uint8)
    if mask.all():
        raise MaskUnreadable(f"{path}: is white all over, so nothing would be watched. Next: black is what is watched")
    return IgnoredArea(str(path), mask)
