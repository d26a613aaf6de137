"""Every parameter of the calibration extractor, with its unit and its reason.

How the camera is found is the horizon's configuration; here is how it gets metres, and when it is said. The defaults
are for the motion extractor's boxes, and their reasons in docs/decisions/0039-calibration-from-upright-people.md.
"""

import hashlib
import json
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field

from extractors.horizon import HorizonConfig

NAME = "calibration"
"""name of this extractor in the log"""
VERSION = "2"
"""version of its method; a change that says other things for the same tracks raises it"""

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]


class CalibrationConfig(BaseModel):
    """How a camera gets its metres."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    camera: HorizonConfig = Field(default_factory=HorizonConfig.of_blobs)
    """how tilt, roll, focal length and heights in camera heights are found"""

    person_height_m: Positive = 1.70
    """mean height of an adult, m (women 1.63, men 1.76 in high-income countries: NCD Risk Factor Collaboration, A
    century of trends in adult human height, eLife 5 (2016) e13410)"""
    person_spread_m: Positive = 0.07
    """standard deviation of the mean height of those who pass here, m: it lies between those of women and men, and
    children, heels and hats are among them"""
    box_share: Share = 0.08
    """what all boxes may be too high or too low by in common, standard deviation, of their height: the motion
    extractor closes gaps and keeps shadows, and a soft edge is wider than the body"""
    aspect_min: Positive = 1.3
    """these are upright people when the median of the boxes' heights over their widths is above this ..."""
    aspect_max: Positive = 6.0
    """... and below this; only then their height gives metres"""

    focal_error_max: Positive = 0.25
    """standard deviation of the focal length's logarithm from which on nothing is said: lengths along the view would be
    as wrong"""
    height_error_max: Positive = 0.2
    """standard deviation of the camera height's logarithm from which on nothing is said: all lengths would be as
    wrong"""
    firmer_share: Share = 0.9
    """a calibration is said again when its standard deviations fell to this share of those said before (geometric
    mean) ..."""
    moved_deviations: Positive = 1.0
    """... or when it moved so far, in standard deviations said before (Mahalanobis): as far as those say it may"""

    @classmethod
    def of_boxes(cls) -> Self:
        """The parameters for boxes of detectors and annotators, whose edges are the bodies' within a few percent."""
        return cls(camera=HorizonConfig(), box_share=0.02)

    @property
    def config_hash(self) -> bytes:
        """SHA-256 of the configuration's canonical form, 32 bytes."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).digest()
