"""Horizon: the vanishing line of the ground, from the tracks of whatever moves on it."""

from extractors.horizon.camera import FrameSize, Line
from extractors.horizon.config import NAME, VERSION, HorizonConfig
from extractors.horizon.fit import Fit
from extractors.horizon.fold import OTHER_VIEWS, Estimate, Horizon, estimated
from extractors.horizon.points import TrackPoints

__all__ = [
    "NAME",
    "OTHER_VIEWS",
    "VERSION",
    "Estimate",
    "Fit",
    "FrameSize",
    "Horizon",
    "HorizonConfig",
    "Line",
    "TrackPoints",
    "estimated",
]
