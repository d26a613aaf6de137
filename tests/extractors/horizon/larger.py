"""Many scenes of known horizon: `python -m tests.extractors.horizon.larger [FIRST_SEED]`.

The published tracks under VIAN_DATA take their turn where they are there. A first seed that was never used gives
scenes that nobody has seen.

Prints the distribution of errors (largest vertical distance within the frame over its height), the area under
its curve to 0.25, and how many intervals of the height in the frame's middle, of tilt, roll and focal length hold the
truth.
"""

import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from extractors.horizon import Estimate, HorizonConfig, Line, estimated
from tests.extractors.horizon.scenes import Camera, Scene, published_walks, random_camera, random_walks, scene

SCENES = 90
TRACKS_MIN, POINTS_MIN = 12, 250


@dataclass(frozen=True, slots=True)
class Score:
    error: float
    """image heights; infinite where there is no estimate"""
    is_covered: bool | None
    view_covered: tuple[bool, ...] = ()
    """tilt, roll and focal length"""


def error_of(line: Line, camera: Camera) -> float:
    ends = (0.0, float(camera.size.width))
    return max(abs(line.y(x) - camera.horizon.y(x)) for x in ends) / camera.size.height


def score(found: Estimate | None, camera: Camera) -> Score:
    if found is None:
        return Score(np.inf, None)
    middle = camera.size.width / 2
    off = abs(found.fit.line.y(middle) - camera.horizon.y(middle))
    view_off = np.abs(found.fit.camera[:3] - [camera.tilt, camera.roll, np.log(camera.focal)])
    view_covered = view_off < 1.96 * np.sqrt(np.diag(found.fit.covariance)[:3])
    return Score(
        error_of(found.fit.line, camera),
        bool(off < 1.96 * found.fit.deviation_at(middle)),
        tuple(map(bool, view_covered)),
    )


def scenes(count: int, data: Path | None, *, first_seed: int = 1000) -> Iterator[Scene]:
    """Scenes of random walks, and of the published tracks in turn where they are there."""
    for number in range(count):
        random = np.random.default_rng(first_seed + number)
        made = _scene(number % 3 if data else 0, data, random)
        while len(np.unique(made.points.track_id)) < TRACKS_MIN or len(made.points) < POINTS_MIN:
            made = _scene(number % 3 if data else 0, data, random)
        yield made


def _scene(kind: int, data: Path | None, random: np.random.Generator) -> Scene:
    if data is None or kind == 0:
        walks = random_walks(random)
    elif kind == 1:
        walks = published_walks(data / "tracking/eth_seq_eth/obsmat.txt", random, annotated_fps=15)
    else:
        walks = published_walks(data / "tracking/ucy_zara01/obsmat.txt", random, annotated_fps=25)
    return scene(walks, random_camera(random), random, false_tracks=int(random.integers(0, 4)))


def summary(scores: list[Score]) -> str:
    errors = np.array([each.error for each in scores])
    covered = [each.is_covered for each in scores if each.is_covered is not None]
    tilt, roll, focal = np.mean([each.view_covered for each in scores if each.view_covered], axis=0)
    return (
        f"{len(scores)} scenes, {np.isinf(errors).sum()} without estimate: median {np.median(errors):.4f}, "
        f"90 % below {np.quantile(errors, 0.9, method='higher'):.3f}, "
        f"AUC {np.mean(1 - np.minimum(errors, 0.25) / 0.25):.3f}, coverage {np.mean(covered):.2f}, "
        f"of tilt {tilt:.2f}, roll {roll:.2f}, focal length {focal:.2f}"
    )


if __name__ == "__main__":
    folder, first_seed = os.environ.get("VIAN_DATA"), int(sys.argv[1]) if len(sys.argv) > 1 else 1000
    found = [
        score(estimated(each.points, each.camera.size, HorizonConfig()), each.camera)
        for each in scenes(SCENES, Path(folder) if folder else None, first_seed=first_seed)
    ]
    sys.stdout.write(summary(found) + "\n")
