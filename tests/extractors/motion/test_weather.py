"""Rain, leaves, and motion that is only up and down."""

from collections.abc import Callable, Iterator

import cv2
import numpy as np

from extractors.media import Frame, Image
from tests.extractors.motion.runs import Run, run
from tests.extractors.motion.views import HEIGHT, WIDTH, view

EMPTY = view(300)


def seen(see: Callable[[int], Image], *, frames: int, fps: int = 10) -> Run:
    def pictures() -> Iterator[Frame]:
        for at in range(frames):
            yield Frame(at, round(1e6 * at / fps), see(at))

    return run(pictures())


def test_rain_is_nobody() -> None:
    def rain(at: int) -> Image:
        random, wet = np.random.default_rng(at), EMPTY.copy()
        for x, y, length in random.integers((0, 0, 8), (WIDTH, HEIGHT, 22), (120, 3)).tolist():
            cv2.line(wet, (x, y), (x + 2, y + length), (220, 220, 220), 1)
        return np.asarray(cv2.addWeighted(wet, 0.5, EMPTY, 0.5, 0), np.uint8)

    assert not seen(rain, frames=80).batches


def test_leaves_that_sway_are_learnt() -> None:
    random = np.random.default_rng(1)
    places, turns = random.integers(0, 120, (60, 2)).tolist(), random.uniform((0.5, 0), (1.5, 6), (60, 2)).tolist()

    def tree(at: int) -> Image:
        image = EMPTY.copy()
        for (x, y), (rate, phase) in zip(places, turns, strict=True):
            angle = 2 * np.pi * rate * at / 5 + phase
            middle = round(180 + x + 2 * np.sin(angle)), round(20 + y + 1.4 * np.cos(angle / 1.15))
            cv2.ellipse(image, middle, (9, 5), phase * 60, 0, 360, (40, 120 + round(10 * phase), 60), -1)
        return image

    frames = seen(tree, frames=150, fps=5).column("frame")
    # A new model does not know them yet; the background's modes take them in, each in its time.
    assert not (frames > 110).any()


def test_what_goes_up_or_down_is_followed() -> None:
    def lift(at: int) -> Image:
        image = EMPTY.copy()
        for x, y in ((60, 250 - 3 * at), (200, 3 * at - 60)):
            cv2.rectangle(image, (x, y), (x + 24, y + 60), (230, 240, 250), -1)
        return image

    found = seen(lift, frames=100)
    assert len(found.ends) == 2
    assert all(abs(end.x_exit - end.x_entry) < 5 < abs(end.y_exit - end.y_entry) for end in found.ends)
