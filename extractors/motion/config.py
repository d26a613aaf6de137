"""Every parameter of the motion extractor, with its unit and its reason.

Lengths are shares of the picture's height or of an object's own size, durations are seconds, so one
configuration serves other resolutions and frame rates. The defaults come from reasoning and from
several clips of different kinds (docs/decisions/0007-motion-and-tracking.md), not from one data set.
"""

import hashlib
import json
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

NAME = "motion"
"""name of this extractor in the log"""
VERSION = "3"
"""version of its method; a change that says other things for the same frames raises it"""

Share = Annotated[float, Field(ge=0, le=1)]
Positive = Annotated[float, Field(gt=0)]


class MotionConfig(BaseModel):
    """How motion is found and followed."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    detector: str = "motion"
    """what finds objects: `motion`, or the SHA-256 of a model file"""
    classes: tuple[int, ...] | None = None
    """numbers of the model's classes that are followed; all where null"""

    analysis_lines: Annotated[int, Field(ge=60)] = 360
    """pictures whose shorter side is longer are first shrunk to this, px: a person who is a twelfth of the picture
    high keeps 30 lines, and time goes with the pixels"""

    memory_s: Positive = 40.0
    """time constant of the background model, s"""
    absorb_s: Positive = 10.0
    """time after which what nobody follows and what stands still is background, s"""
    variance_threshold: Positive = 25.0
    """squared distance to the background, in variances, from which a pixel is foreground"""
    noise_levels_max: Positive = 3.5
    """noise from which pictures are smoothed, standard deviation in grey levels: a camera in daylight has 1 to 3"""
    noise_side_max: Annotated[int, Field(ge=1)] = 5
    """... by medians over squares of at most this side, px of the analysed picture: legs of people are as thin"""
    is_shadow_removed: bool = True
    """whether darker pixels of unchanged colour count as background"""
    tone_max: Annotated[float, Field(ge=0, le=255)] = 40.0
    """strongest change of the picture's tones that is undone (exposure, white balance), grey levels"""
    light_share_max: Share = 0.6
    """share of the picture in the foreground from which it is a change of light, not objects"""
    light_check_share: Share = 0.15
    """share from which it is looked at whether the foreground shows the same edges as the background, so that only the
    light changed there: one lorry covers as much"""
    light_settle_s: Positive = 0.5
    """duration of such a change after which the background is learnt anew, s"""

    close_share: Share = 0.02
    """height of the gaps that are closed within an object, of the picture's height; width is half of it"""
    area_share_min: Share = 0.0005
    """smallest object, of the picture's area"""

    position_noise: Positive = 0.06
    """standard deviation of a measured position, of the object's size (root of its box's area)"""
    size_noise: Positive = 0.12
    """standard deviation of a measured width or height, of the object's size"""
    acceleration: Positive = 0.5
    """standard deviation of the acceleration, object sizes per s² and root of Hz"""
    size_drift: Positive = 0.5
    """standard deviation of the change of width and height after one second, of the object's size"""
    gate: Positive = 16.0
    """largest squared Mahalanobis distance between a track and a detection it may take (chi-square, 2
    degrees of freedom: 16 is 99.97 %)"""

    score_sure: Share = 0.6
    """score from which a detection is sure"""
    score_new: Share = 0.7
    """score from which a detection may begin a track"""
    score_min: Share = 0.1
    """score from which a detection may go on with one"""
    overlap_min: Share = 0.2
    """least intersection over union of a track's expected box and a sure detection, where it may take it"""
    overlap_doubtful_min: Share = 0.4
    """the same for a doubtful detection"""
    overlap_double: Share = 0.6
    """from this intersection over union with a tracked box on, a detection is the same object, found twice"""
    appearance_cost: Annotated[float, Field(ge=0)] = 1.0
    """cost of looking altogether different, in units of no overlap at all"""

    unlike_max: Share = 0.3
    """a track that was lost takes a detection within its reach only if their looks differ less ..."""
    reach_size: Positive = 1.0
    """... within so many object sizes, for what a missing picture or a sudden turn makes ..."""
    reach_speed: Positive = 1.5
    """... and so many more a second: a walker does about one and a half"""
    looks_rate: Share = 0.05
    """least share of a new view in how a track looks: light changes on the way"""

    size_samples_min: Annotated[int, Field(ge=8)] = 16
    """clear views of confirmed tracks from which the size of objects is learnt ..."""
    size_tracks_min: Annotated[int, Field(ge=2)] = 4
    """... from so many tracks at least ..."""
    size_samples_max: Annotated[int, Field(ge=8)] = 2000
    """... and at most: older views give way"""
    size_step: Positive = 0.25
    """a track gives another view after a way of this share of its height"""
    size_spread_max: Positive = 0.2
    """largest relative deviation of heights within one kind: more means several kinds"""
    size_share_min: Share = 0.7
    """share of views that must belong to the kind"""
    size_deviation_max: Positive = 0.25
    """largest relative deviation of an expected height that is used"""
    aspect_max: Positive = 0.8
    """objects wider than this share of their height are not upright, and are not split by size"""

    confirm_s: Positive = 0.4
    """a track is confirmed when seen for this long ..., s"""
    confirm_hits: Annotated[int, Field(ge=2)] = 3
    """... in this many frames at least ..."""
    confirm_path: Annotated[float, Field(ge=0)] = 0.4
    """... and moved so far from its beginning, in object sizes: leaves, noise and ghosts do not"""
    sway_share: Share = 0.015
    """how far leaves in the wind and the like go to and fro, of the picture's height ..."""
    sway_max: Share = 0.6
    """... a track is not confirmed while more than this share of what was seen of it may be the background from so
    near"""
    forget_s: Positive = 0.25
    """a tentative track not seen for longer is dropped, s"""
    lost_s: Positive = 2.0
    """a confirmed track not seen for longer ends, s"""
    lag_s: Positive = 0.8
    """points are emitted this much later, in order of time, so that the first points of a confirmed
    track and short misses within a track are included, s"""

    stand_radius: Positive = 0.3
    """a confirmed track stands while it stays within this distance of one place, object sizes ..."""
    stand_after_s: Positive = 1.5
    """... for longer than this; the background under it is kept from then on, s"""
    stand_max_s: Positive = 300.0
    """after standing so long an object becomes background and its track ends, s"""

    activity_gap_s: Positive = 1.0
    """quiet spans up to this length do not end an activity interval, s"""
    batch_s: Positive = 1.0
    """media time of one batch of events, s"""

    shake_share_max: Share = 0.04
    """largest shift of the picture that is undone as a shake, of its width; 0: none is"""
    view_lost_share: Share = 0.7
    """the camera is taken to look elsewhere when more than this share of the blocks of the picture that have
    edges show others: a crowd or a lorry covers less"""
    view_lost_s: Positive = 1.5
    """... for so long without a break: longer than a shake or a flash, shorter than what people wait for, s"""
    view_rest_s: Positive = 3.0
    """a camera that was moved rests when its picture stays for so long, s; after a rest that did not last, twice
    as long"""

    view_other_s: Positive = 60.0
    """... if it shows another view than the one that was lost, for which the reason is not known, only after so long: a
    lorry at a red light or a bus at its stop before the lens is gone by then, and a move ends metres for good, s"""

    @property
    def config_hash(self) -> bytes:
        """SHA-256 of the configuration's canonical form, 32 bytes."""
        canonical = json.dumps(self.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
        return hashlib.sha256(canonical.encode()).digest()
