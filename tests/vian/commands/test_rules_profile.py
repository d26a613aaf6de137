"""`vian rules profile`: a line for each rule, and what is said of each wrong use."""

import json
from pathlib import Path

from store import Log
from tests.patterns.walkers import walkers
from tests.vian.conftest import Run
from tests.vian.test_rules import SHIPPED, write_rule


def test_each_rule_has_its_cost_and_its_state(log: Log, run: Run, tmp_path: Path) -> None:
    walkers(log)
    ran = run("rules", "profile", SHIPPED, write_rule(tmp_path / "high.yaml"), "--dsn", log.dsn, "--json")
    assert ran.code == 0
    costs = {each["rule"]: each for each in map(json.loads, ran.out.splitlines())}
    assert list(costs) == ["line-crossing", "loitering", "speeding", "zone-intrusion", "high"]
    assert {each["events"] for each in costs.values()} == {36}
    assert costs["high"]["situations"] == 36
    assert set(costs["high"]["shares"]) == {"ordering", "predicates", "matcher", "emission"}
    ran = run("rules", "profile", SHIPPED, "--since", "2026-01-01T10:00:06Z", "--dsn", log.dsn)
    assert ran.code == 0
    assert "loitering v1" in ran.out


def test_what_cannot_be_measured_is_told(log: Log, run: Run, tmp_path: Path) -> None:
    path = write_rule(tmp_path / "high.yaml")
    assert "a rule that saw no event cost nothing" in run("rules", "profile", path, "--dsn", log.dsn).words
    for arguments, said in (
        (["gone.yaml"], "the rule file gone.yaml cannot be read"),
        (["nothing"], "'nothing' is neither a rule file nor a rule deployed"),
        ([str(path), "--since", "2026-01-02", "--until", "2026-01-01"], "--since must be before --until"),
        ([str(tmp_path / "here")], "no rule files"),
    ):
        ran = run("rules", "profile", *arguments, "--dsn", log.dsn)
        assert ran.code == 2, arguments
        assert said in ran.words
