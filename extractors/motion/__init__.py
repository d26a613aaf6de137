"""Motion: moving objects found by background subtraction and followed by a Kalman filter."""

from extractors.motion.alone import DetectedFrame, track_detections
from extractors.motion.config import NAME, VERSION, MotionConfig
from extractors.motion.detection import Detections, Detector
from extractors.motion.extract import Extraction, Seen, extract
from extractors.motion.ignored import IgnoredArea, read_ignored_area

__all__ = [
    "NAME",
    "VERSION",
    "DetectedFrame",
    "Detections",
    "Detector",
    "Extraction",
    "IgnoredArea",
    "MotionConfig",
    "Seen",
    "extract",
    "read_ignored_area",
    "track_detections",
]
