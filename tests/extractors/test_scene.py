import hashlib
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from shapely import LineString, Point, Polygon

from extractors import scene
from extractors.media import Frame
from extractors.video import frames


def feet(object_id: int) -> list[tuple[int, float, float]]:
    street = scene.street()
    boxes = [box for box in scene.truth(street) if box.object_id == object_id and box.is_whole]
    return [(b.frame, (b.x1 + b.x2) / 2 / street.width, b.y2 / street.height) for b in boxes]


def test_the_same_seed_gives_the_same_pictures_and_another_gives_others() -> None:
    first, again, other = (list(islice(scene.render(scene.street(seed)), 40)) for seed in (1, 1, 2))
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert not np.array_equal(first[0], other[0])


def test_truth_is_where_the_picture_changes() -> None:
    street = scene.street()
    pictures = list(islice(scene.render(street), 131))
    empty = np.median(pictures[:15], axis=0)
    box = next(b for b in scene.truth(street) if b.frame == 130 and b.object_id == 2)
    near = np.s_[round(box.y1) - 8 : round(box.y2) + 8, round(box.x1) - 8 : round(box.x2) + 8]
    # Noise of 3 levels, twice: a pixel that differs by 25 is no noise.
    ys, xs = np.nonzero(np.abs(pictures[130] - empty).max(axis=2)[near] > 25)
    found = (xs.min(), ys.min(), xs.max() + 1, ys.max() + 1)
    wanted = (8, 8, 8 + box.x2 - box.x1, 8 + box.y2 - box.y1)
    np.testing.assert_allclose(found, wanted, atol=1.6)  # pixels that an edge covers by less than half


def test_one_loiters_in_the_zone_and_one_crosses_the_line() -> None:
    zone = Polygon(scene.LOITER_ZONE)
    inside = [frame for frame, x, y in feet(2) if zone.contains(Point(x, y))]
    assert (inside[-1] - inside[0]) / scene.street().fps > 12
    way = LineString([(x, y) for _, x, y in feet(3)])
    assert way.crosses(LineString(scene.CROSSING_LINE))


def test_the_file_holds_the_scene_and_is_the_same_each_time(tmp_path: Path) -> None:
    street = replace(scene.street(), seconds=4)
    hashes = []
    for name in ("a.mp4", "b.mp4"):
        scene.write(street, tmp_path / name)
        hashes.append(hashlib.sha256((tmp_path / name).read_bytes()).hexdigest())
    assert hashes[0] == hashes[1]
    found = [item for item in frames(tmp_path / "a.mp4") if isinstance(item, Frame)]
    assert len(found) == street.frames
    drawn = list(scene.render(street))
    # Coding at 4 Mbit/s smooths the noise of 3 levels away and blurs edges a little.
    assert np.abs(found[35].image.astype(int) - drawn[35]).mean() < 4


def test_feet_and_head_are_where_the_camera_projects_them() -> None:
    square = scene.square(people=4, runners=0)
    (foot, head), boxes = np.array([[0, 0, 0], [0, 0, 1]]), [box for box in scene.truth(square) if box.is_whole]
    heights = {actor.object_id: actor.height_m for actor in square.actors}
    for box in boxes[::20]:
        at = np.array([box.east_m, box.north_m, 0.0])
        body = square.camera.project(np.stack([at + foot, at + heights[box.object_id] * head]))
        reach = 0.25 * heights[box.object_id] * square.camera.focal_px / np.hypot(box.north_m, square.camera.height_m)
        # Feet and head reach up to a quarter of a body height to each side of the line between them.
        assert box.x1 < body[:, 0].min() < body[:, 0].max() < box.x2
        assert box.y1 < body[1, 1] < box.y1 + reach
        assert box.y2 - reach < body[0, 1] < box.y2


def test_runners_come_when_walkers_have_come() -> None:
    square = scene.square(people=5, runners=2)
    speeds = []
    for actor in square.actors:
        (began, *start), (ended, *end) = actor.waypoints
        speeds.append(np.hypot(*np.subtract(end, start)) / (ended - began))
    assert (np.array(speeds) > 3).tolist() == [False] * 5 + [True] * 2
    assert speeds[-1] == pytest.approx(scene.RUN_MPS)


def test_blur_and_noise_are_as_asked_for() -> None:
    clear, noisy, blurred = (
        next(scene.render(scene.square(people=1, runners=0, noise_levels=noise, blur_px=blur))).astype(float)
        for noise, blur in ((0, 0), (9, 0), (0, 3))
    )
    assert (noisy - clear).std() == pytest.approx(9, rel=0.02)
    assert np.abs(np.diff(blurred, axis=0)).mean() < 0.5 * np.abs(np.diff(clear, axis=0)).mean()
