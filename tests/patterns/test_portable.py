"""What Flink SQL cannot say: each refused construct at its place, and nothing else."""

import pytest

from patterns import RuleError, check, load_rules, parse_rule
from patterns.flink.portable import PORTABLE, refusals
from patterns.language.parser import parse
from tests.patterns.samples import SCHEMAS
from tests.patterns.test_shipped_rules import FOLDER

HEAD = """\
rule: sample
version: 1
title: sample
severity: info
profile: portable
shared: [yard]
lines: {door: {source: cam-01, points: [[0, 0], [1, 0]]}}
zones: {hall: {source: cam-01, polygon: [[0, 0], [1, 0], [1, 1]]}}
match: |
  SELECT * FROM track_point MATCH_RECOGNIZE (PARTITION BY track_id ORDER BY time
"""


def refused(clauses: str, head: str = HEAD) -> list[tuple[str, str]]:
    text = head + "".join(f"  {line}\n" for line in clauses.split("\n"))
    rule = parse_rule(text)
    found = []
    for each in refusals(rule, parse(rule.passage("match"))):
        line = text.split("\n")[each.place.line - 1]
        found.append((each.construct, line[each.place.column - 1 :][:7]))
    return found


@pytest.mark.parametrize(
    "clauses,wanted",
    [
        ("PATTERN (A (B C)+ D) DEFINE A AS x > 1)", [("quantified group", "+ D) DE")]),
        ("PATTERN (A (B | C) D) DEFINE A AS x > 1)", [("alternation", "B | C) ")]),
        ("PATTERN (A B+) DEFINE A AS x > 1)", [("greedy last variable", "+) DEFI")]),
        ("PATTERN (A B{2,3}) DEFINE A AS x > 1)", [("greedy last variable", "{2,3}) ")]),
        ("PATTERN (A B?? C) DEFINE A AS x > 1)", [("reluctant optional", "?? C) D")]),
        ("PATTERN (A*?) DEFINE A AS x > 1)", [("empty pattern", "PATTERN")]),
        ("PATTERN (A B{0,3} C) DEFINE A AS x > 1)", [("range from no row", "{0,3} C")]),
        ("PATTERN (A B A) DEFINE A AS x > 1)", [("variable twice", "A) DEFI")]),
        ("PATTERN (A) DEFINE A AS x > 1 AND NEXT(A.x) > 1)", [("NEXT", "NEXT(A.")]),
    ],
)
def test_what_is_not_portable_is_named_with_its_place(clauses: str, wanted: list[tuple[str, str]]) -> None:
    assert refused(clauses) == wanted
    assert not any(PORTABLE[construct].is_allowed for construct, _ in wanted)


@pytest.mark.parametrize(
    "clauses",
    [
        "PATTERN (A B{2} (C D) E*? F) WITHIN INTERVAL '1' SECOND DEFINE A AS x > 1, F AS F.x > LAST(E.x))",
        "PATTERN (A B+?) DEFINE A AS in_zone(x, y, 'hall'), B AS crosses(A.x, A.y, x, y, 'door', 'any'))",
        "MEASURES COUNT(*) AS n, FIRST(B.x) AS x\nPATTERN (A B* C) DEFINE A AS x IN (1, 2) OR x IS NULL)",
    ],
)
def test_what_flink_can_say_is_let_through(clauses: str) -> None:
    assert refused(clauses) == []


def test_a_rule_that_claims_to_be_portable_and_is_not_fails_its_check() -> None:
    rule = parse_rule(HEAD + "    PATTERN (A | B) DEFINE A AS x > 1)\n")
    errors = [each for each in check(rule, SCHEMAS) if each.severity == "error"]
    assert [str(each).split("\n")[0] for each in errors] == [
        "<rule>:11:14: error: portable: alternation: " + PORTABLE["alternation"].why + " [portable]"
    ]


def test_a_pattern_that_flink_has_but_takes_otherwise_fails_the_check_too() -> None:
    rule = parse_rule(HEAD + "    PATTERN (A B* C) DEFINE A AS x > 1)\n")
    errors = [each for each in check(rule, SCHEMAS) if each.severity == "error"]
    assert [str(each).split("\n")[0] for each in errors] == [
        "<rule>:11:16: error: portable: greedy variable with an open end: "
        + PORTABLE["greedy variable with an open end"].why + "; here it may fit B and C [rule]"
    ]  # fmt: skip


def test_the_shipped_rules_are_portable() -> None:
    found = {rule.rule: refusals(rule, parse(rule.passage("match"))) for rule in load_rules(FOLDER)}
    assert found == {"line-crossing": [], "loitering": [], "speeding": [], "zone-intrusion": []}


def test_a_reason_is_a_sentence_that_says_what_to_do() -> None:
    for name, construct in PORTABLE.items():
        assert construct.is_allowed or name in construct.why or "Flink" in construct.why or "portable" in construct.why
    with pytest.raises(RuleError):
        parse_rule(HEAD + "PATTERN")
