"""Rule files: what they say, where they are wrong, and what their hash covers."""

from datetime import timedelta
from pathlib import Path

import pytest

from patterns import Line, Rule, RuleError, Zone, bind, load_rules, parse_rule
from tests.patterns.samples import SCHEMAS

GOOD = """\
rule: yard-dwell
version: 3
title: "track {subject} of {key}"
severity: warning
zones: {yard: {source: cam-07, polygon: [[0.10,0.55],[0.62,0.50],[0.66,0.95],[0.08,0.97]]}}
lines:
  door: {source: cam-07, units: pixels, points: [[0, 0], [10, 10]]}
params: {dwell: 10 s, share: 0.5, many: 3, name: abc, on_duty: true}
time: {lateness: 2 s, idle: 500 ms}
emit: {once_per: [key], cooldown: 1 h}
profile: portable
match: |
  SELECT * FROM letter MATCH_RECOGNIZE (
    PARTITION BY key ORDER BY time
    PATTERN (A B) WITHIN INTERVAL '1' MINUTE)
tests:
  - given: rows.csv
    expect: [{key: 1}]
"""


def _error(text: str) -> RuleError:
    with pytest.raises(RuleError) as caught:
        bind(parse_rule(text, "yard.yaml"), SCHEMAS)
    return caught.value


def test_a_rule_file_says_all_of_it() -> None:
    rule = parse_rule(GOOD)
    assert (rule.rule, rule.version, rule.severity, rule.profile) == ("yard-dwell", 3, "warning", "portable")
    assert rule.zones["yard"].polygon[1] == (0.62, 0.5)
    assert rule.lines["door"].units == "pixels"
    assert rule.params == {"dwell": timedelta(seconds=10), "share": 0.5, "many": 3, "name": "abc", "on_duty": True}
    assert (rule.time.lateness, rule.time.idle) == (timedelta(seconds=2), timedelta(milliseconds=500))
    assert (rule.emit.once_per, rule.emit.cooldown) == (("key",), timedelta(hours=1))
    assert rule.tests[0].expect == ({"key": 1},)


