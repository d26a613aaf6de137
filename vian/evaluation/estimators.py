"""What is measured: estimators as functions of boxes, whatever they are inside."""

from typing import Protocol

from extractors.horizon import FrameSize, HorizonConfig, TrackPoints, estimated
from vian.errors import WrongUsage
from vian.evaluation.boxes import Boxes
from vian.evaluation.lines import Horizon
from vian.evaluation.references import SizeRelation, VoteLine


class HorizonEstimator(Protocol):
    """Finds a camera's horizon from boxes of what moved."""

    name: str

    def estimate(self, boxes: Boxes, width: int, height: int) -> Horizon | None:
        """The horizon in pixels of the frame; None to abstain. Nothing is kept between calls."""
        ...


class TrackHorizon:
    """The estimator that ships: `extractors.horizon`.

    Args:
        is_of_blobs: Whether the boxes are those of the motion extractor, whose parameters are others.
    """

    name = "vian"

    def __init__(self, *, is_of_blobs: bool = False) -> None:
        self._config = HorizonConfig.of_blobs() if is_of_blobs else HorizonConfig()

    def estimate(self, boxes: Boxes, width: int, height: int) -> Horizon | None:
        """The horizon and its covariance, or none."""
        points = TrackPoints(boxes.time_us, boxes.track_id, boxes.frame, boxes.xyxy, boxes.confidence)
        found = estimated(points, FrameSize(width, height), self._config)
        if found is None:
            return None
        line = found.fit.line
        return Horizon(line.slope, line.offset, found.fit.line_covariance)


def estimators(names: list[str] | None = None, *, is_of_blobs: bool = False) -> list[HorizonEstimator]:
    """The estimators of these names; all of them without names.

    Args:
        names: Which.
        is_of_blobs: Whether the boxes that they get are those of the motion extractor.

    Raises:
        WrongUsage: There is none of a name.
    """
    known: list[HorizonEstimator] = [TrackHorizon(is_of_blobs=is_of_blobs), VoteLine(), SizeRelation()]
    if names is None:
        return known
    by_name = {each.name: each for each in known}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise WrongUsage(f"--method must be one of {', '.join(by_name)}, got {unknown[0]!r}")
    return [by_name[name] for name in dict.fromkeys(names)]
