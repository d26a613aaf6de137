"""Every clause misspelt, every name unknown, every unsupported feature: line, column and caret in the file."""

import re
from pathlib import Path

import pytest

from patterns import NotInRules, RuleError, bind, check, parse_rule
from tests.patterns.samples import SCHEMAS

HEAD = """\
rule: sample
version: 1
title: sample
severity: info
params: {dwell: 10 s, word: abc}
zones: {yard: {source: cam-01, polygon: [[0, 0], [1, 0], [1, 1]]}}
lines: {door: {source: cam-01, points: [[0, 0], [1, 0]]}}
# a comment
match: |
"""
BEGINNING = "SELECT * FROM letter MATCH_RECOGNIZE (PARTITION BY key ORDER BY time\n"


def _cases() -> list[tuple[str, str]]:
    text = (Path(__file__).parent / "cases" / "errors.txt").read_text()
    parts = text.split("---\n")[1:]
    return [(part.split("\n> ")[0], part.split("\n> ")[1].strip()) for part in parts]


@pytest.mark.parametrize("sql,wanted", _cases(), ids=lambda value: re.sub(r"\s+", " ", value)[:70])
def test_what_is_wrong_is_named_with_its_place(sql: str, wanted: str) -> None:
    place, _, message = wanted.partition(" ")
    sql = sql.replace("{Q} ", BEGINNING)
    text = HEAD + "".join(f"  {line}\n" for line in sql.split("\n"))
    with pytest.raises(RuleError) as caught:
        bind(parse_rule(text, "sample.yaml"), SCHEMAS)
    error = caught.value
    assert message in error.message
    assert f"{error.line}:{error.column}" == place
    assert str(error).startswith(f"sample.yaml:{place}: ")
    shown, caret = error.excerpt.splitlines()
    assert shown.endswith(text.splitlines()[error.line - 1])
    assert len(caret) - 1 == shown.index("|") + 1 + error.column
    assert isinstance(error, NotInRules) == ("rules have no " in error.message)


def test_check_gives_the_same_error_as_a_finding() -> None:
    text = HEAD + f"  {BEGINNING}  PATTERN (A) DEFINE A AS nn > 1)\n"
    rule = parse_rule(text)
    (finding,) = check(rule, SCHEMAS)
    assert finding.severity == "error"
    assert (finding.place.line, finding.place.column) == (11, 27)
    assert "<rule>:11:27: error: DEFINE: unknown column 'nn'" in str(finding)


def test_check_warns_of_what_is_unused_or_unbounded() -> None:
    rule = parse_rule(HEAD.replace("severity: info", "severity: info\nprofile: portable")
                      + f"  {BEGINNING}  PATTERN (A B | C) DEFINE B AS n > PREV(n))\n")  # fmt: skip
    messages = [str(finding) for finding in check(rule, SCHEMAS)]
    assert [message.split(": ")[1] for message in messages] == ["warning"] * 6 + ["error"]
    for part in ("zone 'yard' is never used", "line 'door' is never used", "parameter 'dwell'", "parameter 'word'",
                 "without WITHIN", "as C has no condition",
                 "portable: alternation: Flink has no | in a pattern"):  # fmt: skip
        assert any(part in message for message in messages), part


@pytest.mark.parametrize("pattern", ["A*", "A? B*", "(A | B?)", "A{0,2}"])
def test_check_warns_of_a_pattern_that_can_match_nothing(pattern: str) -> None:
    rule = parse_rule(HEAD + f"  {BEGINNING}  PATTERN ({pattern}) WITHIN :dwell)\n")
    (finding,) = [each for each in check(rule, SCHEMAS) if "can match no row at all" in each.message]
    assert (finding.severity, finding.place.line) == ("warning", 11)


def test_check_does_not_warn_of_a_pattern_that_takes_a_row() -> None:
    rule = parse_rule(HEAD + f"  {BEGINNING}  PATTERN (A* B) WITHIN :dwell)\n")
    assert not any("no row at all" in each.message for each in check(rule, SCHEMAS))


