"""The same rows in both engines give the same situations: measures, partition, first and last event.

Run by `make flink-test`, which makes the environment; elsewhere these are skipped.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from events import load_catalogue
from patterns import Rule, RuleError, load_rule, load_rules
from patterns.binding.binder import bind
from patterns.files.template import templates
from patterns.flink import translate
from patterns.processor import schemas
from patterns.scene.site import Site
from patterns.tools.cases import case_rows, case_site
from tests.flink.equality import PYTHON, ROOT, Case, comparable, ours, theirs
from tests.flink.samples import random_letters, random_rows, random_rule, random_timer_rule, site_of
from tests.patterns.samples import SCHEMAS

pytestmark = [
    pytest.mark.skipif("VIAN_FLINK" not in os.environ, reason="Flink runs with `make flink-test`"),
    pytest.mark.timeout(900),
]

SEED = int(os.environ.get("VIAN_FLINK_SEED", "1"))
RANDOM_RULES = int(os.environ.get("VIAN_FLINK_RULES", "40"))
"""How many random rules that Flink can say are compared."""


def _cases(rule: Rule) -> list[Case]:
    """The rule with the rows of its own tests, and with random ones."""
    known = schemas(load_catalogue())
    cases = []
    for index, test in enumerate(rule.tests):
        site = site_of(rule)
        site.take(case_site(test))
        rows = case_rows(bind(rule, known, site=site), known, index)
        cases.append(Case(f"{rule.rule}_{index}", rule, rows, known, site))
    rows = random_rows(rule, known, site, SEED, 600)
    return [*cases, Case(f"{rule.rule}_random_{SEED}", rule, rows, known, site)]


def _random(make: Callable[[int], Rule], count: int) -> list[Case]:
    cases = []
    seed = SEED * 1_000_000
    while len(cases) < count:
        seed += 1
        rule = make(seed)
        try:
            translate(rule, SCHEMAS)
        except RuleError:
            continue
        cases.append(Case(f"random_{seed}", rule, random_letters(seed, 120), SCHEMAS, Site()))
    return cases


def _differences(cases: list[Case], folder: Path) -> dict[str, Any]:
    """By case: how many situations each engine finds, and the first that only one of them does."""
    expected = {case.name: comparable(case, ours(case)) for case in cases}
    found = theirs(cases, folder)
    wrong = {}
    situations = 0
    for case in cases:
        mine = expected[case.name]
        yours = comparable(case, found[case.name])
        situations += len(mine)
        if mine != yours:
            missing = [row for row in mine if row not in yours]
            extra = [row for row in yours if row not in mine]
            wrong[case.name] = (len(mine), len(yours), missing[:1], extra[:1])
            print(case.name, case.rule.match, *wrong[case.name], sep="\n")  # noqa: T201 - what differs
    print(f"{len(cases)} cases, {situations} situations in both engines, seed {SEED}")  # noqa: T201 - what was compared
    assert situations > len(cases), "what finds nothing is not compared"
    return wrong


def test_the_environment_is_there() -> None:
    assert PYTHON.exists(), "no Flink. Next: make flink"


def test_shipped_rules_find_the_same(tmp_path: Path) -> None:
    cases = [case for rule in load_rules(ROOT / "patterns" / "rules") for case in _cases(rule)]
    assert _differences(cases, tmp_path) == {}


def test_templates_find_the_same(tmp_path: Path) -> None:
    cases = [case for each in templates().values() for case in _cases(load_rule(each.case_file))]
    assert _differences(cases, tmp_path) == {}


def test_random_rules_find_the_same(tmp_path: Path) -> None:
    assert _differences(_random(random_rule, RANDOM_RULES), tmp_path) == {}


def test_random_rules_with_timers_find_the_same(tmp_path: Path) -> None:
    assert _differences(_random(random_timer_rule, RANDOM_RULES // 2), tmp_path) == {}
