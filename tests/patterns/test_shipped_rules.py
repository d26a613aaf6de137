"""The rules that are shipped, and how a rule's own tests run."""

from pathlib import Path

import pytest

import patterns
from patterns import RuleError, check, load_rule, load_rules, parse_rule, run_tests
from tests.patterns.samples import SCHEMAS

FOLDER = Path(patterns.__file__).parent / "rules"
NAMES = ["line-crossing", "loitering", "speeding", "zone-intrusion"]


def test_those_of_the_demo_are_there() -> None:
    assert [rule.rule for rule in load_rules(FOLDER)] == NAMES


@pytest.mark.parametrize("name", NAMES)
def test_a_shipped_rule_passes_its_own_tests_and_has_no_findings(name: str) -> None:
    rule = load_rule(FOLDER / f"{name}.yaml")
    assert check(rule, SCHEMAS) == []
    results = run_tests(rule, SCHEMAS)
    assert results
    assert [(result.name, result.difference) for result in results if not result.passed] == []


RULE = """\
rule: sample
version: 1
title: "{letter}"
severity: info
match: |
  SELECT * FROM letter MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time
    MEASURES A.n AS n, A.v AS v, A.time AS at, A.gap AS gap, A.flag AS flag
    PATTERN (A) DEFINE A AS letter = 'a')
tests:
"""


AT = "{time: 2026-01-01T10:00:00Z"


def _results(tests: str) -> list[tuple[bool, str]]:
    return [(result.passed, result.difference) for result in run_tests(parse_rule(RULE + tests), SCHEMAS)]


DIFFERENCE = """\
  n: 1
- n: 5, title: a
+ n: 2, title: a
? ^^^^
+ n: 3, v: None, at: 2026-01-01T10:00:02Z, gap: 3 s, flag: None"""


def test_a_difference_shows_wanted_and_found_side_by_side() -> None:
    tests = """\
  - given:
      - {time: 2026-01-01T10:00:00Z, letter: a, n: 1}
      - {time: 2026-01-01T10:00:01Z, letter: a, n: 2}
      - {time: 2026-01-01T10:00:02Z, letter: a, n: 3, gap: 3 s}
    expect: [{n: 1}, {n: 5, title: a}]
  - given: [{time: 2026-01-01T10:00:00Z, letter: b}]
    expect: [{n: 1, at: 2026-01-01T10:00:00Z, gap: 10 s}, {}]
  - given: [{time: 2026-01-01T10:00:00Z, letter: a, n: 1}]
    expect: [{m: 1}]
  - given: [{time: 2026-01-01T10:00:00Z, letter: a, n: 7}]
    expect: []
"""
    assert _results(tests) == [
        (False, DIFFERENCE),
        (False, "- n: 1, at: 2026-01-01T10:00:00Z, gap: 10 s\n- (a situation)\n+ (no situation)"),
        (False, "- m: 1\n+ m: (no such value)"),
        (False, "- (no situation)\n+ n: 7, v: None, at: 2026-01-01T10:00:00Z, gap: None, flag: None"),
    ]  # fmt: skip


def test_values_are_compared_by_what_they_mean() -> None:
    tests = """\
  - name: all of it
    given: [{time: "2026-01-01T11:00:00+01:00", letter: a, n: 1, v: 0.1, gap: 2 min, flag: true}]
    expect: [{n: 1, v: 0.1, at: 2026-01-01T10:00:00Z, gap: 120 s, flag: true, key: null}]
  - given: [{time: 2026-01-01T10:00:00, letter: a, v: 1}]
    expect: [{v: 1, at: "2026-01-01T10:00:00", gap: null}]
"""
    assert _results(tests) == [(True, ""), (True, "")]


