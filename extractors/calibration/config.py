"""Every parameter of the calibration extractor, with its unit and its reason.

Lengths in the picture are shares of an object's own size, so one configuration serves all resolutions. The defaults
come from optics and anthropometry (docs/decisions/0039-calibration-from-upright-people.md), not from one data set.
"""

import hashlib
import json
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

NAME = "calibration"
"""name of this extractor in the log"""
VERSION = "1"
"""version of its method; a change that says other things for the same tracks raises it"""

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]


class CalibrationConfig(BaseModel):
    """How a camera is found from its tracks."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    focal_share: Positive = 1.0
    """middle of the prior of the focal length, of the frame's longer side: 53° of view"""
    focal_spread: Positive = 0.5
    """standard deviation of its logarithm: two thirds of all cameras see 33° to 79° of view"""
    pitch_rad: float = 0.4
    """middle of the prior of the pitch: surveillance cameras look down, rad"""
    pitch_spread_rad: Positive = 0.3
    """its standard deviation: level to 45° within one and a half of it, rad"""
    roll_spread_rad: Positive = 0.1
    """standard deviation of the roll around 0: few cameras hang askew by more than 10°, rad"""

    person_height_m: Positive = 1.70
    """mean height of an adult, m (women 1.63, men 1.76 in high-income countries: NCD Risk Factor Collaboration, A
    century of trends in adult human height, eLife 5 (2016) e13410)"""
    person_spread_m: Positive = 0.09
    """standard deviation over adults of both sexes, m: 0.065 within each, and the difference of their means"""
    mean_share: Positive = 0.04
    """standard deviation of the logarithm of the mean height of those who pass here, boxes' common error included:
    children, heels, hats, and one or two pixels too many at both ends of a box"""

    speed_mps: Positive = 1.3
    """middle of the prior of the mean speed of those who walk here, m/s (Weidmann, Transporttechnik der Fussgaenger,
    1993: 1.34)"""
    speed_mean_spread: Positive = 0.4
    """standard deviation of its logarithm: places differ, and clocks of recordings may be wrong by half"""
    speed_spread: Positive = 0.25
    """standard deviation of the logarithm of one walker's mean speed (Weidmann: 0.26 of 1.34 m/s): in all directions
    people are equally fast, which is what tells the focal length"""
    speed_step_spread: Positive = 0.2
    """standard deviation of the logarithm of a walker's speed on one stretch around the walker's own mean"""
    chord_share: Positive = 1.0
    """length of such a stretch, of the box's height: noise of the foot is small beside it"""

    noise_share: Positive = 0.04
    """standard deviation of a box's height, of itself: a walker's own goes up and down so far"""
    noise_px: Positive = 1.0
    """standard deviation of a box's height besides, px"""
    noise_least: Annotated[float, Field(gt=0, le=1)] = 0.1
    """the boxes' noise is taken from themselves, between this share of what is said above and its inverse"""
    robust: Positive = 2.5
    """deviations from which on a box or a track counts less (pseudo-Huber), standard deviations"""

    confidence_min: Share = 0.5
    """points less sure are left out: what was only expected measures nothing"""
    edge_share: Share = 0.01
    """boxes nearer to the picture's edge may be cut off and are left out, of the picture's height"""
    aspect_min: Positive = 1.3
    """a track is upright when the median of its boxes' heights over their widths is above this ..."""
    aspect_max: Positive = 6.0
    """... and below this"""
    step_share: Positive = 0.25
    """a track's box is taken when its foot went so far since the last one taken, of the box's height ..."""
    points_min: Annotated[int, Field(ge=2)] = 4
    """... and a track counts from so many on"""
    points_max: Annotated[int, Field(ge=8)] = 24
    """so many boxes of one track are kept: every second is dropped, and the step doubled, when there are more"""
    tracks_min: Annotated[int, Field(ge=2)] = 5
    """fewer upright tracks give no calibration"""
    tracks_max: Annotated[int, Field(ge=5)] = 200
    """so many tracks are kept, the newest: the memory and the time of an update are bounded by it"""

    explained_min: Share = 0.6
    """share of the boxes that a camera must explain: below it they are no upright things on one plane"""
    focal_error_max: Positive = 0.25
    """standard deviation of the focal length's logarithm from which on nothing is said: lengths along the view would be
    as wrong"""
    height_error_max: Positive = 0.2
    """standard deviation of the camera height's logarithm from which on nothing is said: all lengths would be as
    wrong"""
    growth_share: Share = 0.25
    """tracks are looked at again when there are so many more, of those that there were ..."""
    growth_min: Annotated[int, Field(ge=1)] = 3
    """... and so many at least"""
    firmer_share: Share = 0.9
    """a calibration is said again when its standard deviations fell to this share of those said before (geometric
    mean) ..."""
    moved_deviations: Positive = 1.0
    """... or when it moved so far, in standard deviations said before (Mahalanobis): as far as those say it may"""

    @property
    def config_hash(self) -> bytes:
        """SHA-256 of the configuration's canonical form, 32 bytes."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).digest()