def test_check_warns_of_keys_that_are_kept_for_good() -> None:
    text = HEAD.replace("severity: info", "severity: info\nemit: {once_per: [key]}")
    rule = parse_rule(text + f"  {BEGINNING}  PATTERN (A B) WITHIN :dwell)\n")
    (finding,) = [each for each in check(rule, SCHEMAS) if "every key" in each.message]
    assert (finding.place.line, finding.place.column) == (5, 18)


def test_check_warns_of_rows_that_are_kept_for_good() -> None:
    rule = parse_rule(HEAD + f"  {BEGINNING}  PATTERN (A B) WITHIN :dwell DEFINE A AS n > PREV(n))\n")
    assert any("a row of every partition is remembered" in finding.message for finding in check(rule, SCHEMAS))


def test_an_error_in_a_long_line_shows_the_part_around_it() -> None:
    text = HEAD + f"  {BEGINNING}  PATTERN (A B) DEFINE A AS {' AND '.join(['n > 1'] * 60)} AND nn > 1)\n"
    with pytest.raises(RuleError) as caught:
        bind(parse_rule(text), SCHEMAS)
    shown, caret = caught.value.excerpt.splitlines()
    assert len(shown) < 180
    assert shown[len(caret) - 1 :].startswith("nn > 1")


def test_check_warns_of_a_variable_without_define_that_looks_like_one_with_it() -> None:
    rule = parse_rule(HEAD + f"  {BEGINNING}  PATTERN (B BB BB) WITHIN :dwell DEFINE B AS n > 1)\n")
    (finding,) = [each for each in check(rule, SCHEMAS) if "DEFINE" in each.message]
    assert (finding.severity, finding.place.line, finding.place.column) == ("warning", 11, 14)
    assert finding.message.startswith("BB has no DEFINE: it is true for every row. Next: define it, or write B if")


@pytest.mark.parametrize("pattern", ["X B", "before B", "X* B+"])
def test_check_does_not_warn_of_a_variable_that_any_row_fits_by_intent(pattern: str) -> None:
    rule = parse_rule(HEAD + f"  {BEGINNING}  PATTERN ({pattern}) WITHIN :dwell DEFINE B AS n > 1)\n")
    assert not any("DEFINE" in each.message for each in check(rule, SCHEMAS))


def test_a_value_of_the_wrong_kind_is_shown() -> None:
    with pytest.raises(RuleError, match="version: Input should be a valid integer, got 'three'"):
        parse_rule(HEAD.replace("version: 1", "version: three"))


@pytest.mark.parametrize(
    "condition,place,message",
    [
        ("(" * 40 + "n > 1" + ")" * 40, "11:57", "at most 30 parentheses in each other"),
        (" OR ".join(f"n = {number}" for number in range(200)), "11:27", "150 operators are the most in one chain"),
        ("NOT " * 400 + "n > 1", "11:27", "150 operators are the most in one chain"),
    ],
    ids=["parentheses", "chain", "prefixes"],
)
def test_an_expression_that_nests_too_deeply_is_refused(condition: str, place: str, message: str) -> None:
    text = HEAD + f"  {BEGINNING}  PATTERN (A) DEFINE A AS {condition})\n"
    with pytest.raises(RuleError) as caught:
        parse_rule(text, "sample.yaml")
    assert message in caught.value.message
    assert f"{caught.value.line}:{caught.value.column}" == place


def test_a_duration_with_an_unknown_unit_is_named_where_it_does_not_fit() -> None:
    text = HEAD.replace("10 s", "10 sek") + f"  {BEGINNING}  PATTERN (A B) DEFINE B AS B.time < A.time + :dwell)\n"
    with pytest.raises(RuleError, match=r"\+ does not take time and string; :dwell is the text '10 sek', where a dur"):
        bind(parse_rule(text, "sample.yaml"), SCHEMAS)


@pytest.mark.parametrize(
    "given,said", [("10", "the number 10"), ("2.5", "the number 2.5"), ("5 m/s", "a value in m/s")]
)
def test_a_parameter_that_is_no_duration_is_named_where_one_is_wanted(given: str, said: str) -> None:
    text = HEAD.replace("10 s", given) + f"  {BEGINNING}  PATTERN (A B) DEFINE B AS B.time < A.time + :dwell)\n"
    with pytest.raises(RuleError, match=f":dwell is {said}, where a duration is written as in 10 s"):
        bind(parse_rule(text, "sample.yaml"), SCHEMAS)
