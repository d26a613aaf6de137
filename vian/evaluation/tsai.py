"""Cameras calibrated by Tsai's model, as the PETS data sets publish them (XML).

World: mm, the ground is Z = 0. Camera: x right, y down, z ahead. Sensor coordinates are mm from the
principal point, undistorted `(Xu, Yu)` and distorted `(Xd, Yd)`: Xu = Xd (1 + kappa1 (Xd² + Yd²)).

Source: R. Y. Tsai, "A Versatile Camera Calibration Technique for High-Accuracy 3D Machine Vision
Metrology Using Off-the-Shelf TV Cameras and Lenses", 1987, section II.
"""

from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import numpy.typing as npt
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from vian.errors import WrongUsage
from vian.evaluation.files import text_of
from vian.evaluation.lines import Horizon

Floats = npt.NDArray[np.float64]
_ELEMENTS = {
    "Geometry": ("width", "height", "dpx", "dpy"),
    "Intrinsic": ("focal", "kappa1", "cx", "cy", "sx"),
    "Extrinsic": ("tx", "ty", "tz", "rx", "ry", "rz"),
}
HORIZON_SAMPLES = 97


@dataclass(frozen=True, slots=True, eq=False)
class TsaiCamera:
    """A calibrated camera."""

    width: int
    height: int
    focal_mm: float
    kappa1: float
    """per mm²"""
    centre_xy: Floats
    """principal point, `(2,)` px"""
    pitch_xy: Floats
    """mm of the sensor for a pixel, `(2,)`"""
    camera_from_world: Floats
    """rotation, `(3, 3)`"""
    translation_mm: Floats

    def undistorted(self, pixels_xy: Floats) -> Floats:
        """Sensor coordinates without distortion, `(n, 2)` mm, of pixels `(n, 2)`."""
        distorted = (pixels_xy - self.centre_xy) * self.pitch_xy
        return np.asarray(distorted * (1 + self.kappa1 * (distorted**2).sum(axis=1, keepdims=True)))

    def ground_of(self, pixels_xy: Floats) -> Floats:
        """Where the pixels' rays meet the ground, `(n, 2)` m, seen from above; NaN above the horizon."""
        sensor = self.undistorted(pixels_xy)
        rays = np.column_stack([sensor, np.full(len(sensor), self.focal_mm)]) @ self.camera_from_world
        eye = -self.camera_from_world.T @ self.translation_mm
        with np.errstate(divide="ignore", invalid="ignore"):
            ahead = -eye[2] / rays[:, 2]
        ground = (eye + np.where(ahead > 0, ahead, np.nan)[:, None] * rays)[:, :2] / 1000
        # An up-pointing Z makes (X, Y) counter-clockwise from above; the other way round Y is mirrored.
        return np.asarray(ground if eye[2] > 0 else ground * [1, -1])


def read_camera(path: Path) -> TsaiCamera:
    """The camera of a PETS calibration.

    Raises:
        WorldFailed: The file cannot be read.
        WrongUsage: It is no such calibration.
    """
    try:
        root = ElementTree.fromstring(text_of(path))
        said = {name: float(_element(root, tag).attrib[name]) for tag, names in _ELEMENTS.items() for name in names}
    except (ElementTree.ParseError, KeyError, ValueError) as error:
        raise WrongUsage(
            f"{path}: not a Tsai calibration as PETS has it ({_what(error)}), wanted Geometry, Intrinsic and "
            "Extrinsic. Next: give the camera's XML"
        ) from error
    if (
        not np.isfinite(list(said.values())).all()
        or min(said[k] for k in ("width", "height", "focal", "dpx", "sx")) <= 0
    ):
        raise WrongUsage(f"{path}: a calibration of numbers that cannot be. Next: give the camera's XML, unchanged")
    return TsaiCamera(
        width=int(said["width"]),
        height=int(said["height"]),
        focal_mm=said["focal"],
        kappa1=said["kappa1"],
        centre_xy=np.array([said["cx"], said["cy"]]),
        pitch_xy=np.array([said["dpx"] / said["sx"], said["dpy"]]),
        camera_from_world=Rotation.from_euler("xyz", [said["rx"], said["ry"], said["rz"]]).as_matrix(),
        translation_mm=np.array([said["tx"], said["ty"], said["tz"]]),
    )


def horizon_of(camera: TsaiCamera) -> Horizon:
    """The best line through the horizon of the distorted picture, over its width; px of the camera's frame.

    Directions of the ground are those without a part along the world's Z: r3 Xu + r6 Yu + r9 f = 0, with (r3, r6, r9)
    the rotation's last column. Where the lens distorts, that is a curve.
    """
    r3, r6, r9 = camera.camera_from_world[:, 2]

    def side(y: float, x: float) -> float:
        (sensor,) = camera.undistorted(np.array([[x, y]]))
        return float(r3 * sensor[0] + r6 * sensor[1] + r9 * camera.focal_mm)

    x = np.linspace(0, camera.width - 1, HORIZON_SAMPLES)
    reach = 3.0 * camera.height
    y = [brentq(side, camera.centre_xy[1] - reach, camera.centre_xy[1] + reach, args=(each,)) for each in x]
    slope, offset = np.polyfit(x, y, 1)
    return Horizon(float(slope), float(offset))


def _what(error: Exception) -> str:
    return f"no {error.args[0]} in it" if isinstance(error, KeyError) else str(error)


def _element(root: ElementTree.Element, tag: str) -> ElementTree.Element:
    found = root.find(tag)
    if found is None:
        raise KeyError(tag)
    return found
