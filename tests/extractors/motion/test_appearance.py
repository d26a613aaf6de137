import numpy as np

from extractors.motion.appearance import LOOKS, described, packed, unlikeness

RED, BLUE, BLACK, WHITE = (0, 0, 220), (220, 30, 0), (10, 10, 10), (240, 240, 240)
BOX = np.array([[20.0, 10, 40, 70]])
FULL = np.full((100, 120), 255, np.uint8)


def person(upper: tuple[int, int, int], lower: tuple[int, int, int]) -> np.ndarray:
    image = np.full((100, 120, 3), 128, np.uint8)
    image[10:40, 20:40], image[40:70, 20:40] = upper, lower
    return image


def looks(upper: tuple[int, int, int], lower: tuple[int, int, int]) -> np.ndarray:
    return described(person(upper, lower), FULL, BOX)


def test_each_half_is_a_histogram() -> None:
    found = looks(RED, BLACK)
    assert found.shape == (1, LOOKS)
    np.testing.assert_allclose(found.reshape(2, -1).sum(axis=1), 1)
    assert found.max() == 1


def test_the_same_clothes_are_alike_and_others_are_not() -> None:
    assert unlikeness(looks(RED, BLACK), looks(RED, BLACK))[0, 0] == 0
    assert unlikeness(looks(RED, BLACK), looks(BLUE, WHITE))[0, 0] == 1
    half = unlikeness(looks(RED, BLACK), looks(RED, WHITE))[0, 0]
    assert 0.5 < half < 1
    assert unlikeness(looks(RED, BLACK), looks(BLACK, RED))[0, 0] == 1  # where a colour is counts


def test_what_is_not_foreground_does_not_count() -> None:
    mask = FULL.copy()
    mask[:, 30:] = 0
    image = person(RED, BLACK)
    image[:, 30:] = WHITE
    np.testing.assert_array_equal(described(image, mask, BOX), looks(RED, BLACK))


def test_too_little_says_nothing_and_is_half_alike_to_all() -> None:
    nothing = described(person(RED, BLACK), np.zeros_like(FULL), BOX)
    assert np.isnan(nothing).all()
    assert unlikeness(nothing, looks(RED, BLACK)).tolist() == [[0.5]]
    assert np.isnan(described(person(RED, BLACK), FULL, BOX + 500)).all()


def test_it_is_packed_into_32_bytes() -> None:
    packed_looks = packed(looks(RED, BLACK)[0])
    assert len(packed_looks) == 32
    assert sorted(packed_looks)[-3:] == [0, 255, 255]
