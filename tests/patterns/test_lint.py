"""What a check finds in rules that can run: each finding at its place, with its code, and none where nothing is."""

from collections.abc import Sequence

import pytest

from patterns import Zone, load_rules, parse_rule
from patterns.files.rule import Rule
from patterns.linting.findings import Finding
from patterns.linting.lint import check, lint
from tests.patterns.samples import SCHEMAS
from tests.patterns.test_shipped_rules import FOLDER

HEAD = """\
rule: {name}
version: 1
title: sample
severity: info
zones: {{hall: {{source: cam-01, units: pixels, polygon: [[0, 0], [9, 0], [9, 9]]}}}}
params: {params}
match: |
  SELECT * FROM {source} MATCH_RECOGNIZE (PARTITION BY key ORDER BY time
"""


def rule(clauses: str, name: str = "sample", params: str = "{}", source: str = "letter") -> Rule:
    head = HEAD.format(name=name, params=params, source=source)
    head = "".join(line for line in head.splitlines(keepends=True) if "zones:" not in line or "hall" in clauses)
    return parse_rule(head + "".join(f"    {line}\n" for line in clauses.split("\n")))


def codes(findings: Sequence[Finding]) -> list[str]:
    return [finding.code for finding in findings]


def found(clauses: str, **given: str) -> list[str]:
    return codes(check(rule(clauses, **given), SCHEMAS))


@pytest.mark.parametrize(
    "define",
    [
        "n > 5 AND n < 5",
        "n >= 5 AND n < 5",
        "n = 5 AND n <> 5",
        "n = 5 AND n = 6",
        "n = 5 AND n > 5",
        "n = 5 AND 4 >= n",
        "n BETWEEN 6 AND 5",
        "letter = 'a' AND letter = 'b'",
        "flag AND NOT flag",
        "in_zone(n, v, 'hall') AND NOT in_zone(n, v, 'hall')",
        "n = NULL",
        "v > n AND v < n",
        "v > n AND n >= v",
        "time >= C.time + INTERVAL '1' SECOND",
        "time - C.time >= INTERVAL '2' SECOND",
        "n > LAST(C.n) AND n < LAST(C.n)",
    ],
)
def test_a_rule_that_can_never_match_is_an_error(define: str) -> None:
    clauses = f"PATTERN (C A) WITHIN INTERVAL '1' SECOND DEFINE A AS {define}, C AS n > 0)"
    (finding,) = check(rule(clauses), SCHEMAS)
    assert (finding.code, finding.severity) == ("never-matches", "error")
    assert finding.message.startswith("the rule can never match, because a variable can never be true: A: ")
    assert finding.place.excerpt.split("| ")[1].lstrip().startswith("PATTERN")


@pytest.mark.parametrize(
    "define",
    [
        "n >= 5 AND n <= 5",
        "n > 4 AND n < 6",
        "n <> 5 AND n >= 5",
        "n > 5 OR n < 5",
        "n IS NULL",
        "v > n AND v > LAST(C.n)",
        "v >= n AND v <= n",
        "time < C.time + INTERVAL '1' SECOND",
        "time >= C.time + INTERVAL '0.9' SECOND",
        "time >= PREV(time) + INTERVAL '9' SECOND OR n > 1",
    ],
)
def test_what_may_be_true_is_let_alone(define: str) -> None:
    assert found(f"PATTERN (C A) WITHIN INTERVAL '1' SECOND DEFINE A AS {define}, C AS n > 0)") == []


def test_a_variable_that_is_never_taken_is_a_warning_where_the_rest_can_match() -> None:
    clauses = "PATTERN (A B? C) WITHIN INTERVAL '1' SECOND DEFINE A AS n > 1, B AS n > 5 AND n < 5, C AS n > 2)"
    (finding,) = check(rule(clauses), SCHEMAS)
    assert (finding.code, finding.severity) == ("never-true", "warning")


