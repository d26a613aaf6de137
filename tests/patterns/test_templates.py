"""Templates: each finds what its case file says, expands to a rule that is the same, and is documented."""

from pathlib import Path

import pytest

from events import load_catalogue
from patterns import RuleError, bind, check, load_rule, parse_rule, run_tests
from patterns.files.expanding import expand
from patterns.files.reference import reference
from patterns.files.template import FOLDER, Template, new_rule, templates
from patterns.processor import schemas

SCHEMAS = schemas(load_catalogue())
each_template = pytest.mark.parametrize("template", templates().values(), ids=lambda each: each.template)


@each_template
def test_a_template_finds_what_its_case_file_says(template: Template) -> None:
    rule = load_rule(template.case_file)
    results = run_tests(rule, SCHEMAS)
    assert [(result.name, result.difference) for result in results if not result.passed] == []
    assert len(results) >= 2
    assert any(case.expect for case in rule.tests)


@each_template
def test_a_rule_of_a_template_has_no_findings(template: Template) -> None:
    findings = check(load_rule(template.case_file), SCHEMAS)
    assert [str(each) for each in findings] == []


@each_template
def test_the_expanded_rule_is_the_same_rule(template: Template) -> None:
    rule = load_rule(template.case_file)
    text = expand(rule)
    again = parse_rule(text, path=template.case_file)
    assert again.hash == rule.hash
    assert again.template is None
    assert again.tests == rule.tests
    assert "<<" not in text
    assert expand(again) == text[text.index("\nrule: ") + 1 :]


@each_template
def test_a_new_rule_of_a_template_passes_its_tests(template: Template) -> None:
    rule = parse_rule(new_rule(template, "mine"), path=template.case_file)
    assert rule.rule == "mine"
    assert all(result.passed for result in run_tests(rule, SCHEMAS))


def test_every_template_and_case_file_is_named_like_its_file() -> None:
    assert [f"{name}.yaml" for name in templates()] == sorted(path.name for path in FOLDER.glob("*.yaml"))
    assert sorted(path.name for path in (FOLDER / "cases").glob("*.yaml")) == [f"{name}.yaml" for name in templates()]


GOOD = """\
rule: mine
version: 1
template: loitering
with: {zone: yard, min_duration: 30 s}
shared: [yard]
zones: {hall: {source: cam-01, polygon: [[0, 0], [1, 0], [1, 1]]}}
"""


@pytest.mark.parametrize(
    "old,new,place,message",
    [
        (
            "loitering",
            "loitring",
            "3:11",
            "template: unknown template 'loitring'; there are: a-then-b, abandoned-object",
        ),
        ("loitering", "loitring", "3:11", "did you mean 'loitering'?"),
        ("loitering", "[a]", "3:11", "template: unknown template ['a']"),
        (
            "zone: yard",
            "zome: yard",
            "4:8",
            "has no parameter 'zome'; it has: zone, min_duration; did you mean 'zone'?",
        ),
        ("zone: yard, ", "", "4:7", "the parameter 'zone' of template loitering is missing; wanted the name of a zone"),
        ("zone: yard", "zone: yrad", "4:14", "unknown zone 'yrad'; the rule has: hall, yard; did you mean 'yard'?"),
        ("zone: yard", "zone: gate", "4:14", "draw it under `zones:`, or name it in `shared: [gate]`"),
        (
            "zone: yard",
            "zone: 7",
            "4:14",
            "with.zone: wanted the name of a zone of this rule, or of a shared one, got 7",
        ),
        ("30 s}", "30 kg}", "4:34", "with.min_duration: wanted a duration such as 30 s, got '30 kg'"),
        ("30 s}", "30}", "4:34", "with.min_duration: wanted a duration such as 30 s, got 30"),
        ("30 s}", "30 km/h}", "4:34", "with.min_duration: wanted a duration such as 30 s, got '30 km/h'"),
        ("30 s}", "0 s}", "4:34", "wanted a duration such as 30 s, got '0 s'"),
        ("with: {zone: yard, min_duration: 30 s}", "with: yard", "4:7", "with: wanted parameters by name, got 'yard'"),
        (
            "shared: [yard]",
            "shared: [yard]\nmatch: SELECT",
            "6:1",
            "match: this rule has a template: it brings the SQL",
        ),
        (
            "shared: [yard]",
            "shared: [yard]\nparams: {a: 1}",
            "6:1",
            "params: this rule has a template: its parameters go",
        ),
        ("template: loitering\n", "", "3:1", "with: it gives a template its parameters, and this rule names none"),
        ("shared: [yard]", "shared: [yard, hall]", "1:1", "'hall' is shared, and also drawn in the rule itself"),
        ("version: 1", "version: 1\nmatsch: a", "3:1", "matsch: unknown key; there are: emit, lines, match, params"),
    ],
)
def test_what_is_wrong_is_named_with_its_place(old: str, new: str, place: str, message: str) -> None:
    assert old in GOOD
    with pytest.raises(RuleError) as caught:
        parse_rule(GOOD.replace(old, new, 1), "mine.yaml")
    assert message in caught.value.message
    assert f"{caught.value.line}:{caught.value.column}" == place
    assert caught.value.file == "mine.yaml"


