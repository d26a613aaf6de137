"""What a camera sees of a world of houses, from wherever it looks."""

import cv2
import numpy as np

from extractors.media import Image

WIDTH, HEIGHT = 320, 240


def world(seed: int = 4) -> Image:
    """Houses: rectangles of many sizes and tones, larger than the picture."""
    rng = np.random.default_rng(seed)
    image = np.full((3 * HEIGHT, 6 * WIDTH, 3), 120, np.uint8)
    for _ in range(900):
        x, y = rng.integers(0, image.shape[1]), rng.integers(0, image.shape[0])
        width, height = rng.integers(10, 70, 2)
        cv2.rectangle(image, (int(x), int(y)), (int(x + width), int(y + height)), rng.integers(30, 220, 3).tolist(), -1)
    return image


WORLD = world()


def view(x: float, y: float = HEIGHT, *, seed: int = 0, noise: float = 2.0) -> Image:
    """What the camera sees whose upper left corner is here."""
    shift = np.array([[1, 0, -x], [0, 1, -y]], np.float32)
    seen = cv2.warpAffine(WORLD, shift, (WIDTH, HEIGHT)).astype(np.float32)
    grain = np.random.default_rng(seed).normal(0, noise, seen.shape)
    return np.asarray(np.clip(seen + grain, 0, 255), np.uint8)