@pytest.mark.parametrize(
    "old,new,place,message",
    [
        ("severity: warning", "severity: severe", "4:11", "should be 'info', 'warning' or 'alarm', got 'severe'"),
        ("severity: warning", "severitty: warning", "4:1", "severitty: unknown key; there are: emit, lines, match"),
        ("severity: warning", "severitty: warning", "4:1", "did you mean 'severity'?"),
        ("severity: warning\n", "", "1:1", "severity: this key is missing"),
        ("version: 3", "version: three", "2:10", "version: Input should be a valid integer"),
        ("version: 3", "version: 0", "2:10", "version: Input should be greater than or equal to 1"),
        ("rule: yard-dwell", "rule: yard dwell", "1:7", "rule: a name is 1 to 64 of A-Z a-z 0-9 . _ - and"),
        ("lateness: 2 s", "lateness: 2 sec", "9:18", "time.lateness: a duration is a number and one of us, ms, s"),
        ("lateness: 2 s", "lateness: 2", "9:18", "time.lateness: wanted a duration with its unit, such as 10 s, got 2"),
        ("lateness: 2 s", "lateness: 0.0000001 s", "9:18", "whole number of microseconds"),
        ("idle: 500 ms", "idel: 500 ms", "9:23", "time.idel: unknown key; there are: idle, lateness"),
        ("idle: 500 ms", "idle: 9999999999999 d", "9:29", "a duration is at most"),
        ("[0.62,0.50]", "[0.62,1.50]", "5:15", "zones.yard: normalised coordinates lie in 0 to 1"),
        ("[0.62,0.50]", "[0.62,wide]", "5:60", "zones.yard.polygon.1.1: Input should be a valid number"),
        ("source: cam-07, polygon", "sauce: cam-07, polygon", "5:16", "zones.yard.sauce: unknown key; there are: poly"),
        ("door: {source: cam-07", "yard: {source: cam-07", "1:1", "'yard' names both a zone and a line"),
        ("params: {dwell: 10 s", "params: {dwell: []", "8:17", "params.dwell: a list has one value or more"),
        ("params: {dwell: 10 s", "params: {dwell: [[10]]", "8:17", "params.dwell: wanted a number"),
        ("params: {dwell: 10 s", "params: {dwell: {a: 1}", "8:17", "params.dwell: wanted a number, true or false"),
        ("params: {dwell: 10 s", "params: {dwell: .nan", "8:17", "params.dwell: wanted a number"),
        ("params: {dwell: 10 s", "params: {1: 10 s", "8:10", "params.1: wanted a text, got 1"),
        ("params: {dwell: 10 s", "params: {a-b: 10 s", "8:10", "params.a-b: a name here is a letter or _, then"),
        ("[10, 10]]}", "[10, 10], [3, 3]]}", "7:49", "lines.door.points: wanted 2 values, got 3"),
        ("once_per: [key]", "once_per: [kay]", "10:18", "once_per: 'kay' is neither a partition column nor a measure"),
        ("{subject}", "{subjekt}", "3:9", "title: unknown name {subjekt}; there are: flag"),
        ("{subject}", "{subjekt}", "3:9", "; did you mean 'subject'?"),
        ("FROM letter", "FROM lettre", "13:17", "unknown event type 'lettre'; there are: letter, track_point; did"),
        ("BY key", "BY kay", "14:18", "PARTITION BY: unknown column 'kay'; there are: "),
        ("BY key", "BY kay", "14:18", "; did you mean 'key'?"),
        ("{subject}", "{subject", "3:9", "title:"),
        ("{subject}", "{subject:>9999999999}", "3:9", "title: a width or precision has at most 3 digits"),
        ("{subject}", "{subject.upper}", "3:9", "title: wanted {name} or {name:format}, got {subject.upper}"),
        ("{subject}", "{subject!r}", "3:9", "title: wanted {name} or {name:format}"),
        ("{subject}", "{subject:.2f}", "3:9", "title: Unknown format code 'f'"),
        ("{subject}", "{n:c}", "3:9", "title: %c arg not in range"),
        ("version: 3", "version: 3\nversion: 4", "3:1", "the key 'version' stands twice"),
        ("version: 3", "version: [3", "3:6", "not YAML"),
        ("version: 3", "version: 3: 4", "2:11", "or has a colon in it, in quotes"),
        ("version: 3", "version: {n} m", "2:14", "put a text that begins with {"),
        ("version: 3", "version: !!python/none 3", "2:10", "not a YAML value"),
        ("version: 3", "version: 2026-99-99", "1:1", "not a YAML value"),
        ("version: 3", "version: \x01", "2:1", "not YAML: special characters are not allowed"),
        ("match: |", "match: >", "12:8", "wanted"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_place(old: str, new: str, place: str, message: str) -> None:
    assert old in GOOD
    text = GOOD.replace(old, new, 1)
    if new == "match: >":
        text = text.replace("PATTERN (A B)", "PATERN (A B)")
    error = _error(text)
    assert message in error.message
    assert f"{error.line}:{error.column}" == place
    assert error.file == "yard.yaml"


def test_a_quoted_text_that_is_not_closed() -> None:
    error = _error('rule: sample\nversion: "1\ntitle: one\n')
    assert (error.line, error.column) == (2, 10)
    assert error.message == "not YAML: this quoted text is not closed"


@pytest.mark.parametrize("text", ["", "# nothing\n", "- a\n- b\n", "rule\n"])
def test_a_file_that_is_no_mapping(text: str) -> None:
    assert "a rule file is a mapping" in _error(text).message


@pytest.mark.parametrize(
    "match,place",
    [
        ("match: SELECT * FROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))", "6:22"),
        ('match: "SELECT * FROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))"', "6:23"),
        ("match: |2\n  SELECT * FROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))", "7:17"),
        ("match: |\n\n    SELECT *\n    FROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))", "9:10"),
        ('match: "SELECT *\\nFROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))"', "6:8"),
        ("match: >\n  SELECT *\n  FROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))", "6:8"),
    ],
)
def test_sql_in_any_form_of_yaml_text_is_pointed_at(match: str, place: str) -> None:
    text = f"rule: a\nversion: 1\ntitle: t\nseverity: info\n# here\n{match}\n"
    error = _error(text)
    assert "unknown event type 'lettre'" in error.message
    assert f"{error.line}:{error.column}" == place


def test_a_folder_of_rules_is_read_by_name_and_names_must_differ(tmp_path: Path) -> None:
    other = GOOD.replace("yard-dwell", "other")
    (tmp_path / "b.yaml").write_text(GOOD)
    (tmp_path / "a.yml").write_text(other)
    (tmp_path / "rows.csv").write_text("time\n")
    assert [rule.rule for rule in load_rules(tmp_path)] == ["other", "yard-dwell"]
    assert [rule.rule for rule in load_rules(tmp_path / "b.yaml")] == ["yard-dwell"]
    (tmp_path / "c.yaml").write_text(GOOD)
    with pytest.raises(RuleError, match=r"c\.yaml:1:7: rule 'yard-dwell' is also defined in .*b\.yaml"):
        load_rules(tmp_path)


def test_files_that_are_not_text_or_too_large(tmp_path: Path) -> None:
    file = tmp_path / "a.yaml"
    file.write_bytes(b"rule: a\nversion: \xff\n")
    with pytest.raises(RuleError, match=r"a\.yaml:2:10: a rule file is UTF-8"):
        load_rules(file)
    file.write_bytes(b"#" * 1_000_001)
    with pytest.raises(RuleError, match="at most 1000000 bytes"):
        load_rules(file)
    with pytest.raises(FileNotFoundError):
        load_rules(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "old,new",
    [
        ("version: 3", "version: 4"), ("{subject}", "{sequence}"), ("severity: warning", "severity: alarm"),
        ("0.62", "0.61"), ("[10, 10]", "[10, 11]"), ("dwell: 10 s", "dwell: 11 s"), ("lateness: 2 s", "lateness: 3 s"),
        ("cooldown: 1 h", "cooldown: 2 h"), ("'1' MINUTE", "'2' MINUTE"), ("dwell: 10 s", "dwell: 10.5"),
    ],
)  # fmt: skip
def test_the_hash_changes_with_the_meaning(old: str, new: str) -> None:
    assert parse_rule(GOOD.replace(old, new, 1)).hash != parse_rule(GOOD).hash


@pytest.mark.parametrize(
    "old,new",
    [
        ("PATTERN (A B)", "-- a remark\n      PATTERN   (A\n      B)"), ("lateness: 2 s", "lateness: 2000 ms"),
        ("expect: [{key: 1}]", "expect: []"), ("profile: portable", "profile: full"), ("rule: ", "# remark\nrule: "),
        ("points: [[0, 0]", "points: [[0.0, 0]"),
    ],
)  # fmt: skip
def test_the_hash_stays_with_the_meaning(old: str, new: str) -> None:
    assert old in GOOD
    assert parse_rule(GOOD.replace(old, new, 1)).hash == parse_rule(GOOD).hash


def test_the_hash_is_a_published_layout() -> None:
    assert parse_rule(GOOD).hash == "da73a8cd1a0b3543d688adf273627bc2e56024b86b73ca953b5aa4f51c44ec9d"


def test_zones_lines_and_params_can_be_replaced_by_name() -> None:
    rule = parse_rule(GOOD)
    zone = Zone(source="gate", polygon=((0, 0), (1, 0), (1, 1)))
    line = Line(source="gate", points=((0, 0), (1, 1)))
    changed = rule.with_zones({"yard": zone}).with_lines({"door": line}).with_params({"dwell": "3 s"})
    assert (changed.zones["yard"], changed.lines["door"]) == (zone, line)
    assert changed.params["dwell"] == timedelta(seconds=3)
    assert changed.params["many"] == 3
    assert changed.hash != rule.hash
    assert rule.zones["yard"].source == "cam-07"
    rule = rule.loaded_from(Path("rules/yard.yaml"), {})
    assert (rule.path, rule.folder) == (Path("rules/yard.yaml"), Path("rules"))
    assert (rule.with_zones({"yard": zone}).path, rule.with_zones({"yard": zone}).folder) == (None, Path("rules"))
    assert rule.with_zones({}).path == rule.path
    for change in (rule.with_zones, rule.with_lines, rule.with_params):
        with pytest.raises(ValueError, match=r"has no \w+ 'garden'; it has: "):
            change({"garden": zone})  # type: ignore[operator]


def test_a_rule_made_in_a_program_points_into_its_own_sql() -> None:
    rule = Rule(rule="a", version=1, title="t", severity="info",
                match="SELECT *\nFROM lettre MATCH_RECOGNIZE (ORDER BY time PATTERN (A))")  # fmt: skip
    with pytest.raises(RuleError) as caught:
        bind(rule, SCHEMAS)
    assert (caught.value.file, caught.value.line, caught.value.column) == ("<a>", 2, 6)
    assert rule.path is None
    with pytest.raises(RuleError, match="<a>:1:1: once_per"):
        raise rule.error("once_per", "version")


# A billion values in a few lines, if aliases were followed.
_BOMB = "a0: &a0 [x, x]\n" + "".join(f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]\n" for n in range(1, 10))


@pytest.mark.parametrize(
    "text,message",
    [
        (GOOD.replace("params:", "? [a, b]\n: c\nparams:"), "a key must be a word, got a list or a mapping"),
        (GOOD + "more: " + "[" * 3000 + "]" * 3000, "nests at most 20 lists and mappings"),
        (GOOD + "more: " + "[" * 40 + "]" * 40, "nests at most 20 lists and mappings"),
        (GOOD + "more: &x [*x]\n", "nests at most 20 lists and mappings"),
        (GOOD + _BOMB, "aliases (*name) make more values of this file than it has characters"),
        (GOOD + "more: !!python/object/apply:os.system ['true']\n", "could not determine a constructor for the tag"),
        (GOOD.replace("version: 3", f"version: {2**40}"), "less than or equal to 2147483647"),
    ],
)
def test_yaml_that_no_rule_needs_is_refused(text: str, message: str) -> None:
    assert message in _error(text).message
