"""Rule files over several inputs, with timers, over stages and situations: rows in, situations out."""

from pathlib import Path

import pytest

from events import load_catalogue
from patterns import check, load_rules, run_tests
from patterns.binding.strata import in_strata, with_situations
from patterns.processor import schemas

RULES = in_strata(load_rules(Path(__file__).parent / "cases" / "rules"))
KNOWN = with_situations(schemas(load_catalogue()), RULES)


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.rule)
def test_the_rules_tests_pass(rule) -> None:
    assert [finding for finding in check(rule, KNOWN) if finding.severity == "error"] == []
    results = run_tests(rule, KNOWN)
    assert results
    for result in results:
        assert result.passed, f"{result.name}\n{result.difference}"
