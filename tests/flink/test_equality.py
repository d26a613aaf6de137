"""The same rows in both engines give the same situations: measures, partition, first and last event.

Run by `make flink-test`, which makes the environment; elsewhere these are skipped.
"""

import os
from pathlib import Path

import pytest

from events import load_catalogue
from patterns import RuleError, load_rules
from patterns.binder import bind
from patterns.cases import case_rows
from patterns.flink import translate
from patterns.processor import schemas
from tests.flink.equality import PYTHON, ROOT, Case, comparable, ours, theirs
from tests.flink.samples import frames_of, random_letters, random_rows, random_rule
from tests.patterns.samples import SCHEMAS

pytestmark = [
    pytest.mark.skipif("VIAN_FLINK" not in os.environ, reason="Flink runs with `make flink-test`"),
    pytest.mark.timeout(900),
]

SEED = int(os.environ.get("VIAN_FLINK_SEED", "1"))
RANDOM_RULES = int(os.environ.get("VIAN_FLINK_RULES", "40"))
"""How many random rules that Flink can say are compared."""


def _shipped(folder: Path) -> list[Case]:
    known = schemas(load_catalogue())
    cases = []
    for rule in load_rules(folder):
        for index, test in enumerate(rule.tests):
            frames = dict(test.frames)
            rows = case_rows(bind(rule, known, frames), index)
            cases.append(Case(f"{rule.rule}_{index}", rule, rows, known, frames))
        for seed in (SEED, SEED + 1):
            rows = random_rows(rule, known, seed, 400)
            cases.append(Case(f"{rule.rule}_random_{seed}", rule, rows, known, frames_of(rule)))
    return cases


def _random() -> list[Case]:
    cases = []
    seed = SEED * 1_000_000
    while len(cases) < RANDOM_RULES:
        seed += 1
        rule = random_rule(seed)
        try:
            translate(rule, SCHEMAS)
        except RuleError:
            continue
        cases.append(Case(f"random_{seed}", rule, random_letters(seed, 120), SCHEMAS, {}))
    return cases


def _compared(cases: list[Case], folder: Path) -> None:
    found = theirs(cases, folder)
    wrong = {}
    situations = 0
    for case in cases:
        mine = comparable(case, ours(case))
        yours = comparable(case, found[case.name])
        situations += len(mine)
        if mine != yours:
            missing = [row for row in mine if row not in yours]
            extra = [row for row in yours if row not in mine]
            wrong[case.name] = (case.rule.match, len(mine), len(yours), missing[:2], extra[:2])
    print(f"{len(cases)} cases, {situations} situations in both engines, seed {SEED}")  # noqa: T201 - what was compared
    assert wrong == {}
    assert situations > len(cases)


def test_the_environment_is_there() -> None:
    assert PYTHON.exists(), "no Flink. Next: make flink"


def test_shipped_rules_find_the_same(tmp_path: Path) -> None:
    _compared(_shipped(ROOT / "patterns" / "rules"), tmp_path)


def test_random_rules_find_the_same(tmp_path: Path) -> None:
    _compared(_random(), tmp_path)