@pytest.mark.parametrize(
    "clauses,wanted",
    [
        ("PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS TRUE)", ["always-matches"]),
        ("PATTERN (B | A) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", ["always-matches"]),
        ("PATTERN (A B) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", []),
        ("PATTERN (A* B) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", ["quadratic"]),
        ("PATTERN (A+ B) WITHIN INTERVAL '1' SECOND DEFINE A AS n > 0, B AS n > 1)", []),
        ("PATTERN (B A* C) DEFINE B AS n > 1, C AS n > 2)", ["quadratic"]),
        ("PATTERN (B A C) DEFINE B AS n > 1, C AS n > 2)", ["unbounded"]),
        ("PATTERN (B (A | A) C) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1, A AS n > 2)", ["unreachable"]),
        ("PATTERN (B (A | C) D) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1, A AS n > 2, C AS n > 2 AND v > 1)",
         ["unreachable"]),
        ("PATTERN (B (C | A) D) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1, A AS n > 2, C AS n > 2 AND v > 1)", []),
        ("MEASURES C.n AS n\nPATTERN (B (A | C)) WITHIN INTERVAL '1' DAY DEFINE A AS n > 2, C AS n > 2 AND v > 1)", []),
        ("PATTERN (A B) WITHIN INTERVAL '1' SECOND DEFINE B AS TIMER(A.time, INTERVAL '2' SECOND))", ["within-timer"]),
        ("PATTERN (A B) WITHIN INTERVAL '1' SECOND DEFINE B AS n < NEXT(n))", ["unbounded", "waits"]),
        ("MEASURES MATCH_NUMBER() AS m\nPATTERN (A B) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", ["unbounded"]),
        ("PATTERN (A B $) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", ["unbounded"]),
        ("PATTERN (^ A B) WITHIN INTERVAL '1' SECOND DEFINE B AS n > 1)", ["unbounded"]),
    ],
)  # fmt: skip
def test_what_looks_wrong_is_named(clauses: str, wanted: list[str]) -> None:
    assert found(clauses) == wanted


def test_a_filter_before_the_pattern_makes_every_row_a_chosen_one() -> None:
    clauses = "PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS TRUE)"
    assert found(clauses, source="(SELECT * FROM letter WHERE n > 1)") == []


@pytest.mark.parametrize(
    "written,like", [("50 kmh", "km/h"), ("10 sec", "s"), ("3 Min", "min"), ("5 pixels", "px"), ("7 Metres", "m")]
)
def test_a_text_that_was_meant_to_have_a_unit_is_named(written: str, like: str) -> None:
    one = rule("PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS letter = :limit)", params=f"{{limit: {written}}}")
    (finding,) = check(one, SCHEMAS)
    assert (finding.code, finding.place.line) == ("unit", 5)
    assert finding.message.endswith(f"did you mean {like!r}?")


def test_a_text_of_digits_and_letters_is_let_alone() -> None:
    assert found("PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS letter = :plate)", params="{plate: 12 ABC}") == []


def test_unused_names_are_named_with_their_places() -> None:
    text = HEAD.format(name="sample", params="{many: 3}", source="letter").replace("params", "shared: [yard]\nparams")
    findings = check(parse_rule(text + "    PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS n > 1)\n"), SCHEMAS)
    assert [(each.code, each.place.line) for each in findings] == [
        ("unused-zone", 5), ("unused-shared", 6), ("unused-parameter", 7),
    ]  # fmt: skip


def pair(within_s: int, condition: str, pattern: str = "(A B)") -> str:
    return f"PATTERN {pattern} WITHIN INTERVAL '{within_s}' SECOND DEFINE A AS n > 1, B AS {condition})"


RENAMED = "PATTERN (X Y) WITHIN INTERVAL '5' SECOND DEFINE Y AS v > X.v, X AS 1 < n)"


@pytest.mark.parametrize(
    "one,other,wanted",
    [
        (pair(5, "v > 2"), pair(5, "v > 2"), "other takes the same rows as one"),
        (pair(5, "v > 2"), pair(5, "v > 2 AND n < 9"), "other takes only rows that are also taken by one"),
        (pair(4, "v > 2"), pair(5, "v > 2"), "one takes only rows that are also taken by other"),
        (pair(5, "v > A.v"), RENAMED.replace("1 < n", "n > 1"), "other takes the same rows as one"),
        (pair(5, "v > 2"), pair(5, "v > 3"), ""),
        (pair(5, "v > 2"), pair(5, "v > 2", "(A B+)"), ""),
        (pair(4, "v > 2"), pair(5, "v > 2 AND n < 9"), ""),
        (pair(5, "v > LAST(A.v)"), pair(5, "v > FIRST(A.v)"), ""),
    ],
)
def test_rules_that_find_what_another_finds_are_named(one: str, other: str, wanted: str) -> None:
    findings = lint([rule(one, "one"), rule(other, "other")], SCHEMAS)
    overlapping = [each for each in findings if each.code == "overlap"]
    assert [wanted in each.message for each in overlapping] == ([True] if wanted else [])


