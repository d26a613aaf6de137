"""Templates: patterns with parameters, for rules that are written without SQL.

A template is one YAML file in `patterns/templates/`: what it finds, its parameters, and the SQL. A
rule says `template: NAME` and `with: {parameter: value}` in place of `match`; when it is loaded, the
SQL is filled in and the rule is the one that a person would have written. What can stand as a
parameter in SQL becomes one of the rule's `params`; names of zones and lines, directions and
numbers in PATTERN are written into the SQL.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import timedelta
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from jinja2 import Environment, StrictUndefined, meta
from pydantic import BaseModel, ConfigDict, Field

from patterns.durations import is_duration, parse_duration
from patterns.language.text import Document, Passage, did_you_mean
from patterns.scene.quantities import is_quantity, parse_quantity

FOLDER = Path(__file__).parent.parent / "templates"
"""Where the templates are; their case files are in `cases/` below it."""

KeyPath = tuple[str, ...]
ParameterKind = Literal[
    "zone", "line", "source", "text", "texts", "choice", "duration", "count", "number", "share", "length", "speed",
    "pixels", "pixel speed",
]  # fmt: skip

_WANTED: dict[str, str] = {
    "zone": "the name of a zone of this rule, or of a shared one",
    "line": "the name of a line of this rule, or of a shared one",
    "source": "the name of a source",
    "text": "a text",
    "texts": "a list of texts, or {file: NAME}",
    "duration": "a duration such as 30 s",
    "count": "a whole number of 1 or more",
    "number": "a number",
    "share": "a number from 0 to 1",
    "length": "a length on the ground such as 2.5 m",
    "speed": "a speed on the ground such as 50 km/h",
    "pixels": "a length in the picture such as 80 px",
    "pixel speed": "a speed in the picture such as 15 px/s",
}
_BASE_UNITS = {"length": "m", "speed": "m/s", "pixels": "px", "pixel speed": "px/s"}


class _Frozen(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid")


class Parameter(_Frozen):
    """One parameter of a template.

    Attributes:
        kind: What its values are.
        about: What it is for, in a clause.
        default: Its value when none is given; None: it must be given, or is left out where it is optional.
        optional: Whether the template does without it.
        choices: The values that a choice has.
    """

    kind: ParameterKind
    about: str
    default: Any = None
    optional: bool = False
    choices: tuple[str, ...] = ()


class Template(_Frozen):
    """One template.

    Attributes:
        template: Its name.
        version: Counts its changes.
        title: What it finds, in a clause.
        onvif: The name that the ONVIF Analytics Service Specification has for it; None: none.
        about: What it does and does not find, for people.
        needs: What must emit the events that it reads, where an extractor alone does not.
        parameters: By name.
        rule: The keys of a rule that it sets where the rule does not: title, severity, time, emit.
        match: The SQL, with placeholders.
    """

    template: str
    version: Annotated[int, Field(ge=1)]
    title: str
    onvif: str | None = None
    about: str
    needs: str | None = None
    parameters: Mapping[str, Parameter]
    rule: Mapping[str, Any]
    match: str

    @property
    def written_in(self) -> frozenset[str]:
        """The parameters that are written into the SQL; the others become `params` of the rule."""
        return frozenset(meta.find_undeclared_variables(_environment().parse(self.match)))

    @property
    def case_file(self) -> Path:
        """A rule that uses the template, with tests that show what it finds and what it does not."""
        return FOLDER / "cases" / f"{self.template}.yaml"


@dataclass(frozen=True, slots=True)
class Expansion:
    """What a template and the given values come to.

    Attributes:
        match: The SQL.
        params: The rule's parameters.
        defaults: What the template says of other keys of the rule.
    """

    match: str
    params: Mapping[str, Any]
    defaults: Mapping[str, Any]


@cache
def templates() -> Mapping[str, Template]:
    """All templates by name, in the order of their names."""
    files = sorted(FOLDER.glob("*.yaml"))
    found = [Template.model_validate(yaml.safe_load(file.read_text(encoding="utf-8"))) for file in files]
    return {template.template: template for template in found}


def filled_in(values: Mapping[str, Any], passages: dict[KeyPath, Passage]) -> Mapping[str, Any]:
    """A rule file's values with its template filled in; as they are, if it has none. Notes where the SQL stands.

    Raises:
        RuleError: No such template, or a parameter that it does not have, lacks, or that is of the wrong kind.
    """
    if "template" not in values:
        if "with" in values:
            message = "with: it gives a template its parameters, and this rule names none. Next: add `template: NAME`"
            raise passages["with", "[key]"].error(message, 0)
        return values
    place = passages["template",]
    name = values["template"]
    if not isinstance(name, str) or name not in templates():
        have = ", ".join(templates())
        raise place.error(f"template: unknown template {name!r}; there are: {have}{_like(name, templates())}", 0)
    for key in ("match", "params"):
        if key in values:
            instead = "its parameters go in `with`" if key == "params" else "it brings the SQL; leave one of them out"
            raise passages[key, "[key]"].error(f"{key}: this rule has a template: {instead}", 0)
    template = templates()[name]
    expansion = expanded(template, values, passages)
    document = Document(f"{place.document.name} (template {name})", expansion.match)
    passages["match",] = Passage.alone(expansion.match, document.name)
    for parameter in template.parameters:
        passages["params", parameter] = passages.get(("with", parameter), place)
    params = {"params": dict(expansion.params)} if expansion.params else {}
    return {**expansion.defaults, **values, **params, "match": expansion.match}


def expanded(template: Template, values: Mapping[str, Any], passages: Mapping[KeyPath, Passage]) -> Expansion:
    """What the template comes to with the values that the rule file gives it.

    Raises:
        RuleError: A parameter that it does not have, lacks, or that is of the wrong kind.
    """
    given = values.get("with") or {}
    if not isinstance(given, Mapping):
        raise passages["with",].error(f"with: wanted parameters by name, got {given!r}", 0)
    for name in given:
        if name not in template.parameters:
            have = ", ".join(template.parameters)
            like = _like(name, template.parameters)
            message = f"with: template {template.template} has no parameter {name!r}; it has: {have}{like}"
            raise passages["with", str(name), "[key]"].error(message, 0)
    known = _places(values)
    settled: dict[str, Any] = {}
    for name, parameter in template.parameters.items():
        if name not in given and parameter.default is None and not parameter.optional:
            wanted = _wanted(parameter)
            message = f"with: the parameter {name!r} of template {template.template} is missing; wanted {wanted}"
            raise passages.get(("with",), passages["template",]).error(message, 0)
        value = given.get(name, parameter.default)
        if name in given:
            wrong = _complaint(parameter, value, known)
            if wrong:
                raise passages["with", name].error(f"with.{name}: {wrong}", 0)
        settled[name] = value
    written = template.written_in
    text = _environment().from_string(template.match).render({name: settled[name] for name in written})
    params = {name: value for name, value in settled.items() if name not in written and value is not None}
    return Expansion(text, params, template.rule)


@cache
def _environment() -> Environment:
    return Environment(
        variable_start_string="<<",
        variable_end_string=">>",
        block_start_string="<%",
        block_end_string="%>",
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )


def _like(name: Any, known: Mapping[str, Any]) -> str:
    return did_you_mean(str(name), known)


def _places(values: Mapping[str, Any]) -> Mapping[str, frozenset[str]]:
    """The names of zones and lines that the rule file knows; a shared name may be either."""
    shared = {str(name) for name in values.get("shared") or () if isinstance(values.get("shared"), list)}
    own = {kind: set(values.get(f"{kind}s") or ()) for kind in ("zone", "line")}
    return {kind: frozenset(map(str, names | shared)) for kind, names in own.items()}


def _wanted(parameter: Parameter) -> str:
    return f"one of {', '.join(parameter.choices)}" if parameter.kind == "choice" else _WANTED[parameter.kind]


def _complaint(parameter: Parameter, value: Any, places: Mapping[str, frozenset[str]]) -> str:
    """What is wrong with the value; empty if nothing is."""
    kind = parameter.kind
    if kind in places:
        if not isinstance(value, str):
            return f"wanted {_wanted(parameter)}, got {value!r}"
        if value in places[kind]:
            return ""
        have = ", ".join(sorted(places[kind])) or "none"
        like = did_you_mean(value, places[kind])
        return (
            f"unknown {kind} {value!r}; the rule has: {have}{like}. Next: draw it under `{kind}s:`, or name it in "
            f"`shared: [{value}]`"
        )
    if _fits(parameter, value):
        return ""
    return f"wanted {_wanted(parameter)}, got {_shown(value)}"


def _fits(parameter: Parameter, value: Any) -> bool:
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    match parameter.kind:
        case "choice":
            return value in parameter.choices
        case "duration":
            return isinstance(value, str) and is_duration(value) and parse_duration(value) > timedelta(0)
        case "count":
            return isinstance(value, int) and not isinstance(value, bool) and value >= 1
        case "number":
            return is_number
        case "share":
            return is_number and 0 <= value <= 1
        case "length" | "speed" | "pixels" | "pixel speed":
            if not isinstance(value, str) or not is_quantity(value):
                return False
            quantity = parse_quantity(value)
            return quantity.base_unit == _BASE_UNITS[parameter.kind] and quantity.value >= 0
        case "texts":
            is_file = isinstance(value, Mapping) and set(value) == {"file"}
            return is_file or (isinstance(value, list) and bool(value) and all(isinstance(each, str) for each in value))
        case _:
            return isinstance(value, str) and bool(value)


def _shown(value: Any) -> str:
    return repr(value) if isinstance(value, str) else yaml.safe_dump(value, default_flow_style=True).split("\n")[0]


def new_rule(template: Template, rule: str) -> str:
    """The text of a new rule file that uses the template: its case file under the rule's name, tests included."""
    text = template.case_file.read_text(encoding="utf-8")
    old = f"rule: {template.template}-case\n"
    assert old in text, f"the case file of {template.template} must begin with {old!r}"
    return text.replace(old, f"rule: {rule}\n", 1)
