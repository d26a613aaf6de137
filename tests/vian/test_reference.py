from pathlib import Path
from typing import Any

import pytest

from vian import reference
from vian.reference import all_commands
from vian.settings import Settings

PAGES = Path(__file__).parents[2] / "docs" / "reference"


@pytest.mark.parametrize("page", ["commands", "settings"])
def test_the_reference_is_up_to_date(page: str) -> None:
    assert (PAGES / f"{page}.md").read_text() == getattr(reference, page)(), (
        f"docs/reference/{page}.md is out of date. Next: python -m vian.reference {page} > docs/reference/{page}.md"
    )


@pytest.mark.parametrize("path, command", list(all_commands()))
def test_every_command_stands_in_it_with_its_options_and_its_example(path: str, command: Any) -> None:
    (section,) = (part for part in (PAGES / "commands.md").read_text().split("\n## ") if part.startswith(f"`{path}`\n"))
    for parameter in command.params:
        names = parameter.opts if parameter.param_type_name == "option" else [parameter.name.upper()]
        assert "| " + ", ".join(f"`{name}`" for name in names) + " |" in section
    assert f"```sh\n{path}" in section


@pytest.mark.parametrize("name", Settings.model_fields)
def test_every_setting_stands_in_it_with_its_meaning(name: str) -> None:
    (row,) = (line for line in (PAGES / "settings.md").read_text().splitlines() if line.startswith(f"| `{name}` |"))
    assert f"`VIAN_{name.upper()}`" in row
    assert Settings.model_fields[name].description in row


def test_nothing_of_this_machine_stands_in_it() -> None:
    text = reference.settings() + reference.commands()
    assert str(Path.home()) not in text
    assert str(Path.cwd()) not in text
    assert Settings().station not in text.replace("`vian", "")
