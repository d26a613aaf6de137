"""The scenes that the demo, the tests and the benchmarks share."""

import numpy as np

from extractors.calibration import Camera
from extractors.scene.solids import Floats, person, placed
from extractors.scene.world import Actor, Scene, box_of, is_in_view

STREET_CAMERA = Camera(640.0, 0.2213, 0.0, 4.05, 640, 360)
"""53° of view, 13° down: the horizon lies a tenth of the picture's height below its upper edge."""
LOITER_ZONE = ((0.16, 0.62), (0.44, 0.62), (0.44, 0.86), (0.16, 0.86))
"""Corners of the zone in which one person loiters, normalised image coordinates."""
CROSSING_LINE = ((0.50, 0.72), (0.90, 0.72))
"""The line that one person crosses upwards, normalised image coordinates."""

SQUARE_CAMERA = Camera(620.0, 0.42, 0.07, 5.0, 640, 360)
"""55° of view, 24° down, rolled by 4°: the horizon lies above the picture."""
RUN_MPS = 3.6
"""Speed of those who run over the square, m/s: 13 km/h."""
_WALK_MPS, _WALK_SPREAD = 1.3, 0.15
_CLOTHES = ((60, 50, 150), (110, 60, 30), (35, 90, 40), (30, 30, 30), (215, 210, 205), (45, 130, 200), (150, 190, 235))
"""Colours (blue, green, red) that differ from the ground."""
_FAR_HEIGHTS = 7.0
"""Nobody is farther away than so many camera heights: there they would be a few pixels."""


def street(seed: int = 1) -> Scene:
    """Two walkers, a loiterer, a line crosser, two vehicles."""
    ways = (
        (1, "person", ((2.0, -0.05, 0.56), (16.0, 1.05, 0.52)), (60, 50, 150)),
        (2, "person", ((3.0, -0.05, 0.80), (7.0, 0.30, 0.76), (21.0, 0.30, 0.76), (26.0, -0.06, 0.82)), (110, 60, 30)),
        (3, "person", ((8.0, 0.78, 1.25), (16.0, 0.66, 0.62), (24.0, 1.06, 0.58)), (35, 90, 40)),
        (4, "vehicle", ((2.5, 1.35, 0.98), (6.5, -0.35, 0.98)), (170, 170, 175)),
        (5, "vehicle", ((24.0, 1.35, 0.98), (28.5, -0.35, 0.98)), (50, 60, 190)),
        (6, "person", ((17.0, 1.05, 0.44), (29.0, 0.35, 0.44)), (30, 30, 30)),
    )
    actors = (
        Actor(number, kind, _on_ground(STREET_CAMERA, way), colour, 1.0 if kind == "vehicle" else 1.70)
        for number, kind, way, colour in ways
    )
    return Scene(STREET_CAMERA, tuple(actors), seed=seed)


def square(
    camera: Camera = SQUARE_CAMERA,
    *,
    people: int = 16,
    runners: int = 2,
    apart_s: float = 3.0,
    seed: int = 1,
    noise_levels: float = 3.0,
    blur_px: float = 0.0,
) -> Scene:
    """People who cross what the camera sees of a square, each in a direction of their own; the last ones run.

    Args:
        camera: The camera.
        people: How many walk.
        runners: How many run when those have gone.
        apart_s: Time from one who comes to the next, s.
        seed: Of everything that is drawn.
        noise_levels: Standard deviation of the camera's noise, grey levels.
        blur_px: Standard deviation of the lens's blur, px.
    """
    random = np.random.default_rng(seed)
    actors = list[Actor]()
    for number in range(people + runners):
        is_running = number >= people
        speed = RUN_MPS if is_running else _WALK_MPS * float(np.exp(random.normal(0, _WALK_SPREAD)))
        way = _crossing(camera, random)
        began = 1.0 + apart_s * number
        times = began + np.array([0.0, float(np.hypot(*(way[1] - way[0]))) / speed])
        waypoints = tuple(
            (float(time), float(east), float(north)) for time, (east, north) in zip(times, way, strict=True)
        )
        colour = _CLOTHES[random.integers(len(_CLOTHES))]
        height = float(np.clip(random.normal(1.70, 0.09), 1.5, 1.95))
        actors.append(Actor(number + 1, "person", waypoints, colour, height))
    seconds = int(np.ceil(max(actor.waypoints[-1][0] for actor in actors))) + 1
    return Scene(camera, tuple(actors), seconds=seconds, seed=seed, noise_levels=noise_levels, blur_px=blur_px)


def _on_ground(camera: Camera, way: tuple[tuple[float, float, float], ...]) -> tuple[tuple[float, float, float], ...]:
    """Waypoints given by time and normalised image coordinates, on the ground."""
    pixels = np.array([(x * camera.width, y * camera.height) for _, x, y in way])
    return tuple(
        (time, float(east), float(north))
        for (time, _, _), (east, north) in zip(way, camera.ground(pixels), strict=True)
    )


def _crossing(camera: Camera, random: np.random.Generator) -> Floats:
    """From where to where somebody goes, m, `(2, 2)`: straight over a point in view, and out of it on both sides."""
    floor = _floor(camera)
    over = floor[random.integers(len(floor))]
    heading = random.uniform(0, 2 * np.pi)
    along = np.array([np.cos(heading), np.sin(heading)])
    steps = np.arange(0.0, 60.0, 0.25)[:, None]
    ends = []
    for side in (-1, 1):
        points = over + side * along * steps
        ends.append(points[int(np.argmax([not _is_near(camera, point) for point in points]))])
    return np.array(ends)


def _floor(camera: Camera) -> Floats:
    """Points of the ground on a grid over the picture where a person is seen whole, m, `(n, 2)`."""
    columns, rows = np.meshgrid(np.linspace(0.2, 0.8, 7) * camera.width, np.linspace(0.1, 0.9, 17) * camera.height)
    metres = camera.ground(np.column_stack([columns.ravel(), rows.ravel()]))
    metres = metres[np.isfinite(metres).all(axis=1)]
    return metres[[_is_near(camera, at) and _head_y(camera, at) > 0 for at in metres]]


def _is_near(camera: Camera, at_en: Floats) -> bool:
    """Whether a person there is in view, and not too far away."""
    box = _person_box(camera, at_en)
    is_far = np.hypot(*at_en) > _FAR_HEIGHTS * camera.height_m
    return box is not None and not is_far and is_in_view(camera, box)


def _head_y(camera: Camera, at_en: Floats) -> float:
    box = _person_box(camera, at_en)
    return -np.inf if box is None else float(box[1])


def _person_box(camera: Camera, at_en: Floats) -> Floats | None:
    east, north = (float(value) for value in at_en)
    return box_of(camera, placed(person(1.70, 0.0), (east, north), 0.0))