@pytest.mark.parametrize(
    "template,given,message",
    [
        ("speeding", "zone: yard, limit: 50", "with.limit: wanted a speed on the ground such as 50 km/h, got 50"),
        ("speeding", "zone: yard, limit: -50 km/h", "wanted a speed on the ground such as 50 km/h, got '-50 km/h'"),
        (
            "speeding",
            "zone: yard, limit: 50 px/s",
            "with.limit: wanted a speed on the ground such as 50 km/h, got '50 px/s'",
        ),
        (
            "stopped-vehicle",
            "zone: yard, max_speed: 5 m/s",
            "wanted a speed in the picture such as 15 px/s, got '5 m/s'",
        ),
        (
            "tailgating",
            "max_distance: 5 m",
            "with.max_distance: wanted a length in the picture such as 80 px, got '5 m'",
        ),
        ("speeding", "zone: yard, limit: 9 m/s, points: 0", "with.points: wanted a whole number of 1 or more, got 0"),
        (
            "wrong-way",
            "zone: yard, forbidden: north",
            "with.forbidden: wanted one of up, down, left, right, got 'north'",
        ),
        ("camera-moved", "min_share: 1.5", "with.min_share: wanted a number from 0 to 1, got 1.5"),
        ("tailgating", "same_way: high", "with.same_way: wanted a number, got 'high'"),
        ("a-then-b", "source_a: 7, source_b: x", "with.source_a: wanted the name of a source, got 7"),
        ("watch-list", "plates: []", "with.plates: wanted a list of texts, or {file: NAME}, got []"),
        (
            "watch-list",
            "plates: {file: a, b: c}",
            "with.plates: wanted a list of texts, or {file: NAME}, got {b: c, file: a}",
        ),
    ],
)
def test_a_value_of_another_kind_is_refused(template: str, given: str, message: str) -> None:
    text = GOOD.replace("loitering", template).replace("zone: yard, min_duration: 30 s", given)
    with pytest.raises(RuleError) as caught:
        parse_rule(text)
    assert message in caught.value.message


def test_lists_may_stand_in_a_file_beside_the_rule(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("# wanted\n1AB2345\n\n2CD6789\n1AB2345\n")
    file = tmp_path / "mine.yaml"
    file.write_text("rule: mine\nversion: 1\ntemplate: watch-list\nwith: {plates: {file: list.txt}}\n")
    rule = load_rule(file)
    assert rule.params["plates"] == ("1AB2345", "2CD6789")
    assert not rule.is_whole
    assert parse_rule(expand(rule)).hash == rule.hash
    file.write_text(expand(rule).replace("[1AB2345, 2CD6789]", "{file: list.txt}"))
    plain = load_rule(file)
    assert plain.hash == rule.hash
    assert not plain.is_whole


@pytest.mark.parametrize(
    "content,message", [(None, "cannot be read"), (b"\xff", "a list is UTF-8 text"), (b"# no\n", "got 0")]
)
def test_a_list_that_cannot_be_read_is_named(tmp_path: Path, content: bytes | None, message: str) -> None:
    if content is not None:
        (tmp_path / "list.txt").write_bytes(content)
    file = tmp_path / "mine.yaml"
    file.write_text("rule: mine\nversion: 1\ntemplate: watch-list\nwith: {plates: {file: list.txt}}\n")
    with pytest.raises(RuleError, match=message) as caught:
        load_rule(file)
    assert (caught.value.line, caught.value.column) == (4, 16)


def test_a_list_in_a_file_needs_a_rule_file() -> None:
    with pytest.raises(RuleError, match="a rule that is no file itself has no files beside it"):
        parse_rule("rule: mine\nversion: 1\ntemplate: watch-list\nwith: {plates: {file: list.txt}}\n")


def test_an_error_in_the_filled_in_sql_names_the_template() -> None:
    text = GOOD.replace("shared: [yard]", "shared: [yard]\ntitle: '{nobody}'")
    with pytest.raises(RuleError, match=r"mine\.yaml:6:9: title: unknown name \{nobody\}"):
        bind(parse_rule(text, "mine.yaml"), SCHEMAS)


def test_the_reference_is_up_to_date() -> None:
    page = Path(__file__).parents[2] / "docs" / "reference" / "templates.md"
    wanted = reference(templates().values())
    assert page.read_text() == wanted, "Next: python -m patterns.files.reference > docs/reference/templates.md"
