"""Scenes that never were: pictures, videos and exact truth of what moves over a ground, rendered from a seed."""

from extractors.scene.places import CROSSING_LINE, LOITER_ZONE, RUN_MPS, SQUARE_CAMERA, square, street
from extractors.scene.rendering import PICTURES, render, write
from extractors.scene.world import Actor, Scene, TruthBox, truth

__all__ = [
    "CROSSING_LINE",
    "LOITER_ZONE",
    "PICTURES",
    "RUN_MPS",
    "SQUARE_CAMERA",
    "Actor",
    "Scene",
    "TruthBox",
    "render",
    "square",
    "street",
    "truth",
    "write",
]
