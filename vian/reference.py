"""The references of commands and settings as Markdown, from the command line and the settings themselves.

`python -m vian.reference commands > docs/reference/commands.md` writes one page, `settings` the
other; tests hold both up to date.
"""

import sys
from collections.abc import Iterator
from typing import Any

import typer.main
from pydantic.fields import FieldInfo

from vian.cli import app
from vian.settings import Settings

_COMMANDS = """\
# Commands

Written by `python -m vian.reference commands > docs/reference/commands.md` from the commands themselves.

Every command takes `--help`. Results go to standard output; progress, notes and errors to standard error. With
`--json` every result is one JSON object a line. Options that are settings too may stand in the environment or in
`vian.toml` instead: see [settings](settings.md).

| exit code | meaning |
|---|---|
| 0 | done |
| 1 | the world failed: database, file, network; the message names the next step |
| 2 | wrong usage: arguments, a file that they name and that is not there, settings, rules, queries |
| 130 | interrupted with Ctrl-C or SIGTERM; what was stored stays, and the same command goes on where it stopped |

`vian serve` is a service: stopped with Ctrl-C or SIGTERM, it did what it was told, and ends with 0.
"""

_SETTINGS = """\
# Settings

Written by `python -m vian.reference settings > docs/reference/settings.md` from the settings themselves.

A setting comes from the command line, else from the environment (`VIAN_` and its name in capitals), else from the
settings file, else it has its default. The settings file is the one that `VIAN_CONFIG` names, else `vian.toml` in the
current folder, else `vian.toml` in the platform's folder for settings (on Linux `~/.config/vian`). It is TOML, one line
a setting: `port = 8470`. A key that is no setting is refused.

"""


def commands() -> str:
    """The page of all commands."""
    return _COMMANDS + "".join(f"\n{_command(path, command)}" for path, command in all_commands())


def settings() -> str:
    """The page of all settings."""
    head = "| setting | environment | value | default | meaning |\n|---|---|---|---|---|\n"
    return _SETTINGS + head + "".join(map(_setting, Settings.model_fields.items()))


def all_commands(group: Any = None, path: str = "vian") -> Iterator[tuple[str, Any]]:
    """Every command with its whole name, groups that do nothing by themselves left out, in the order of the help."""
    root: Any = group or typer.main.get_command(app)
    for name, command in root.commands.items():
        if getattr(command, "invoke_without_command", False):
            yield f"{path} {name}", command
        if hasattr(command, "commands"):
            yield from all_commands(command, f"{path} {name}")
        else:
            yield f"{path} {name}", command


def _command(path: str, command: Any) -> str:
    rows = [_parameter(parameter) for parameter in command.params]
    parts = [
        f"## `{path}`\n",
        f"{command.help}\n",
        "| argument or option | default | meaning |",
        "|---|---|---|",
        *rows,
    ]
    return "\n".join([*parts, "", f"```sh\n{command.epilog.removeprefix('Example: ')}\n```", ""])


def _parameter(parameter: Any) -> str:
    is_option = parameter.param_type_name == "option"
    names = ", ".join(f"`{name}`" for name in parameter.opts) if is_option else f"`{parameter.name.upper()}`"
    return f"| {names} | {_default(parameter)} | {_cell(parameter.help)} |"


def _default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    if isinstance(parameter.show_default, str):
        return _cell(parameter.show_default)
    if parameter.default in (None, False):
        return ""
    return f"`{parameter.default}`"


def _setting(named: tuple[str, FieldInfo]) -> str:
    name, field = named
    assert field.description is not None, "every setting has a docstring"
    default = "" if field.default_factory is not None or field.default is None else f"`{field.default}`"
    return f"| `{name}` | `VIAN_{name.upper()}` | {_kind(name)} | {default} | {_cell(field.description)} |\n"


def _kind(name: str) -> str:
    """What a setting's value is, as its JSON schema says."""
    schema = Settings.model_json_schema()["properties"][name]
    schema = schema | next((each for each in schema.get("anyOf", ()) if each.get("type") != "null"), {})
    kind = {"path": "path", "password": "text, secret"}.get(schema.get("format", ""), schema["type"])
    limits = [f"≥ {schema['minimum']:g}"] if "minimum" in schema else []
    limits += [f"≤ {schema['maximum']:g}"] if "maximum" in schema else []
    return ", ".join([{"string": "text"}.get(kind, kind), *limits])


def _cell(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write({"commands": commands, "settings": settings}[sys.argv[1]]())