def test_rows_from_a_csv_file_beside_the_rule(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("time,letter,n,v,flag,gap\n2026-01-01T10:00:00Z,a,4,,true,3 s\n")
    file = tmp_path / "sample.yaml"
    file.write_text(RULE + "  - {given: rows.csv, expect: [{n: 4, v: null, flag: true, gap: 3 s}]}\n")
    (result,) = run_tests(load_rule(file), SCHEMAS)
    assert (result.rule, result.name, result.passed, result.difference) == ("sample", "rows.csv", True, "")


@pytest.mark.parametrize(
    "rows,place,message",
    [
        ("time,letter,m\n2026-01-01T10:00:00Z,a,\n", "1:13", "row 1: unknown column 'm'; there are: blob, flag"),
        (
            "time,letter,n\n2026-01-01T10:00:00Z,a,1\n2026-01-01T10:00:00Z,a,x\n",
            "3:24",
            "row 2, column n: wanted a whole",
        ),
        ("time,letter,n\n,a,1\n", "2:1", "row 1: it has no `time`"),
        ("time,letter,n\n2026-01-01T10:00:00Z,a,1,2\n", "2:26", "row 1: 4 cells, and the header names 3 columns"),
        ("time,letter,letter\n2026-01-01T10:00:00Z,a,b\n", "1:13", "the column 'letter' stands twice"),
        ('time,letter,n\n2026-01-01T10:00:00Z,"a,b",x\n', "2:1", "row 1, column n: wanted a whole number, got 'x'"),
    ],
)
def test_what_is_wrong_in_a_csv_file_is_named_with_its_place_there(
    rows: str, place: str, message: str, tmp_path: Path
) -> None:
    (tmp_path / "rows.csv").write_text(rows)
    file = tmp_path / "sample.yaml"
    file.write_text(RULE + "  - {given: rows.csv, expect: []}\n")
    with pytest.raises(RuleError) as caught:
        run_tests(load_rule(file), SCHEMAS)
    assert message in caught.value.message
    assert caught.value.file == str(tmp_path / "rows.csv")
    assert f"{caught.value.line}:{caught.value.column}" == place


def test_an_empty_csv_file_is_named_where_the_test_says_it(tmp_path: Path) -> None:
    (tmp_path / "rows.csv").write_text("")
    file = tmp_path / "sample.yaml"
    file.write_text(RULE + "  - {given: rows.csv, expect: []}\n")
    with pytest.raises(RuleError, match=r"sample.yaml:11:13: .*rows.csv is empty; its first line names the columns"):
        run_tests(load_rule(file), SCHEMAS)


def test_rows_may_give_columns_that_the_rule_does_not_read() -> None:
    tests = f"  - {{given: [{AT}, letter: a, n: 1, subject: someone, sequence: 5}}], expect: [{{n: 1}}]}}\n"
    assert _results(tests) == [(True, "")]


@pytest.mark.parametrize(
    "tests,place,message",
    [
        ("  - {given: none.csv, expect: []}\n", "11:13", "cannot read none.csv"),
        ("  - {given: [{time: noon, letter: a}], expect: []}\n", "11:21", "row 1, column time: wanted a time such as"),
        (f"  - {{given: [{AT}}}, {{letter: a}}], expect: []}}\n", "11:44", "row 2: it has no `time`. Next: add one"),
        (
            f"  - {{given: [{AT}, ltter: a}}], expect: []}}\n",
            "11:43",
            "row 1: unknown column 'ltter'; there are: blob, flag",
        ),
        (f"  - {{given: [{AT}, ltter: a}}], expect: []}}\n", "11:43", "did you mean 'letter'?"),
        (f"  - {{given: [{AT}, flag: maybe}}], expect: []}}\n", "11:49", "wanted true or false, got 'maybe'"),
        (f"  - {{given: [{AT}, flag: 1}}], expect: []}}\n", "11:49", "column flag: wanted true or false, got 1"),
        (
            f"  - {{given: [{AT}, n: many}}], expect: []}}\n",
            "11:46",
            "row 1, column n: wanted a whole number, got 'many'",
        ),
        (f"  - {{given: [{AT}, n: 1.5}}], expect: []}}\n", "11:46", "column n: wanted a whole number, got 1.5"),
        (f"  - {{given: [{AT}, v: true}}], expect: []}}\n", "11:46", "column v: wanted a number, got True"),
        (
            f"  - {{given: [{AT}, gap: 3}}], expect: []}}\n",
            "11:48",
            "column gap: wanted a duration such as 10 s, got 3",
        ),
    ],
)
def test_rows_that_cannot_be_read_are_named_with_their_place(tests: str, place: str, message: str) -> None:
    with pytest.raises(RuleError) as caught:
        run_tests(parse_rule(RULE + tests), SCHEMAS)
    assert message in caught.value.message
    assert f"{caught.value.line}:{caught.value.column}" == place


def test_a_test_whose_rows_the_rule_cannot_take_fails_with_the_reason() -> None:
    text = (FOLDER / "loitering.yaml").read_text().replace("    frames: {cam-01: [1000, 1000]}\n", "")
    rule = parse_rule(text, path=FOLDER / "loitering.yaml")
    (result,) = run_tests(rule, SCHEMAS)
    assert not result.passed
    said = "'watched' is in normalised coordinates of source 'cam-01', whose frame size the test does not give. "
    assert said + "Next: add it to the test's `frames:`, as in `frames: {cam-01: [1920, 1080]}`" in result.difference
    line = text.splitlines()[result.place.line - 1]
    assert line[result.place.column - 1 :].startswith("name: ")


def test_a_test_without_the_calibration_that_the_rule_asks_for_fails_with_the_reason() -> None:
    text = (FOLDER.parent / "templates" / "cases" / "speeding.yaml").read_text()
    lines = [line for line in text.splitlines(keepends=True) if "calibrations:" not in line]
    known = {"track_point": SCHEMAS["track_point"]}
    (first, _) = run_tests(parse_rule("".join(lines)), known)
    assert "! the rule asks for metres of source 'cam-01', whose calibration the test does not give" in first.difference
