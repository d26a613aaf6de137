"""The roads of docs/guides/flink.md: events out of the log and the archive, into Flink, to the same situations."""

import json
import os
import re
from pathlib import Path
from typing import Any

import duckdb
import pytest

from patterns.processor import Processor, deploy
from store import Log
from tests.flink.equality import ROOT, run_in_flink
from tests.patterns.test_processor import STATION, T0, rule, walkers
from tests.vian.conftest import Run, environment, run
from vian.rules import file_text

__all__ = ["environment", "run"]  # fixtures

GUIDE = (ROOT / "docs" / "guides" / "flink.md").read_text(encoding="utf-8")
pytestmark = [
    pytest.mark.skipif("VIAN_FLINK" not in os.environ, reason="Flink runs with `make flink-test`"),
    pytest.mark.timeout(600),
]


def _written(language: str, beginning: str) -> str:
    """The guide's block in this language that has this beginning of a statement."""
    blocks = re.findall(rf"^```{language}\n(.*?)^```", GUIDE, re.MULTILINE | re.DOTALL)
    (block,) = (each for each in blocks if beginning in each)
    return str(block)


def _script(run: Run, log: Log, path: Path) -> dict[str, Any]:
    given = ["connector=filesystem", f"path={path}/{{type}}", "format=json", "json.timestamp-format.standard=ISO-8601"]
    options = [part for each in given for part in ("--with", each)]
    ran = run("rules", "flink", "enters", *options, "--dsn", log.dsn, "--json")
    assert ran.code == 0, ran.err
    return dict(json.loads(ran.out))


def test_events_from_the_log_and_from_the_archive_give_the_situations_of_the_log(
    log: Log, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    walkers(log)
    deployed = rule()
    deploy(log, STATION, [deployed], {deployed.rule: file_text(deployed)}, T0)
    Processor(log, STATION, [deployed]).catch_up()
    for road in ("query", "archive"):
        (tmp_path / road / "track_point").mkdir(parents=True)
    sql = re.search(r'vian query "(.*?)"', _written("sh", "vian query").replace("\\\n", ""), re.DOTALL)
    assert sql is not None
    output = tmp_path / "query" / "track_point" / "rows.json"
    assert run("query", sql[1], "--format", "json", "--output", output, "--dsn", log.dsn).code == 0
    assert run("archive", "--older-than", "0d", "--to", tmp_path / "archive_of_log", "--dsn", log.dsn).code == 0
    copy = _written("sql", "copy (").replace("archive/track_point/*", "archive_of_log/track_point/*")
    duckdb.sql(copy.replace("events/track_point", "archive/track_point"))

    jobs = []
    for road in ("query", "archive"):
        said = _script(run, log, tmp_path / road)
        statements = [each["sql"] for each in said["statements"]]
        jobs.append({"name": road, "statements": statements, "result": said["result"]})
    found = run_in_flink(jobs, tmp_path)

    stored = run("query", "select partition, measures from situation_detected", "--format", "json", "--dsn", log.dsn)
    wanted = sorted(
        (json.loads(each["partition"])["track_id"], json.loads(each["measures"])["x"])
        for each in map(json.loads, stored.out.splitlines())
    )
    assert wanted
    for road in ("query", "archive"):
        assert sorted((int(each["track_id"]), float(each["x"])) for each in found[road]) == wanted
