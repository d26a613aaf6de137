"""Motion: moving objects found by background subtraction and followed by a Kalman filter."""

from extractors.motion.alone import DetectedFrame, track_detections
from extractors.motion.config import NAME, VERSION, MotionConfig
from extractors.motion.detection import Detections, Detector
from extractors.motion.extract import Extraction, Seen, extract

__all__ = [
    "NAME",
    "VERSION",
    "DetectedFrame",
    "Detections",
    "Detector",
    "Extraction",
    "MotionConfig",
    "Seen",
    "extract",
    "track_detections",
]
