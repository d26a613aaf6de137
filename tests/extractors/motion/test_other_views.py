"""What becomes of a view that was lost: rendered cameras that are turned or zoomed, and what only comes before them."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from events import SceneChanged, events_of
from extractors import scene
from extractors.calibration import Camera
from extractors.media import Frame, GapReason, Image
from extractors.motion import MotionConfig
from extractors.motion.steadiness import Steadiness
from tests.extractors.motion.runs import Run, run
from tests.extractors.motion.views import view

CAMERA = Camera(320.0, 0.22, 0.0, 4.0, 320, 180)
CHANGE_S, BACK_S, SECONDS = 2.5, 8.5, 14
WALK = scene.Actor(1, "person", ((9.5, -2.0, 10.0), (14.0, 3.0, 10.0)), (60, 50, 150))
"""Somebody who comes when all is over."""
LORRY = scene.Actor(2, "vehicle", ((CHANGE_S, -17.0, 5.5), (BACK_S, 17.0, 5.5)), (150, 120, 90), 5.0)
"""It passes so near that nothing else can be seen for three seconds."""


def watched(*actors: scene.Actor, camera: Camera = CAMERA) -> scene.Scene:
    return scene.Scene(camera, actors, seconds=SECONDS)


@cache
def pictures(camera: Camera = CAMERA) -> list[Image]:
    return list(scene.render(watched(WALK, camera=camera)))


SOON = MotionConfig(view_other_s=3.0)
"""Who takes what rests for another view soon; clips are short."""


def seen(images: Iterator[Image], config: MotionConfig = SOON) -> Run:
    return run((Frame(i, 100_000 * i, image) for i, image in enumerate(images)), config)


def causes(found: Run) -> list[str]:
    events = [event for batch in found.batches for event in events_of(batch)]
    return [event.cause for event in events if isinstance(event, SceneChanged)]


def then(before: list[Image], after: list[Image], at_s: float = CHANGE_S) -> Iterator[Image]:
    cut = round(10 * at_s)
    yield from before[:cut]
    yield from after[cut:]


@pytest.mark.parametrize(
    "camera",
    [replace(CAMERA, focal_px=480.0), replace(CAMERA, pitch_rad=0.5), replace(CAMERA, roll_rad=0.3)],
    ids=["zoomed", "turned down", "rolled"],
)
def test_a_change_that_is_too_large_to_measure_is_a_move_once_the_camera_rests(camera: Camera) -> None:
    found = seen(then(pictures(), pictures(camera)))
    assert causes(found) == ["unknown", "moved"]
    gaps = [gap for step in found.extractions for gap in step.gaps]
    assert [gap.reason for gap in gaps] == [GapReason.CAMERA_MOVED, GapReason.CAMERA_RESTS]
    assert "what is known of its horizon and of metres begins anew" in gaps[-1].detail
    assert min(found.column("frame")) > 90, "who comes then is found, and nobody before"


def test_a_lorry_that_passes_before_the_lens_moves_no_camera() -> None:
    found = seen(scene.render(watched(WALK, LORRY)))
    assert causes(found) in (["unknown"], ["covered"]), "the view was lost"
    assert [gap.reason for step in found.extractions for gap in step.gaps][-1] is GapReason.CAMERA_RESTS


@pytest.mark.parametrize("stands_s, found", [(20, ["unknown"]), (70, ["unknown", "moved", "unknown", "moved"])])
def test_a_lorry_that_stands_before_the_lens_is_waited_for_a_minute(stands_s: int, found: list[str]) -> None:
    street, lorry = view(300), view(1200)
    steadiness = Steadiness(MotionConfig())
    pictures = [street] * 10 + [lorry] * 2 * stands_s + [street] * 160
    looked = [steadiness.look(picture, 0.5) for picture in pictures]
    assert [each.change.cause for each in looked if each.change] == found
    assert looked[-1].is_kept


@pytest.mark.parametrize("stands_s, found", [(10, []), (70, ["moved"])])
def test_a_lorry_that_stands_there_when_it_gets_light_is_waited_for_too(stands_s: int, found: list[str]) -> None:
    street, lorry = view(300), view(1200)
    night = [dark(street, seed) for seed in range(200)]
    steadiness = Steadiness(MotionConfig())
    looked = [steadiness.look(each, 0.5) for each in [street] * 80 + night + [lorry] * 2 * stands_s + [street] * 100]
    causes = [each.change.cause for each in looked if each.change]
    assert [cause for cause in causes if cause == "moved"][:1] == found


def dark(image: Image, seed: int) -> Image:
    noise = np.random.default_rng(seed).normal(0, 2, image.shape)
    return np.asarray(np.clip(0.003 * image + noise, 0, 255), np.uint8)


def out_and_on(before: list[Image], after: list[Image]) -> Iterator[Image]:
    for i, (old, new) in enumerate(zip(before, after, strict=True)):
        yield old if i < 10 * CHANGE_S else dark(old, i) if i < 10 * BACK_S else new


def test_lights_that_go_out_and_on_again_move_no_camera() -> None:
    assert causes(seen(out_and_on(pictures(), pictures()))) == ["covered"]


def test_who_stands_before_the_lens_when_lights_go_on_moves_no_camera() -> None:
    on = round(10 * BACK_S)
    at_first = [*pictures()[:on], *pictures(replace(CAMERA, pitch_rad=0.5))[on : on + 10], *pictures()[on + 10 :]]
    assert causes(seen(out_and_on(pictures(), at_first))) == ["covered"]


def test_a_camera_that_was_turned_in_the_dark_is_found_out_in_the_light() -> None:
    found = seen(out_and_on(pictures(), pictures(replace(CAMERA, pitch_rad=0.5))))
    assert causes(found) == ["covered", "moved"]
    (_, _, moved) = [gap for step in found.extractions for gap in step.gaps]
    assert "than before it was dark" in moved.detail


def infrared(image: Image) -> Image:
    """Leaves are bright and the sky is dark."""
    return np.asarray(np.repeat(255 - cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)[:, :, None], 3, axis=2), np.uint8)


def cut_short(image: Image) -> Image:
    return np.asarray(cv2.rectangle(image.copy(), (0, 0), (100, 240), (40, 40, 40), -1), np.uint8)


@pytest.mark.parametrize("change", [infrared, cut_short])
def test_a_view_that_comes_back_in_another_light_or_with_a_van_before_it_is_the_same(
    change: Callable[[Image], Image],
) -> None:
    def now(at: int) -> Image:
        image = view(300 if not 20 <= at < 60 else 300 + 9 * at, seed=at)
        return image if at < 60 else change(image)

    assert causes(seen(now(at) for at in range(120))) == ["unknown"]


ZOOMED = replace(CAMERA, focal_px=480.0)


def test_a_view_that_is_lost_at_the_end_is_another_for_whoever_comes_next() -> None:
    found = seen(then(pictures()[:60], pictures(ZOOMED)[:60]))
    assert causes(found) == ["unknown", "moved"]
    assert (
        "end while the camera shows another view" in [gap for step in found.extractions for gap in step.gaps][-1].detail
    )


@pytest.mark.parametrize("last", [pictures, lambda: [dark(image, 1) for image in pictures()]], ids=["back", "dark"])
def test_one_that_is_back_at_the_end_is_not_and_in_the_dark_nothing_is_known(last: Callable[[], list[Image]]) -> None:
    lost = [*pictures()[:25], *pictures(ZOOMED)[25:45]]
    assert causes(seen(iter([*lost, *last()[45:55]]))) == ["unknown"]


def test_a_view_that_is_lost_when_pictures_come_in_another_size_is_another() -> None:
    smaller = [np.asarray(cv2.resize(image, (256, 144)), np.uint8) for image in pictures(ZOOMED)[60:120]]
    assert causes(seen(iter([*then(pictures()[:60], pictures(ZOOMED)[:60]), *smaller]))) == ["unknown", "moved"]
