"""What keeps the house tidy: packages that are ours, and documents that tell the truth."""

import importlib.util
import re
import shlex
import subprocess
import tomllib
from collections.abc import Iterator
from importlib.metadata import distributions
from pathlib import Path
from typing import Any

import pytest

from events import SHIPPED
from vian.doctor import PACKAGES
from vian.reference import all_commands

ROOT = Path(__file__).parents[1]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text())
PAGES = [*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md")]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")
FILE = re.compile(rf"`((?:docs|tests|{'|'.join(PACKAGES)})/[\w./-]+(?:\.(?:py|sql|md|csv|yaml|j2)|/))`")
MACHINE_PATH = re.compile(r"/(?:work|root|home|Users)/[A-Za-z]")


def tracked() -> list[Path]:
    """The files that git tracks; all files of a source distribution, which has no git."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        return [path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file()]
    return [path for name in listed.stdout.split("\0") if name and (path := ROOT / name).is_file()]


def relative(path: Path) -> str:
    return str(path.relative_to(ROOT))


# Packages.


def test_the_packages_are_those_that_the_wheel_holds() -> None:
    assert sorted(PROJECT["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]) == sorted(PACKAGES)
    assert sorted(PROJECT["tool"]["importlinter"]["root_packages"]) == sorted(PACKAGES)


@pytest.mark.parametrize("package", PACKAGES)
def test_each_package_found_lies_in_this_distribution(package: str) -> None:
    found = importlib.util.find_spec(package)
    assert found is not None
    assert found.origin is not None
    assert Path(found.origin) == ROOT / package / "__init__.py"


def test_no_other_distribution_brings_a_package_of_one_of_our_names() -> None:
    strangers = {
        f"{distribution.name}: {file}"
        for distribution in distributions()
        if distribution.name != "vian"
        for file in distribution.files or ()
        if file.parts[0] in PACKAGES
    }
    assert strangers == set()


# Dependencies.


def named(requirements: list[str]) -> set[str]:
    """Names of the distributions, as the packaging standard normalises them."""
    return {re.sub(r"[-_.]+", "-", re.split(r"[\[<>=~! ;]", each)[0]).lower() for each in requirements}


def documented(heading: str) -> set[str]:
    text = (ROOT / "docs" / "dependencies.md").read_text()
    (section,) = (part for part in text.split("\n## ") if part.startswith(heading))
    rows = [line.split("|")[1].strip() for line in section.splitlines() if line.startswith("| ")]
    return set(rows[1:])


@pytest.mark.parametrize(
    "heading, requirements",
    [
        ("At run time", PROJECT["project"]["dependencies"]),
        ("Extras", [each for extra in PROJECT["project"]["optional-dependencies"].values() for each in extra]),
        ("For development", PROJECT["dependency-groups"]["dev"]),
        ("For benchmarks", PROJECT["dependency-groups"]["bench"]),
        ("For the test against Flink", PROJECT["dependency-groups"]["flink"]),
    ],
)
def test_every_dependency_has_its_reason_in_the_docs(heading: str, requirements: list[str]) -> None:
    assert documented(heading) == named(requirements)


def test_every_dependency_at_run_time_has_a_range() -> None:
    for requirement in PROJECT["project"]["dependencies"]:
        assert re.search(r">=[\d.]+,<[\d.]+$", requirement), requirement


# Documents.


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_every_link_of_a_page_leads_somewhere(page: Path) -> None:
    for target in LINK.findall(FENCE.sub("", page.read_text())):
        if re.match(r"\w+:", target):
            continue
        path, _, anchor = target.partition("#")
        found = (page.parent / path).resolve() if path else page
        assert found.exists(), target
        if anchor:
            assert anchor in anchors(found), target


def anchors(page: Path) -> set[str]:
    """Names under which a page's headings can be reached."""
    headings = re.findall(r"^#+ (.*)$", FENCE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=relative)
def test_every_file_that_a_page_names_is_there(page: Path) -> None:
    named_files = FILE.findall(page.read_text())
    missing = [name for name in named_files if not (ROOT / name).exists()]
    assert missing == []


def shown_commands() -> Iterator[tuple[str, str]]:
    """Every command line of ours that a page shows, with the page."""
    for page in PAGES:
        for language, block in FENCE.findall(page.read_text()):
            for line in block.replace("\\\n", " ").splitlines():
                if language == "sh" and line.strip().startswith("vian "):
                    yield relative(page), line.strip()


@pytest.mark.parametrize("page, line", list(shown_commands()))
def test_every_command_that_a_page_shows_can_be_given(page: str, line: str) -> None:
    words = shlex.split(line, comments=True)
    known = dict(all_commands())
    path = next((name for length in (4, 3, 2) if (name := " ".join(words[:length])) in known), None)
    assert path is not None, f"{page} shows a command that there is not: {line}"
    before_the_rest = words[: words.index("--")] if "--" in words else words
    options = {word.split("=")[0] for word in before_the_rest if word.startswith("-")}
    assert options <= {
        name for parameter in known[path].params for name in (*parameter.opts, *parameter.secondary_opts)
    }, line


def test_commands_are_shown_at_all() -> None:
    assert len(list(shown_commands())) > 20


def test_every_event_type_and_every_shipped_rule_stands_in_the_reference() -> None:
    events, rules = ((ROOT / "docs" / "reference" / f"{name}.md").read_text() for name in ("events", "rules"))
    assert [
        each.type_name for each in SHIPPED if f"\n## `{each.type_name}` version {each.version}\n" not in events
    ] == []
    shipped = sorted((ROOT / "patterns" / "rules").glob("*.yaml"))
    assert shipped
    assert [path.stem for path in shipped if path.stem not in rules] == []


def test_no_tracked_file_holds_a_path_of_a_machine() -> None:
    found = []
    for path in tracked():
        try:
            text = path.read_text(encoding="utf-8")
        except UnicodeDecodeError:
            continue
        found += [f"{relative(path)}: {match[0]}" for match in MACHINE_PATH.finditer(text)]
    assert found == []