def test_versions_of_one_rule_and_rules_over_other_zones_do_not_overlap() -> None:
    clauses = "PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS in_zone(n, v, 'hall'))"
    one, other = rule(clauses, "one"), rule(clauses, "other")
    moved = parse_rule("\n".join(HEAD.format(name="other", params="{}", source="letter").replace("[9, 9]", "[9, 8]")
                                 .splitlines()) + f"\n    {clauses}\n")  # fmt: skip
    assert "overlap" in codes(lint([one, other], SCHEMAS))
    assert "overlap" not in codes(lint([one, moved], SCHEMAS))
    assert "overlap" not in codes(lint([one, rule(clauses, "one")], SCHEMAS))


def test_rules_of_one_name_and_rules_without_tests_are_named() -> None:
    clauses = "PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS n > 1)"
    findings = lint([rule(clauses, "one"), rule(clauses, "one")], SCHEMAS)
    assert codes(findings) == ["same-name", "no-tests", "no-tests"]
    assert [each.severity for each in findings] == ["error", "warning", "warning"]


def test_the_shipped_rules_have_no_findings_beside_each_other() -> None:
    assert [str(each) for each in lint(load_rules(FOLDER), SCHEMAS)] == []


@pytest.mark.parametrize(
    "skip,pattern,severity,said",
    [
        ("TO FIRST A", "A B", "error", "at every match A is the first row of the match"),
        ("TO A", "A B*", "error", "at every match A is the first row"),
        ("TO LAST A", "A+ B", "warning", "at some matches of PATTERN A is the first row"),
        (
            "TO FIRST A",
            "A? B",
            "error",
            "at every match A is the first row of the match, and the search would find it for ever",
        ),
        ("TO B", "A B?", "warning", "at some matches of PATTERN B is not in the match"),
        ("TO U", "(A B) | (C D)", "warning", "U is the first row"),
    ],
)
def test_a_skip_that_has_no_row_to_go_to(skip: str, pattern: str, severity: str, said: str) -> None:
    subset = "SUBSET U = (B, C)" if "U" in skip else ""
    define = "DEFINE A AS n > 1, B AS n > 2"
    clauses = f"AFTER MATCH SKIP {skip}\nPATTERN ({pattern}) WITHIN INTERVAL '1' SECOND {subset} {define})"
    (finding,) = [each for each in check(rule(clauses), SCHEMAS) if each.code == "skip-nowhere"]
    assert finding.severity == severity
    assert said in finding.message
    assert finding.place.line == 8


@pytest.mark.parametrize("skip,pattern", [("TO B", "A B"), ("TO LAST A", "A A+ B"), ("TO NEXT ROW", "A B?")])
def test_a_skip_that_always_goes_on_is_no_finding(skip: str, pattern: str) -> None:
    define = "DEFINE A AS n > 1, B AS n > 2"
    clauses = f"AFTER MATCH SKIP {skip}\nPATTERN ({pattern}) WITHIN INTERVAL '1' SECOND {define})"
    assert "skip-nowhere" not in found(clauses)


def test_a_measure_named_like_a_partition_column() -> None:
    clauses = "MEASURES A.n AS n,\nA.key + 1 AS KEY\nPATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS n > 1)"
    (finding,) = check(rule(clauses), SCHEMAS)
    assert (finding.code, finding.severity) == ("same-column", "warning")
    assert "the measure 'KEY' has the name of a partition column" in finding.message
    assert (finding.place.line, finding.place.column) == (9, 18)


def test_a_zone_in_pixels_that_is_a_speck_was_meant_in_shares_of_the_picture() -> None:
    text = rule("PATTERN (A) WITHIN INTERVAL '1' SECOND DEFINE A AS in_zone(n, v, 'hall') AND n > 1)")
    speck = text.with_zones({"hall": Zone(source="cam-01", units="pixels", polygon=((0.1, 0.2), (0.9, 0.2), (0.9, 1)))})
    assert codes(check(text, SCHEMAS)) == []
    (finding,) = check(speck, SCHEMAS)
    assert (finding.severity, finding.code, finding.place.line) == ("warning", "unit", 5)
    assert "zone 'hall' is smaller than 2 pixels. Next: leave `units: pixels` out" in finding.message
