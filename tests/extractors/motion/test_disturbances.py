"""What cameras outdoors see besides objects: rendered, through the whole method."""

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
    # Shakes that are not undone pass for noise, and would be smoothed.
    config = MotionConfig(shake_share_max=0, noise_levels_max=255)
    found = watched(shaken(pictures(is_empty=True)[:60], 5.0), config)
    assert len(found.ends) > 5


def leaves(images: list[Image]) -> Iterator[Image]:
    """A tree in the wind at the right."""
    random = np.random.default_rng(2)
    height, width = images[0].shape[:2]
    middles = random.uniform((0.6 * width, 0.05 * height), (0.95 * width, 0.45 * height), (60, 2))
    phases, paces = random.uniform(0, 2 * np.pi, 60), random.uniform(0.7, 1.6, 60)
    colours = random.integers(20, 120, (60, 3)).tolist()
    for i, image in enumerate(images):
        sway = 3 * (0.6 + 0.4 * np.sin(0.15 * i)) * np.sin(0.2 * np.pi * paces * i + phases)
        picture = image.copy()
        for (x, y), by, colour in zip(middles, sway, colours, strict=True):
            cv2.circle(picture, (round(x + by), round(y + 0.4 * by)), 4, colour, -1, cv2.LINE_AA)
        yield picture


def rain(images: list[Image]) -> Iterator[Image]:
    random = np.random.default_rng(3)
    for image in images:
        picture = image.copy()
        for x, y, length in random.uniform((0, -20, 6), (image.shape[1], image.shape[0], 20), (60, 3)):
            end = (round(x + 0.15 * length), round(y + length))
            cv2.line(picture, (round(x), round(y)), end, (205, 205, 210), 1, cv2.LINE_AA)
        yield np.asarray(cv2.addWeighted(picture, 0.7, image, 0.3, 0), np.uint8)


def night(images: list[Image]) -> Iterator[Image]:
    """A quarter of the light, and as much noise as a small sensor makes of it."""
    random = np.random.default_rng(4)
    for image in images:
        yield np.asarray(np.clip(0.25 * image + random.normal(0, 10, image.shape), 0, 255), np.uint8)


def test_leaves_in_the_wind_are_no_swarm() -> None:
    found = watched(leaves(pictures(is_empty=True)[:100]))
    without = watched(leaves(pictures(is_empty=True)[:100]), MotionConfig(sway_max=1))
    assert len(without.rows) > 100
    assert len(found.rows) < 0.1 * len(without.rows)


def test_the_noise_of_the_night_is_nothing() -> None:
    assert not watched(night(pictures(is_empty=True)[:60])).batches


def test_people_are_seen_through_rain() -> None:
    found = scores_of(watched(rain(pictures())))
    assert found.switches <= 1
    assert found.mota > 0.75


def test_what_stood_for_so_long_that_it_became_background_leaves_no_ghost_behind() -> None:
    lorry = next(actor for actor in SMALL.actors if actor.kind == "vehicle")
    (_, east, north), (_, to_east, to_north) = lorry.waypoints
    middle = (east + to_east) / 2, (north + to_north) / 2
    way = ((1.0, east, north), (3.0, *middle), (13.0, *middle), (15.0, to_east, to_north))
    parking = replace(SMALL, actors=(replace(lorry, waypoints=way),), seconds=22)
    found = watched(scene.render(parking), MotionConfig(stand_max_s=4, absorb_s=3, memory_s=12))
    frame = found.column("frame")
    assert np.isin([25, 135], frame).all()  # it was seen to come and to leave,
    assert not (frame == 125).any()  # was background before,
    assert not (frame > 170).any()  # and nothing is left of it


@pytest.mark.parametrize("size", [(1, 1), (1, 90), (90, 1), (5000, 2), (4000, 8)])
def test_pictures_of_a_line_or_two_are_looked_at_without_an_error(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    pictures = [rng.integers(0, 255, (size[1], size[0], 3), np.uint8) for _ in range(8)]
    assert run(Frame(i, 100_000 * i, image) for i, image in enumerate(pictures)).extractions[-1].frames == 8
