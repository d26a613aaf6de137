"""Fixtures of the composition root: a command line in this process, short clips, an environment of its own."""

import logging
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import structlog
from typer.testing import CliRunner

from extractors import video
from tests.conftest import Server
from tests.vian.clips import write_clip
from vian.cli import app


@dataclass(frozen=True, slots=True)
class Ran:
    """What a command came to."""

    code: int
    out: str
    err: str

    @property
    def words(self) -> str:
        """What it told people, without the breaks of lines that a narrow terminal brings."""
        return " ".join(self.err.split())


Run = Callable[..., Ran]


@pytest.fixture(autouse=True)
def environment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Settings, data and cache of nobody, and a log set-up that ends with the test."""
    for name in ("VIAN_DATA_DIR", "VIAN_DSN", "VIAN_STATION", "VIAN_CONFIG", "VIAN_CENTRAL", "VIAN_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name in ("XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_CACHE_HOME"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    levels = {name: each.level for name, each in logging.root.manager.loggerDict.items() if _is_logger(each)}
    yield
    root.handlers[:] = handlers
    root.setLevel(level)
    for name, before in levels.items():
        logging.getLogger(name).setLevel(before)
    structlog.reset_defaults()


def _is_logger(each: Any) -> bool:
    return isinstance(each, logging.Logger)


def command_line(*arguments: object, typed: str | None = None) -> Ran:
    """Run the command line in this process."""
    result = CliRunner().invoke(app, [str(each) for each in arguments], input=typed)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Ran(result.exit_code, result.stdout, result.stderr)


@pytest.fixture
def run() -> Run:
    """Runs the command line in this process, in this test's environment."""
    return command_line


@pytest.fixture
def durable(server: Server) -> Iterator[None]:
    """The server as it is set up outside of tests: what is committed survives a power cut."""
    names = ("fsync", "full_page_writes", "autovacuum")
    server.execute(*(f"alter system set {name} = on" for name in names), "select pg_reload_conf()")
    server.wait_for(dict.fromkeys(names, "on"))
    yield
    server.execute(*(f"alter system set {name} = off" for name in names), "select pg_reload_conf()")
    server.wait_for(dict.fromkeys(names, "off"))


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A video of six seconds in which one box crosses the picture."""
    return write_clip(tmp_path_factory.mktemp("clips") / "crossing.mp4")


@pytest.fixture(scope="module")
def decoded_once() -> Iterator[None]:
    """Each video is decoded once: most tests here are about what becomes of its frames."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(video, "probe", cache(video.probe))
        patched.setattr(video, "frames", cache(lambda path, decode=video.frames, **asked: tuple(decode(path, **asked))))
        yield
