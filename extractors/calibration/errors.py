"""What can go wrong in calibration.

CalibrationError
├── NotACamera      numbers that are no camera, or lines from which none follows
└── NotDecided      the tracks do not decide where the camera stands
"""

from extractors.errors import ExtractorError


class CalibrationError(ExtractorError):
    """A calibration cannot be had."""


class NotACamera(CalibrationError):
    """Numbers that are no camera, or lines from which none follows."""


class NotDecided(CalibrationError):
    """The tracks do not decide where the camera stands."""
