"""Motion: moving objects found by background subtraction and followed by a Kalman filter."""

from extractors.motion.alone import DetectedFrame, track_detections
from extractors.motion.calibrated import CalibratedSizes
from extractors.motion.config import NAME, VERSION, MotionConfig
from extractors.motion.detection import Detections, Detector
from extractors.motion.extract import Calibrated, Extraction, Seen, extract
from extractors.motion.ignored import IgnoredArea, read_ignored_area
from extractors.motion.sizes import SizePrior, Sizes

__all__ = [
    "NAME",
    "VERSION",
    "Calibrated",
    "CalibratedSizes",
    "DetectedFrame",
    "Detections",
    "Detector",
    "Extraction",
    "IgnoredArea",
    "MotionConfig",
    "Seen",
    "SizePrior",
    "Sizes",
    "extract",
    "read_ignored_area",
    "track_detections",
]
