"""Who is who: rendered scenes of people whose ways cross, stop and part, and what is said of them."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from extractors.calibration import Camera
from extractors.media import Frame, Image
from extractors.motion import MotionConfig
from extractors.scene import Actor, Scene, render, truth
from tests.extractors.motion.runs import Run, run, scored
from vian.evaluation.scoring import Scores, iou_of

CAMERA = Camera(320.0, 0.2213, 0.0, 4.05, 320, 180)
RED, BLUE, GREEN, DARK, LIGHT = (60, 50, 150), (110, 60, 30), (35, 90, 40), (30, 30, 30), (215, 210, 205)
SAME = 0.2
"""From this intersection over union on a track is where an object is."""

Way = tuple[tuple[float, float, float], ...]
"""time (s), and place on the ground in normalised image coordinates"""
Change = Callable[[Iterable[Image]], Iterator[Image]]


def actor(number: int, way: Way, colour: tuple[int, int, int], kind: str = "person", height_m: float = 1.7) -> Actor:
    pixels = np.array([(x * CAMERA.width, y * CAMERA.height) for _, x, y in way])
    waypoints = tuple(
        (time, float(east), float(north))
        for (time, _, _), (east, north) in zip(way, CAMERA.ground(pixels), strict=True)
    )
    return Actor(number, kind, waypoints, colour, height_m)


def car(number: int, way: Way) -> Actor:
    return actor(number, way, (50, 60, 190), "vehicle", 1.4)


@dataclass(frozen=True, slots=True)
class Seen:
    """What was said of a scene, beside the truth."""

    run: Run
    truth: np.ndarray
    """`frame object x1 y1 x2 y2`, `(n, 6)`"""

    @property
    def scores(self) -> Scores:
        return scored(self.truth, self.run.rows)

    @property
    def objects(self) -> list[list[int]]:
        """Of each track, the objects that it was on, in order, without those that it met for less than a second."""
        return [self._objects_of(end.track_id) for end in self.run.ends]

    @property
    def largest_share(self) -> float:
        _, _, x1, y1, x2, y2 = self.run.rows.T
        return float(((x2 - x1) * (y2 - y1)).max(initial=0) / (CAMERA.width * CAMERA.height))

    def _objects_of(self, track_id: int) -> list[int]:
        found = [self._object_at(row) for row in self.run.rows if row[1] == track_id]
        runs = np.split(np.array(found), np.flatnonzero(np.diff(found)) + 1)
        told = [int(part[0]) for part in runs if part[0] and len(part) >= 10]
        return [one for at, one in enumerate(told) if at == 0 or told[at - 1] != one]

    def _object_at(self, row: np.ndarray) -> int:
        there = self.truth[self.truth[:, 0] == row[0]]
        overlap = iou_of(row[None, 2:6], there[:, 2:6])[0]
        return int(there[overlap.argmax(), 1]) if overlap.max(initial=0) > SAME else 0


def watched(
    *actors: Actor, seconds: int, change: Change | None = None, fps: int = 10, config: MotionConfig | None = None
) -> Seen:
    scene = Scene(CAMERA, actors, fps=fps, seconds=seconds)
    images = render(scene) if change is None else change(render(scene))
    found = run((Frame(i, 1_000_000 * i // fps, image) for i, image in enumerate(images)), config)
    rows = [(box.frame, box.object_id, box.x1, box.y1, box.x2, box.y2) for box in truth(scene)]
    return Seen(found, np.array(rows, float).reshape(-1, 6))


def passers() -> tuple[Actor, ...]:
    """Four who cross one after another, within 14 s, from whom sizes are learnt."""
    return tuple(
        actor(90 + at, ((1 + 2.2 * at, -0.05, y), (7 + 2.2 * at, 1.05, y)), colour)
        for at, (y, colour) in enumerate(((0.5, GREEN), (0.6, DARK), (0.7, RED), (0.8, LIGHT)))
    )


def later(actors: Iterable[Actor], by_s: float) -> tuple[Actor, ...]:
    return tuple(replace(a, waypoints=tuple((t + by_s, e, n) for t, e, n in a.waypoints)) for a in actors)


WALKERS = (
    actor(1, ((1, -0.05, 0.60), (11, 1.05, 0.62)), RED),
    actor(2, ((3, 1.05, 0.80), (12, -0.05, 0.78)), BLUE),
)


@pytest.mark.parametrize("is_learnt", [False, True], ids=["sizes unknown", "sizes learnt"])
def test_two_who_cross_keep_their_identities(is_learnt: bool) -> None:
    pair = (
        actor(1, ((1, -0.05, 0.70), (9, 1.05, 0.72)), RED),
        actor(2, ((1, 1.05, 0.74), (9, -0.05, 0.70)), BLUE),
    )
    seen = watched(*passers(), *later(pair, 15), seconds=25) if is_learnt else watched(*pair, seconds=10)
    assert seen.scores.switches == 0
    assert sorted(seen.objects) == [[1], [2], *([90 + at] for at in range(4 * is_learnt))]


@pytest.mark.parametrize("is_learnt", [False, True], ids=["sizes unknown", "sizes learnt"])
def test_two_who_walk_as_one_and_part_are_two_tracks_after(is_learnt: bool) -> None:
    pair = (
        actor(1, ((1, -0.05, 0.70), (5, 0.50, 0.70), (9, 1.05, 0.55)), RED),
        actor(2, ((1, -0.12, 0.705), (5, 0.43, 0.705), (9, 0.90, 0.95)), BLUE),
    )
    seen = watched(*passers(), *later(pair, 15), seconds=25) if is_learnt else watched(*pair, seconds=10)
    assert sorted(objects[-1] for objects in seen.objects) == [1, 2, *range(90, 90 + 4 * is_learnt)]
    assert seen.scores.mota > 0.9


def test_who_stands_for_a_minute_while_others_pass_is_one_track_and_leaves_no_ghost() -> None:
    seen = watched(
        actor(1, ((1, -0.05, 0.70), (5, 0.5, 0.70), (65, 0.5, 0.70), (69, 1.05, 0.7)), RED),
        actor(2, ((20, -0.05, 0.68), (26, 1.05, 0.68)), BLUE),
        actor(3, ((30, -0.05, 0.78), (36, 1.05, 0.78)), DARK),
        seconds=72,
        fps=5,
    )
    assert sorted(seen.objects) == [[1], [2], [3]]
    assert len(seen.run.ends) == 3
    assert seen.scores.mota > 0.9


def dimmed(factor: float) -> Change:
    """As if somebody switched a light on or off after six seconds."""

    def change(images: Iterable[Image]) -> Iterator[Image]:
        for i, image in enumerate(images):
            yield np.clip(np.rint(image * (factor if i >= 60 else 1)), 0, 255).astype(np.uint8)

    return change


@pytest.mark.parametrize("factor", [0.35, 1.6])
def test_tracks_go_on_when_a_light_is_switched(factor: float) -> None:
    seen = watched(*WALKERS, seconds=13, change=dimmed(factor))
    assert sorted(seen.objects) == [[1], [2]]
    assert len(seen.run.ends) == 2
    assert seen.largest_share < 0.05


def at_night(light: float, deviation: float, blur_px: float = 0.0) -> Change:
    """A share of the light, and noise; blurred it is alike in neighbouring pixels, as after a decoder."""

    def change(images: Iterable[Image]) -> Iterator[Image]:
        random = np.random.default_rng(4)
        for image in images:
            yield np.clip(light * image + noise(random, image.shape, deviation, blur_px), 0, 255).astype(np.uint8)

    return change


def noise(
    random: np.random.Generator, shape: tuple[int, ...], deviation: float, blur_px: float
) -> npt.NDArray[np.float64]:
    drawn: npt.NDArray[np.float64] = random.normal(0, 1, shape)
    if blur_px:
        drawn = np.asarray(cv2.GaussianBlur(drawn, (0, 0), blur_px), np.float64)
    return np.asarray(deviation / drawn.std() * drawn)


NIGHTS = [(0.25, 6.0, 0.0), (1.0, 15.0, 0.0), (0.5, 6.0, 0.8)]


@pytest.mark.parametrize(("light", "deviation", "blur_px"), NIGHTS)
def test_people_in_the_noise_of_the_night_are_followed(light: float, deviation: float, blur_px: float) -> None:
    seen = watched(*WALKERS, seconds=13, change=at_night(light, deviation, blur_px))
    assert sorted(seen.objects) == [[1], [2]]
    assert len(seen.run.ends) == 2
    assert seen.scores.mota > 0.65  # of dark clothes at a quarter of the light a part is lost in the noise


@pytest.mark.parametrize(("light", "deviation", "blur_px"), NIGHTS)
def test_noise_alone_is_nobody(light: float, deviation: float, blur_px: float) -> None:
    assert not watched(seconds=6, change=at_night(light, deviation, blur_px)).run.batches


def test_a_parked_car_that_leaves_is_followed_and_no_track_stays_in_its_place() -> None:
    seen = watched(car(1, ((0, 0.5, 0.6), (6, 0.5, 0.6), (6.5, 0.55, 0.6), (8.5, 1.4, 0.6))), seconds=20)
    assert max(end.x_exit for end in seen.run.ends) > 0.95 * CAMERA.width
    # The hole is taken for something until it is plain that nothing is there, and while the model absorbs it.
    assert sum(end.duration_s for end in seen.run.ends if end.x_exit < 0.9 * CAMERA.width) < 5
    assert seen.run.column("frame").max() < 10 * (6.5 + MotionConfig().absorb_s)


def test_who_comes_to_where_a_car_has_left_is_followed() -> None:
    seen = watched(
        car(1, ((0, 0.5, 0.6), (3, 0.5, 0.6), (3.5, 0.55, 0.6), (5.5, 1.4, 0.6))),
        actor(2, ((6, -0.05, 0.62), (13, 1.05, 0.62)), DARK),
        seconds=14,
    )
    assert [2] in seen.objects
