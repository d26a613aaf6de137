"""Motion: moving objects found by background subtraction and followed by a Kalman filter."""

from extractors.motion.config import NAME, VERSION, MotionConfig
from extractors.motion.extract import Extraction, Seen, extract
from extractors.motion.ignored import IgnoredArea, read_ignored_area

__all__ = ["NAME", "VERSION", "Extraction", "IgnoredArea", "MotionConfig", "Seen", "extract", "read_ignored_area"]
