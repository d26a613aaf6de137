"""Demos in this process, both logs cloned databases."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from store import Log
from tests.conftest import MakeLog
from tests.vian.samples import heads, reopened
from vian.demo.clip import Clip, Origin
from vian.demo.run import Summary, run_demo
from vian.output import Output


@dataclass(frozen=True, slots=True)
class Stage:
    """Two logs and a clip: what a demo needs."""

    station: Log
    central: Log
    clip: Clip
    report: Path

    def run(self, clip: Clip | None = None) -> Summary:
        """Run the demo as a process of its own would: with handles of its own on the logs."""
        return run_demo(
            lambda: reopened(self.station), lambda: reopened(self.central), [clip or self.clip], self.report, Output()
        )

    def heads(self) -> list[dict[str, tuple[int, str]]]:
        both = (heads(self.station), heads(self.central))
        # Central's log also says that it took the station in.
        return [{name: head for name, head in each.items() if not name.startswith("central/")} for each in both]


@pytest.fixture
def make_stage(make_log: MakeLog, clip: Path, tmp_path: Path) -> Callable[[], Stage]:
    """Makes a stage with logs of its own."""
    return lambda: Stage(make_log(), make_log(), Clip(clip, Origin.GIVEN, None), tmp_path / "report.html")


@pytest.fixture
def stage(make_stage: Callable[[], Stage]) -> Stage:
    return make_stage()
