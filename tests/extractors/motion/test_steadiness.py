"""A camera that rests, shakes, turns, drives or is covered, over a picture of known texture."""

from collections.abc import Callable, Iterable
from datetime import UTC, datetime

import cv2
import numpy as np
import pytest

from events import ActivityInterval, SceneChanged, TrackEnded, TrackPoint, events_of
from extractors.media import Frame, Gap, GapReason, Image
from extractors.motion import MotionConfig, extract
from extractors.motion.steadiness import Change, Steadiness
from tests.extractors.motion.views import HEIGHT, WIDTH, view

FPS = 10
START = datetime(2026, 1, 1, tzinfo=UTC)


def changes(
    pictures: Iterable[Image], config: MotionConfig | None = None
) -> tuple[list[tuple[float, Change]], list[float]]:
    """When the view was lost and how, and when the camera rested again, s."""
    steadiness = Steadiness(config or MotionConfig())
    lost, rested = [], []
    for at, image in enumerate(pictures):
        seen = steadiness.look(image, 1 / FPS if at else 0.0)
        if seen.change is not None:
            lost.append((at / FPS, seen.change))
        if seen.has_rested:
            rested.append(at / FPS)
    return lost, rested


def test_a_camera_that_rests_keeps_its_view() -> None:
    assert changes(view(300, seed=at) for at in range(60)) == ([], [])


def test_shaking_in_the_wind_is_no_other_view() -> None:
    sway = [(3 * np.sin(2.1 * at), 2 * np.cos(3.3 * at)) for at in range(60)]
    assert changes(view(300 + dx, HEIGHT + dy, seed=at) for at, (dx, dy) in enumerate(sway)) == ([], [])


def test_the_dark_and_the_light_are_no_other_view() -> None:
    def lit(at: int) -> Image:
        factor = 1.0 if at < 20 else 0.35 if at < 40 else 1.2
        return np.asarray(np.clip(view(300, seed=at).astype(np.float32) * factor, 0, 255), np.uint8)

    assert changes(lit(at) for at in range(60)) == ([], [])


def test_a_crowd_is_no_other_view() -> None:
    def crowded(at: int) -> Image:
        image = view(300, seed=at)
        for i in range(14):
            left = (37 * i + (6 + i % 5) * at) % (WIDTH + 40) - 40
            cv2.rectangle(image, (left, 70 + 9 * i % 90), (left + 24, 150 + 9 * i % 90), (30 + 15 * i, 60, 90), -1)
        return image

    assert changes(crowded(at) for at in range(60)) == ([], [])


def test_a_camera_that_is_turned_is_found_with_its_shift_and_rests() -> None:
    ((lost_s, change),), (rested_s,) = changes(view(300 if at < 30 else 340, seed=at) for at in range(100))
    assert 3 < lost_s < 6, "a few seconds"
    assert change.cause == "moved"
    assert change.shift_xy is not None
    # Half a pixel of the compared picture, which is half as wide.
    assert change.shift_xy == pytest.approx((-40, 0), abs=1.0)
    assert change.share > 0.7
    assert lost_s + 2.8 < rested_s < lost_s + 4


@pytest.mark.parametrize("speed", [10.0, 40.0, 200.0])
def test_a_camera_that_goes_on_moving_does_not_rest(speed: float) -> None:
    lost, rested = changes(view(100 + speed * at / FPS, seed=at) for at in range(60))
    assert len(lost) == 1
    assert lost[0][0] < 5
    assert not rested


def test_a_covered_camera_is_found() -> None:
    covered = np.full((HEIGHT, WIDTH, 3), 20, np.uint8)
    ((_, change),), _ = changes(view(300, seed=at) if at < 30 else covered for at in range(60))
    assert change.cause == "covered"


