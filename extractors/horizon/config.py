"""Every parameter of the horizon extractor, with its unit and its reason.

Priors describe surveillance cameras and people in general, and are wide: they keep what the data do not
decide within what exists, and their width goes into the covariance (docs/decisions/0037-horizon.md).
"""

import hashlib
import json
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field

NAME = "horizon"
"""name of this extractor in the log"""
VERSION = "2"
"""version of its method; a change that says other things for the same points raises it"""

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]
Count = Annotated[int, Field(ge=1)]


class HorizonConfig(BaseModel):
    """How the horizon is found from tracks."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    confidence_min: Share = 0.5
    """boxes with less are predicted rather than seen, and say nothing of an object's size"""
    clear_confidence: Share = 0.0
    """boxes with less were sized as expected rather than measured: an estimate heeds them, but is no surer by them"""
    border_share: Share = 0.008
    """a box whose edge lies this near to the frame's is cut by it and left out, of the frame's height"""
    height_share_min: Share = 0.02
    """boxes lower than this are left out: a pixel more or less is then a tenth, of the frame's height"""
    stride: Positive = 0.5
    """points of a track within this distance of each other are one place, box heights: about a step, so
    that the swing of legs is averaged out and people who stand weigh no more than others"""
    place_points_max: Count = 64
    """points of which one place's median is taken; later ones at the same place are left out"""
    track_places_max: Count = 48
    """places kept of one track; of a longer one every second is dropped again and again"""
    vote_places_min: Annotated[int, Field(ge=3)] = 4
    """places from which a track votes"""
    vote_significance: Positive = 2.0
    """standard deviations by which its height must change along its way, to vote"""
    tracks_max: Count = 256
    """tracks that an estimate rests on, the newest; bounds time and memory"""
    gone_s: Positive = 3.0
    """a track not seen for longer gets its vote, s"""

    update_s: Positive = 5.0
    """media time between two estimates, s ..."""
    fresh_share: Share = 0.23
    """... and points that are new since the one before, of those that it rested on: by fewer it cannot firm up to 0.9
    of its deviation, 1 / sqrt(1.23)"""
    tracks_min: Count = 4
    """votes from which the horizon is estimated; fewer cannot contradict a false one"""
    deviation_share_max: Positive = 0.2
    """an estimate less certain than this anywhere in the frame is not emitted (standard deviation, of the
    frame's height)"""
    roll_learnt_min: Share = 0.5
    """share by which the data must narrow what is known of the roll beforehand; where all move up and down
    one line they do not"""
    noise_max: Positive = 0.1
    """largest typical error of a box's edge (share of its height): beyond it these are no objects on a plane"""
    moved_deviations: Positive = 0.25
    """an estimate is emitted anew when it has moved by so many of its standard deviations ..."""
    firmed_share: Share = 0.9
    """... or when its standard deviation has shrunk to this share"""

    moving_tracks_min: Annotated[int, Field(ge=3)] = 4
    """tracks in one frame from which it can be told that the camera moves ..."""
    moving_spread_max: Positive = 0.25
    """... by velocities that differ from their mean by less than this share of it; objects at different
    distances and with different aims differ by more ..."""
    moving_speed_min: Positive = 0.02
    """... and are faster than this, frame heights per s"""
    moving_window_s: Positive = 3.0
    """time over which frames are counted, s; as long is waited after the last such frame"""
    moving_share_min: Share = 0.5
    """share of these frames that must say so"""

    focal_widths: Positive = 1.05
    """prior median of the focal length, frame widths: fields of view from 30° to 90° are usual"""
    focal_spread: Positive = 0.35
    """prior standard deviation of its logarithm"""
    tilt_deg: float = 20.0
    """prior mean of the tilt below the horizontal, degrees ..."""
    tilt_spread_deg: Positive = 20.0
    """... and its standard deviation, degrees"""
    roll_spread_deg: Positive = 8.0
    """prior standard deviation of the roll, degrees"""
    size_median: Positive = 0.33
    """prior median of an object's height, camera heights: people under a camera at 5 m"""
    size_spread: Positive = 0.8
    """prior standard deviation of its logarithm"""
    object_spread: Positive = 0.08
    """standard deviation of the logarithm of objects' heights: people differ by 4 to 8 %, boxes by the rest"""
    noise_floor: Positive = 0.001
    """smallest typical error of a box's height that is believed, of the height"""
    noise_lines: Positive = 0.0015
    """error of a box's height whatever its size, of the frame's height"""
    shared_share: Share = 0.3
    """share of a height's error variance that all points of a place have in common"""
    tail: Positive = 4.0
    """degrees of freedom of Student's t for errors of boxes: merged and cut blobs are many"""
    track_misfit: Positive = 3.0
    """mean cost of a track's places (about 2 where they fit) at which the track counts e times less: what
    does not change with the distance at all is no object on the plane"""
    shape_spread: Positive = 0.3
    """standard deviation of the logarithm of width over height about its median: merged and cut boxes, cars
    among people, differ by more and count less"""
    object_tail: Positive = 3.0
    """degrees of freedom of Student's t for objects' heights: children, cycles, cars, false tracks"""
    noise_usual: Positive = 0.02
    """typical relative error of a height, to which the one in pixels is added"""
    bias_lines: Positive = 0.005
    """prior standard deviation of what all boxes are too high or too low by, of the frame's height: detectors and
    annotators leave a margin of one or two of 576 lines at either end"""
    depth: Annotated[float, Field(ge=0)] = 0.07
    """prior mean of how far a box's top is behind its lower edge on the ground, of the object's height: a step is 0.4
    of a walker's height and a shoe 0.15, so that the nearest foot is 0.13 before the hip in the mean, and the head's
    far side 0.05 behind it; boxes that were computed from a line have none ..."""
    depth_spread: Positive = 0.07
    """... and its standard deviation"""
    pace_spread: Positive = 0.3
    """standard deviation of the logarithm of objects' paces about the usual one"""
    pace_median: Positive = 0.26
    """prior median of the usual pace, camera heights per s: 1.3 m/s under a camera at 5 m ..."""
    pace_usual_spread: Positive = 1.0
    """... and the standard deviation of its logarithm"""
    pace_tail: Positive = 3.0
    """degrees of freedom of Student's t for changes of pace: people stop"""
    pace_floor: Positive = 0.06
    """smallest typical change of pace that is believed (standard deviation of the logarithm)"""
    pace_stretch: Positive = 0.75
    """length in the picture of a stretch over which a pace is taken, box heights: over shorter ones the foot's noise
    and the swing of legs make ways seem longer, most so along the view"""
    pace_weight: Annotated[float, Field(gt=0, le=1)] = 0.4
    """how much a stretch counts: changes of pace last for more than one"""
    pace_trend: Share = 0.1
    """standard deviation of what all paces may change by across the frame (their logarithm): people slow down at a
    door or a crossing, whoever they are"""
    pace_turn: Share = 0.1
    """likewise of what all paces may differ by between directions on the ground: who crosses a street or strolls in it
    is slower than who goes along it"""
    height_trend: Share = 0.01
    """likewise of heights: ground that is not quite a plane"""
    model_share: Positive = 0.004
    """standard deviation of what the model leaves out (lens distortion, uneven ground), of the frame's height"""

    @classmethod
    def of_blobs(cls) -> Self:
        """The parameters for the boxes of the motion extractor.

        They are outlines of what differs from the background: gaps of 0.02 of the frame's height are closed, a
        shadow may be left on, and far feet, which are a pixel or two, go unseen. They are of bodies, not computed.
        Where several share a blob (confidence 0.5) a box is as high as motion expects. Heights
        that are 3 % short where people are 45 px high and 1 % long where they are 70 are usual (0038).
        """
        return cls(clear_confidence=0.75, bias_lines=0.012, height_trend=0.04, depth=0.18, depth_spread=0.04)

    @property
    def config_hash(self) -> bytes:
        """SHA-256 of the configuration's canonical form, 32 bytes."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).digest()
