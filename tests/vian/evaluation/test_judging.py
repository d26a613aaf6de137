import numpy as np

from tests.vian.evaluation.cameras import Pinhole, walkers
from vian.evaluation.boxes import Boxes
from vian.evaluation.judging import judged, summaries
from vian.evaluation.lines import Horizon
from vian.evaluation.scenes import Scene

CAMERA = Pinhole()
BOXES, _ = walkers(CAMERA, np.random.default_rng(1), tracks=2)
SCENES = [Scene(str(number), 640, 480, BOXES, Horizon(0.0, 48.0 * number)) for number in range(4)]


class Level:
    """Says the picture's upper edge, give or take 40 px, of all scenes but the last."""

    name = "level"
    left = 3

    def estimate(self, boxes: Boxes, width: int, height: int) -> Horizon | None:
        self.left -= 1
        return Horizon(0.0, 0.0, np.diag([1e-9, 40.0**2])) if self.left >= 0 else None


def test_errors_abstentions_and_intervals_are_summed_up() -> None:
    found = list(judged(SCENES, [Level()]))
    np.testing.assert_allclose([each.error for each in found], [0.0, 0.1, 0.2, np.inf])
    assert [each.is_covered for each in found] == [True, True, False, None]
    (summary,) = summaries(found)
    assert (summary.scenes, summary.abstained) == (4, 1)
    np.testing.assert_allclose(
        [summary.median, summary.percentile_75, summary.auc], [0.15, np.inf, (1 + 0.6 + 0.2) / 4]
    )
    assert summary.coverage == 2 / 3


def test_who_always_abstains_has_no_median() -> None:
    nobody = Level()
    nobody.left = 0
    (summary,) = summaries(list(judged(SCENES, [nobody])))
    assert (summary.median, summary.auc, summary.coverage) == (np.inf, 0.0, None)