def faint(image: Image, contrast: float, light: float = 1.0) -> Image:
    """The picture in mist, or with the lights low."""
    seen = light * (120 + contrast * (image.astype(np.float32) - 120))
    grain = np.random.default_rng(int(image[0, 0, 0])).normal(0, 2, image.shape)
    return np.asarray(np.clip(seen + grain, 0, 255), np.uint8)


@pytest.mark.parametrize("contrast, light", [(0.35, 1.0), (0.25, 1.0), (0.15, 1.0), (0.6, 0.4)])
def test_a_camera_that_is_turned_to_a_view_of_less_contrast_is_found_out(contrast: float, light: float) -> None:
    def turned(at: int) -> Image:
        return view(300, seed=at) if at < 30 else faint(view(1200, 300, seed=at, noise=0), contrast, light)

    lost, (rested_s, *_) = changes((turned(at) for at in range(120)), MotionConfig(view_other_s=5))
    assert [change.cause for _, change in lost][-1] == "moved"
    assert lost[-1][0] <= rested_s + 0.5


@pytest.mark.parametrize("contrast", [0.25, 0.12])
def test_mist_before_the_lens_is_no_other_view(contrast: float) -> None:
    def misty(at: int) -> Image:
        hidden = view(900 + 8 * at, seed=at)
        kept = faint(view(300, seed=at, noise=0), contrast)
        return view(300, seed=at) if at < 30 else hidden if at < 55 else kept

    lost, _ = changes(misty(at) for at in range(150))
    assert [change.cause for _, change in lost] == ["unknown"]


def test_lamps_in_the_dark_are_no_other_view() -> None:
    def night(at: int) -> Image:
        image = faint(view(300, seed=at, noise=0), 0.0, 0.1)
        for x, y in ((40, 40), (150, 50), (270, 45), (60, 150), (200, 160), (280, 170)):
            cv2.circle(image, (x, y), 6, (180, 220, 230), -1)
        return image

    lost, _ = changes(view(300, seed=at) if at < 30 or at >= 150 else night(at) for at in range(200))
    assert [change.cause for _, change in lost] == ["covered", "unknown"], "the lights go on at last"


def test_a_picture_without_edges_says_nothing() -> None:
    grey = np.full((HEIGHT, WIDTH, 3), 90, np.uint8)
    assert changes(grey if at < 30 else view(300, seed=at) for at in range(60)) == ([], [])


def frames(see: Callable[[int], Image], count: int) -> Iterable[Frame]:
    for at in range(count):
        yield Frame(at, round(1e6 * at / FPS), see(at))


def test_a_camera_that_drives_says_so_and_finds_nobody() -> None:
    steps = list(extract(frames(lambda at: view(100 + 6.0 * at, seed=at), 120), MotionConfig(), start_time=START))
    batches = [batch for step in steps for batch in step.batches]
    (changed,) = [event for batch in batches if batch.type is SceneChanged for event in events_of(batch)]
    assert isinstance(changed, SceneChanged)
    assert not [batch for batch in batches if batch.type in (TrackPoint, TrackEnded, ActivityInterval)]
    assert [gap.reason for step in steps for gap in step.gaps] == [GapReason.CAMERA_MOVED]
    assert steps[-1].frames == 120


def test_after_the_camera_was_turned_objects_are_found_again() -> None:
    def see(at: int) -> Image:
        image = view(300 if at < 50 else 420, seed=at)
        if at > 120:
            left = 4 * (at - 120)
            image[100:180, left : left + 36] = (230, 240, 250)
        return image

    steps = list(extract(frames(see, 180), MotionConfig(), start_time=START))
    gaps: list[Gap] = [gap for step in steps for gap in step.gaps]
    assert [gap.reason for gap in gaps] == [GapReason.CAMERA_MOVED, GapReason.CAMERA_RESTS]
    points = [
        event
        for step in steps
        for batch in step.batches
        if batch.type is TrackPoint
        for event in events_of(batch)
        if isinstance(event, TrackPoint)
    ]
    assert points
    assert min(point.frame for point in points) > 120
