"""Motion: moving objects found by background subtraction and followed by a Kalman filter."""

from extractors.motion.config import NAME, VERSION, MotionConfig
from extractors.motion.extract import Extraction, Seen, extract

__all__ = ["NAME", "VERSION", "Extraction", "MotionConfig", "Seen", "extract"]
