"""The reference of all templates as Markdown, from the templates and their case files.

`python -m patterns.files.reference > docs/reference/templates.md` writes the page; a test holds it up to date.
"""

import sys
from collections.abc import Iterable

from patterns.files.expanding import expand, value_text
from patterns.files.loading import load_rule
from patterns.files.template import Parameter, Template, templates

_INTRODUCTION = """\
# Templates

Written by `python -m patterns.files.reference > docs/reference/templates.md` from `patterns/templates/` and the case
files in `patterns/templates/cases/`, which are tests too.

A template is a pattern with parameters. A rule names it in place of `match`, and gives the parameters by name:

```yaml
rule: yard-dwell
version: 1
template: loitering
with: {zone: yard, min_duration: 30 s}
shared: [yard]                          # drawn with vian zones define, or here under `zones:`
```

Title, severity, `time` and `emit` are the template's where the rule does not say them. `vian rules expand FILE`
prints the rule as a person would write it in SQL; both are the same rule, with the same hash. `vian rules new NAME
--template T` writes a new file. Values have units: durations (`30 s`), lengths and speeds on the ground (`2.5 m`,
`50 km/h`), which need a calibrated camera, and lengths and speeds in the picture (`80 px`, `15 px/s`).

ONVIF names are those of the rules in the ONVIF Analytics Service Specification and of its events under
`tns1:RuleEngine`, and of `tns1:VideoSource`. A template that bears one finds what that rule is for; its parameters are
ViAn's own.

"""


def reference(known: Iterable[Template]) -> str:
    """The page for these templates."""
    listed = list(known)
    rows = "".join(f"| [{each.template}](#{each.template}) | {each.title} | {each.onvif or ''} |\n" for each in listed)
    contents = f"| template | finds that | ONVIF |\n|---|---|---|\n{rows}"
    return _INTRODUCTION + contents + "".join(f"\n{_section(each)}" for each in listed)


def _section(template: Template) -> str:
    rule = load_rule(template.case_file)
    text = template.case_file.read_text(encoding="utf-8").split("tests:\n")[0].rstrip("\n")
    sql = expand(rule).split("match: |\n")[1].split("tests:\n")[0]
    statement = "\n".join(line.removeprefix("  ") for line in sql.rstrip("\n").split("\n"))
    shows = "".join(f"- {case.name}: {_found(case.expect)}\n" for case in rule.tests)
    parts = [f"## {template.template}\n\nFinds that {template.title}. {' '.join(template.about.split())}\n"]
    parts += [f"\nONVIF: {template.onvif}.\n"] if template.onvif else []
    parts += [f"\nNeeds {template.needs}.\n"] if template.needs else []
    parts.append(f"\n| parameter | kind | default | meaning |\n|---|---|---|---|\n{_parameters(template)}")
    parts.append(f"\n```yaml\n{text}\n```\n\n```sql\n{statement}\n```\n\n{shows}")
    return "".join(parts)


def _parameters(template: Template) -> str:
    return "".join(
        f"| `{name}` | {_kind(each)} | {_default(each)} | {each.about} |\n"
        for name, each in template.parameters.items()
    )


def _kind(parameter: Parameter) -> str:
    return ", ".join(f"`{each}`" for each in parameter.choices) if parameter.kind == "choice" else parameter.kind


def _default(parameter: Parameter) -> str:
    if parameter.default is None:
        return "none" if parameter.optional else "required"
    return f"`{parameter.default}`"


def _found(expect: Iterable[object]) -> str:
    found = [value_text(each) for each in expect]
    return "; ".join(f"`{each}`" for each in found) or "nothing"


if __name__ == "__main__":
    sys.stdout.write(reference(templates().values()))
