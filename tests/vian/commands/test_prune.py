"""`vian prune` at the command line."""

import json
from datetime import timedelta

import pytest

from store import Log
from tests.store.samples import GATE, append
from tests.sync.test_pruning import countersign, signed, whole
from tests.vian.conftest import Run
from vian import pruning


@pytest.fixture
def options(log: Log, monkeypatch: pytest.MonkeyPatch) -> tuple[str, ...]:
    append(log, GATE, 3, 2)
    countersign(log, (GATE, 3))
    monkeypatch.setattr(pruning, "signed_by_central", lambda _: signed)
    return ("prune", "--dsn", log.dsn, "--station", "brno")


def test_a_dry_run_says_what_would_go_and_takes_nothing_off(log: Log, options: tuple[str, ...], run: Run) -> None:
    said = run(*options, "--after-days", "0", "--dry-run")
    assert "payloads of 1 segments, 0.0 MiB, would go" in said.words
    assert whole(log, GATE) == [True, True]


def test_what_went_is_told_stream_by_stream(log: Log, options: tuple[str, ...], run: Run) -> None:
    (row,) = map(json.loads, run(*options, "--after-days", "0", "--json").out.splitlines())
    assert (row["stream"], row["from"], row["to"], row["segments"]) == (str(GATE), 1, 3, 1)
    assert whole(log, GATE) == [False, True]
    verified = run("verify", "--dsn", log.dsn, "--station", "brno")
    assert verified.code == 0
    assert "1 segments without payload: pruned or lost, as the log records" in verified.out
    assert "nothing may go" in run(*options, "--after-days", "0").words


def test_without_an_age_nothing_is_guessed(options: tuple[str, ...], run: Run) -> None:
    said = run(*options)
    assert said.code == 2
    assert "Next: give --after-days DAYS, or the setting prune_after_days" in said.words


def test_what_is_young_stays(log: Log, options: tuple[str, ...], run: Run) -> None:
    assert run(*options, "--after-days", str(timedelta(days=1).days)).code == 0
    assert whole(log, GATE) == [True, True]
