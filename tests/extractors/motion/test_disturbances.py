"""What cameras outdoors see besides objects: rendered, through the whole method. Nothing of it may become a track."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from extractors import scene
from extractors.media import Frame, Image
from extractors.motion import MotionConfig
from tests.extractors.motion.runs import Run, run, scored
from vian.evaluation.scoring import Scores

STREET = scene.street()
SMALL = replace(
    STREET,
    camera=replace(STREET.camera, focal_px=STREET.camera.focal_px * 320 / STREET.width, width=320, height=180),
    seconds=18,
)
"""Two walkers, one who stands, one who comes near, and a lorry."""
CHANGE_S = 8.0
"""When the light changes: two people are in view, one of them standing."""

Change = Callable[[Image], Image]


@cache
def pictures(*, is_empty: bool = False) -> list[Image]:
    return list(scene.render(replace(SMALL, actors=()) if is_empty else SMALL))


def watched(images: Iterator[Image], config: MotionConfig | None = None) -> Run:
    return run((Frame(i, 100_000 * i, image) for i, image in enumerate(images)), config)


def scores_of(found: Run) -> Scores:
    truth = np.array([(b.frame, b.object_id, b.x1, b.y1, b.x2, b.y2) for b in scene.truth(SMALL)], float)
    return scored(truth, found.rows)


def largest_share(found: Run) -> float:
    _, _, x1, y1, x2, y2 = found.rows.T
    return float(((x2 - x1) * (y2 - y1)).max(initial=0) / (SMALL.width * SMALL.height))


def times(image: Image, factor: np.ndarray | float) -> Image:
    return np.asarray(np.clip(np.rint(image * factor), 0, 255), np.uint8)


def cloud(image: Image) -> Image:
    """The shadow of a cloud over half of the picture."""
    x = np.arange(image.shape[1])
    return times(image, (1 - 0.6 / (1 + np.exp((image.shape[1] / 2 - x) / 15)))[None, :, None])


def lamp(image: Image) -> Image:
    """A lamp over a third of the picture."""
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    distance = np.hypot(x - 0.3 * image.shape[1], y - 0.4 * image.shape[0]) / (0.35 * image.shape[1])
    return times(image, (1 + 1.2 * np.exp(-(distance**2) / 2))[:, :, None])


def dusk(image: Image) -> Image:
    return times(image, 0.35)


def shaken(images: list[Image], px: float) -> Iterator[Image]:
    """As from a pole in the wind: to and fro about once a second."""
    random = np.random.default_rng(1)
    for i, image in enumerate(images):
        sway = np.array([np.sin(0.57 * i), 0.5 * np.sin(0.97 * i + 1)]) + random.normal(0, 0.15, 2)
        matrix = np.column_stack([np.eye(2), px * sway]).astype(np.float32)
        moved = cv2.warpAffine(image, matrix, image.shape[1::-1], borderMode=cv2.BORDER_REPLICATE)
        yield np.asarray(moved, np.uint8)


@pytest.mark.parametrize("change", [cloud, lamp, dusk])
def test_a_sudden_change_of_light_becomes_no_object_and_no_swarm(change: Change) -> None:
    def changing(images: list[Image], at_s: float) -> Iterator[Image]:
        for i, image in enumerate(images):
            yield change(image) if i >= 10 * at_s else image

    assert not watched(changing(pictures(is_empty=True)[:60], 3.0)).batches
    found = watched(changing(pictures(), CHANGE_S))
    assert largest_share(found) < 0.2  # the lorry's
    # Five objects; at worst each is another one after the change, and who stood then leaves a hole.
    assert len(found.ends) <= 2 * 5 + 1
    after = found.column("frame") > 10 * (CHANGE_S + 1)
    assert after.any()


@pytest.mark.parametrize("px", [2.0, 5.0])
def test_a_camera_that_shakes_sees_what_one_at_rest_sees(px: float) -> None:
    assert not watched(shaken(pictures(is_empty=True)[:60], px)).batches
    found = scores_of(watched(shaken(pictures(), px)))
    assert found.switches <= 1
    # Boxes are where they would be without the shaking, which is where the truth is.
    assert found.mota > 0.9


def test_without_the_undoing_of_shakes_there_would_be_a_swarm() -> None:
    found = watched(shaken(pictures(is_empty=True)[:60], 5.0), MotionConfig(shake_share_max=0))
    assert len(found.ends) > 5
