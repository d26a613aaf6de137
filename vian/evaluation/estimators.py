"""What is measured: estimators as functions of boxes, whatever they are inside."""

from typing import Protocol

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


def estimators(names: list[str] | None = None) -> list[HorizonEstimator]:
    """The estimators of these names; all of them without names.

    Raises:
        WrongUsage: There is none of a name.
    """
    known: list[HorizonEstimator] = [VoteLine(), SizeRelation()]
    if names is None:
        return known
    by_name = {each.name: each for each in known}
    unknown = [name for name in names if name not in by_name]
    if unknown:
        raise WrongUsage(f"--method must be one of {', '.join(by_name)}, got {unknown[0]!r}")
    return [by_name[name] for name in dict.fromkeys(names)]
