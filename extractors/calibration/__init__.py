"""Calibration: a camera's focal length, pose and metres from the upright people in its picture."""

from extractors.calibration.camera import Camera, camera_of, meeting_point
from extractors.calibration.config import NAME, VERSION, CalibrationConfig
from extractors.calibration.errors import CalibrationError, NotACamera, NotDecided
from extractors.calibration.estimate import Estimate, Horizon, estimate
from extractors.calibration.fold import CalibrationFold
from extractors.calibration.ground import Ground, ground_of
from extractors.calibration.scale import CameraHeight, KnownLength, PersonHeight, Scale

__all__ = [
    "NAME",
    "VERSION",
    "CalibrationConfig",
    "CalibrationError",
    "CalibrationFold",
    "Camera",
    "CameraHeight",
    "Estimate",
    "Ground",
    "Horizon",
    "KnownLength",
    "NotACamera",
    "NotDecided",
    "PersonHeight",
    "Scale",
    "camera_of",
    "estimate",
    "ground_of",
    "meeting_point",
]
