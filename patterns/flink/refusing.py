"""Saying no, with the place and the reason from the one table of `patterns.flink.portable`."""

from dataclasses import dataclass
from typing import NoReturn, Protocol

from patterns.flink.portable import PORTABLE
from patterns.language.text import Passage


class Refuse(Protocol):
    """Raises a RuleError that points at a place of the rule's SQL."""

    def __call__(self, construct: str, at: int, detail: str = "") -> NoReturn:
        """Refuses the construct; the detail is put behind the reason."""
        ...


@dataclass(frozen=True, slots=True)
class Refuser:
    """Refuses in one passage."""

    passage: Passage

    def __call__(self, construct: str, at: int, detail: str = "") -> NoReturn:
        """Raises; see `Refuse`."""
        raise self.passage.error(refusal(construct, detail), at)


def refusal(construct: str, detail: str = "") -> str:
    """What is wrong, and what to write in its stead."""
    return f"portable: {construct}: {PORTABLE[construct].why}{detail}"
