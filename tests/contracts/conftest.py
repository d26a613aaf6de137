"""The logs that the contract is tried on: every test of this folder runs once on each kind.

A further kind of log (one whose old segments lie elsewhere, say) is one more entry of `KINDS`, with
the server that it rests on and what is made of a fresh log before the test gets it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import pytest

from events import Catalogue
from store import Log
from tests.conftest import MakeLog, Server, Servers
from tests.store.tiered import tiered


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of log."""

    server: str
    made_of: Callable[[Log, Path], Log] = lambda log, _: log
    """what is made of a fresh log, given a folder of its own"""


KINDS = {"embedded": Kind("embedded"), "external 15": Kind("15"), "tiered": Kind("embedded", tiered)}


@pytest.fixture(params=KINDS)
def kind(request: pytest.FixtureRequest) -> Kind:
    """The kind of log that this test runs on."""
    return KINDS[request.param]


@pytest.fixture
def server(servers: Servers, kind: Kind) -> Server:
    return servers.get(kind.server)


@pytest.fixture
def make_log(make_log: MakeLog, kind: Kind, tmp_path: Path) -> MakeLog:
    numbers = count(1)

    def make(catalogue: Catalogue | None = None) -> Log:
        return kind.made_of(make_log(catalogue), tmp_path / f"archive-{next(numbers)}")

    return make
