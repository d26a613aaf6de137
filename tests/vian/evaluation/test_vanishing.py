import numpy as np
import pytest

from tests.vian.evaluation.cameras import Pinhole
from vian.errors import WrongUsage
from vian.evaluation.lines import error_of
from vian.evaluation.vanishing import Group, Marks, horizon_of_marks

CAMERA = Pinhole(pitch=0.3, roll=0.2)


def group(angle: float, *, noise: float = 0.0, seed: int = 0, lines: int = 4, camera: Pinhole = CAMERA) -> Group:
    """Segments on level lines of one direction, at several heights and distances."""
    rng = np.random.default_rng(seed)
    along = np.array([np.sin(angle), np.cos(angle), 0])
    across = np.array([along[1], -along[0], 0])
    segments = []
    for number in range(lines):
        at = np.array([0, 20, 0]) + across * (6 * number - 9) + [0, 0, number % 2]
        ends = camera.pixels(np.array([at - 6 * along, at + 6 * along])) + rng.normal(0, noise, (2, 2))
        segments.append(tuple(map(float, ends.ravel())))
    return Group(segments=tuple(segments))


def marks(*groups: Group) -> Marks:
    return Marks(width=CAMERA.width, height=CAMERA.height, groups=groups, marked_px=0.5)


UP = np.array([0, 0, 3])


def upright() -> Group:
    """Segments on plumb lines."""
    feet = np.array([[-4.0, 15, 0], [3, 18, 0], [6, 25, 0]])
    ends = [CAMERA.pixels(np.array([foot, foot + UP])) for foot in feet]
    return Group(segments=tuple(tuple(map(float, each.ravel())) for each in ends))


@pytest.mark.parametrize("roll", [-0.35, 0.35])
def test_a_camera_that_is_rolled_by_20_degrees_is_legal(roll: float) -> None:
    camera = Pinhole(pitch=0.3, roll=roll)
    groups = [group(angle, camera=camera, noise=0.5, seed=number) for number, angle in enumerate((0.4, -0.5, 1.0))]
    found = horizon_of_marks(marks(*groups))
    assert error_of(found.horizon, camera.horizon, camera.width, camera.height) < 0.03
    assert found.doubts == ()


def test_marks_that_do_not_fit_together_are_doubted() -> None:
    x1, y1, x2, y2 = group(0.4).segments[0]
    bent = Group(name="bent", segments=((x1, y1 + 20.0, x2, y2), *group(0.4).segments[1:]))
    (doubt,) = horizon_of_marks(marks(bent, group(-0.5))).doubts
    assert "bent: its lines do not meet in one point" in doubt
    sloping = tuple((x1, y1, x2, y2 + 12.0) for x1, y1, x2, y2 in group(-0.8).segments)
    told = horizon_of_marks(marks(group(0.1), group(0.7), Group(segments=sloping))).doubts
    assert any("the groups give no one horizon" in each for each in told)


@pytest.mark.parametrize("angles", [(0.4, -0.5), (0.1, 0.7, -0.8)])
def test_exact_marks_give_the_exact_horizon(angles: tuple[float, ...]) -> None:
    found = horizon_of_marks(marks(*map(group, angles)))
    assert error_of(found.horizon, CAMERA.horizon, CAMERA.width, CAMERA.height) < 1e-6
    assert max(point.rms_px for point in found.points) < 1e-6


def test_the_stated_covariance_is_the_spread_over_repeated_marking() -> None:
    found = [
        horizon_of_marks(
            marks(*(group(angle, noise=0.5, seed=3 * seed + number) for number, angle in enumerate((0.4, -0.5))))
        )
        for seed in range(100)
    ]
    at = np.array([each.horizon.at(320.0) for each in found])
    stated = np.median([each.horizon.sd_at(320.0) for each in found])
    # A standard deviation of 100 draws is known within 7 %; what residuals add makes some intervals wider.
    assert 0.7 < np.std(at) / stated < 1.3
    assert np.median([point.rms_px for each in found for point in each.points]) == pytest.approx(0.35, rel=0.5)


def test_groups_that_disagree_make_the_horizon_less_certain() -> None:
    agreed = horizon_of_marks(marks(group(0.1), group(0.7), group(-0.8)))
    sloping = tuple((x1, y1, x2, y2 + 12.0) for x1, y1, x2, y2 in group(-0.8).segments)
    disagreed = horizon_of_marks(marks(group(0.1), group(0.7), Group(segments=sloping)))
    assert disagreed.horizon.sd_at(320.0) > 3 * agreed.horizon.sd_at(320.0)


@pytest.mark.parametrize(
    "given, wanted",
    [
        (marks(group(0.4)), "wanted two or more of different directions"),
        (marks(group(0.4), group(-0.4, lines=1)), "group 2: 1 segment, wanted two or more"),
        (
            marks(group(0.4), Group(name="far", segments=((0, 5, 90, 5), (0, 50, 90, 50.2)))),
            "far: its lines are parallel",
        ),
        (marks(group(0.4), Group(segments=((0, 5, 0.1, 5), (0, 50, 90, 60)))), "segment 1 is 0.1 px long"),
        (marks(group(0.4), group(0.4)), "no line is fixed by them"),
        (
            marks(group(0.4), upright()),
            r"a horizon that is \d\d degrees steep, wanted at most 45: the lines of a group are upright",
        ),
        (
            marks(
                Group(segments=((0, 300, 200, 250), (0, 400, 200, 300))),
                Group(name="wall", segments=((0, 100, 200, 300), (0, 300, 200, 100))),
            ),
            r"wall: its lines meet at \(100, 200\), within segment 1, wanted beyond the ends of all",
        ),
    ],
)
def test_marks_that_fix_no_horizon_are_refused(given: Marks, wanted: str) -> None:
    with pytest.raises(WrongUsage, match=wanted) as caught:
        horizon_of_marks(given)
    assert "Next: " in str(caught.value)
