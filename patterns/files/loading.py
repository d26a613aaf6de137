"""Rule files: YAML in, rules out, each value knowing its place in the file.

One file is one rule. PyYAML's nodes keep where every value stands, so an error
in a value, or at any character of the SQL, names its line and column in the
file. The SQL is parsed when the rule is loaded, and bound later.
"""

import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

from patterns.errors import RuleError
from patterns.files.complaints import in_words
from patterns.files.lists import file_values, is_file
from patterns.files.rule import Rule
from patterns.files.template import filled_in
from patterns.language.parser import parse
from patterns.language.text import Document, Passage, did_you_mean

FILE_SIZE_MOST = 1_000_000
DEPTH_MOST = 20
"""Deepest nesting of lists and mappings in a rule file; the format needs 4."""

_STAGE_KEY = re.compile(rb"^stage\s*:", re.MULTILINE)

KeyPath = tuple[str, ...]
M = TypeVar("M", bound=BaseModel)

_WANTS_QUOTES = ("mapping values are not allowed", "expected <block end>, but found '<scalar>'")
_QUOTED = ". Next: put a text that begins with {, [, % or @, or has a colon in it, in quotes"

_TOO_DEEP = f"a rule file nests at most {DEPTH_MOST} lists and mappings in each other, and none in itself"
_TOO_MANY = "aliases (*name) make more values of this file than it has characters; write them out"


def load_rules(path: Path) -> list[Rule]:
    """The rule of a file, or the rules of all `*.yaml` and `*.yml` files of a directory, by file name.

    Raises:
        RuleError: A file that is not a rule, or two rules of one name.
        OSError: A file that cannot be read.
    """
    rules: dict[str, Rule] = {}
    for file in rule_files(Path(path)):
        rule = load_rule(file)
        if rule.rule in rules:
            other = rules[rule.rule].path
            raise rule.passage("rule").error(f"rule {rule.rule!r} is also defined in {other}", 0)
        rules[rule.rule] = rule
    return list(rules.values())


def rule_files(path: Path) -> list[Path]:
    """The file itself, or all `*.yaml` and `*.yml` files of a directory that are not of stages, by name."""
    return [each for each in yaml_files(path) if path.is_file() or not is_stage_file(each)]


def stage_files(path: Path) -> list[Path]:
    """The file itself, or all `*.yaml` and `*.yml` files of a directory that are of stages, by name."""
    return [each for each in yaml_files(path) if path.is_file() or is_stage_file(each)]


def yaml_files(path: Path) -> list[Path]:
    """The file itself, or all `*.yaml` and `*.yml` files of a directory, by name."""
    if not path.is_dir():
        return [path]
    return sorted(each for each in path.iterdir() if each.suffix in (".yaml", ".yml"))


def is_stage_file(path: Path) -> bool:
    """Whether a file says a stage, by its first key; one that cannot be read says none."""
    try:
        with path.open("rb") as file:
            return _STAGE_KEY.search(file.read(FILE_SIZE_MOST)) is not None
    except OSError:
        return False


def load_rule(path: Path) -> Rule:
    """The rule of one file.

    Raises:
        RuleError: The file is not a rule.
        OSError: The file cannot be read.
    """
    path = Path(path)
    return parse_rule(read_text(path), str(path), path)


def read_text(path: Path) -> str:
    """The text of a rule or stage file.

    Raises:
        RuleError: It is too long, or not UTF-8.
        OSError: The file cannot be read.
    """
    with path.open("rb") as file:
        data = file.read(FILE_SIZE_MOST + 1)
    document = Document(str(path), "")
    if len(data) > FILE_SIZE_MOST:
        raise RuleError(f"a rule file has at most {FILE_SIZE_MOST} bytes, got more", document.place(0, 0))
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        before = data[: error.start].decode("utf-8", errors="replace")
        document = Document(str(path), before)
        lines = before.split("\n")
        raise RuleError("a rule file is UTF-8; here it is not", document.place(len(lines), len(lines[-1]))) from error


def parse_rule(text: str, name: str = "<rule>", path: Path | None = None) -> Rule:
    """The rule that a YAML text says; `name` stands for the file in errors, `path` where its test data lie.

    Raises:
        RuleError: The text is not a rule.
    """
    rule, passages = read_document(Document(name, text), Rule, partial(_prepared, folder=path and path.parent))
    rule = rule.loaded_from(path, passages)
    parse(rule.passage("match"))
    return rule


def _prepared(values: Mapping[str, Any], passages: dict[KeyPath, Passage], folder: Path | None) -> Mapping[str, Any]:
    """A rule file's values with the template filled in, and the values of lists that stand in files of their own."""
    filled = filled_in(values, passages)
    params = filled.get("params")
    if not isinstance(params, Mapping):
        return filled
    field = "with" if "template" in values else "params"
    return {**filled, "params": {
        name: file_values(value["file"], passages[field, name], folder) if is_file(value) else value
        for name, value in params.items()
    }}  # fmt: skip


def read_document(
    document: Document, model: type[M], prepare: Callable[[Any, dict[KeyPath, Passage]], Any] = lambda values, _: values
) -> tuple[M, Mapping[KeyPath, Passage]]:
    """What a YAML text says, as the model has it, and where in the text each of its values stands.

    `prepare` may change the values before the model sees them, and note where new ones stand.

    Raises:
        RuleError: The text is not YAML, or not what the model asks for; it points at the place.
    """
    node = _composed(document)
    if not isinstance(node, MappingNode):
        what = "an empty file" if node is None else "no mapping"
        keys = " ".join(f"`{name}:`," for name, field in model.model_fields.items() if field.is_required())
        raise RuleError(f"a {model.__name__.lower()} file is a mapping with {keys} ...; got {what}",
                        document.place(0, 0))  # fmt: skip
    passages: dict[KeyPath, Passage] = {}
    _note(node, (), document, passages)
    try:
        return model.model_validate(prepare(_constructed(node, document), passages)), passages
    except ValidationError as error:
        raise _pointed(error, passages, model) from error


def _composed(document: Document) -> Node | None:
    try:
        return yaml.compose(document.text, Loader=yaml.SafeLoader)
    except yaml.reader.ReaderError as error:
        line = document.text.count("\n", 0, error.position)
        raise RuleError(f"not YAML: {error.reason}", document.place(line, 0)) from error
    except RecursionError as error:
        raise RuleError(_TOO_DEEP, document.place(0, 0)) from error
    except yaml.MarkedYAMLError as error:
        is_unclosed = error.context == "while scanning a quoted scalar" and error.context_mark is not None
        mark = error.context_mark if is_unclosed else error.problem_mark or error.context_mark
        line, column = (mark.line, mark.column) if mark else (0, 0)
        problem = "this quoted text is not closed" if is_unclosed else error.problem or error.context
        message = f"not YAML: {problem}{_QUOTED if str(problem).startswith(_WANTS_QUOTES) else ''}"
        raise RuleError(message, document.place(line, column)) from error


def _constructed(node: MappingNode, document: Document) -> Any:
    loader = yaml.SafeLoader("")
    try:
        return loader.construct_document(node)
    except (yaml.MarkedYAMLError, ValueError) as error:
        mark = error.problem_mark if isinstance(error, yaml.MarkedYAMLError) else None
        line, column = (mark.line, mark.column) if mark else (0, 0)
        what = error.problem if isinstance(error, yaml.MarkedYAMLError) else error
        raise RuleError(f"not a YAML value: {what}", document.place(line, column)) from error


def _note(node: Node, path: KeyPath, document: Document, passages: dict[KeyPath, Passage]) -> None:
    """Notes where the node and everything in it stands.

    Raises:
        RuleError: A key stands twice in one mapping or is none, the nesting is too deep, or aliases
            say more values than the file has characters.
    """
    if len(path) > DEPTH_MOST:
        raise RuleError(_TOO_DEEP, document.place(node.start_mark.line, node.start_mark.column))
    if len(passages) > len(document.text):
        # Each value that is written takes a character, so only aliases of aliases come here.
        raise RuleError(_TOO_MANY, document.place(node.start_mark.line, node.start_mark.column))
    passages[path] = _passage(node, document)
    if isinstance(node, SequenceNode):
        for index, item in enumerate(node.value):
            _note(item, (*path, str(index)), document, passages)
    if not isinstance(node, MappingNode):
        return
    seen = set()
    for key, value in node.value:
        mark = key.start_mark
        if not isinstance(key, ScalarNode):
            raise RuleError("a key must be a word, got a list or a mapping", document.place(mark.line, mark.column))
        if key.value in seen:
            raise RuleError(f"the key {key.value!r} stands twice", document.place(mark.line, mark.column))
        seen.add(key.value)
        _note(value, (*path, key.value), document, passages)
        passages[(*path, key.value, "[key]")] = _passage(key, document)


def _passage(node: Node, document: Document) -> Passage:
    mark = node.start_mark
    start = (mark.line, mark.column)
    if not isinstance(node, ScalarNode):
        return Passage(document, "", (start,))
    text = str(node.value)
    if node.style == "|":
        return Passage(document, text, _block_starts(text, document, mark.line))
    is_as_written = document.lines[mark.line][mark.column + bool(node.style) :].startswith(text)
    if is_as_written and "\n" not in text:
        return Passage(document, text, ((mark.line, mark.column + bool(node.style)),))
    return Passage(document, text + "\n", (start,))


def _block_starts(text: str, document: Document, line: int) -> tuple[tuple[int, int], ...]:
    """For each line of a literal block, whose header stands on this line, where it begins in the file."""
    lines = text.split("\n")
    indentation = 0
    for index, content in enumerate(lines):
        if content.strip():
            written = document.lines[line + 1 + index]
            indentation = len(written) - len(content)
            break
    return tuple((line + 1 + index, indentation) for index in range(len(lines)))


def _pointed(error: ValidationError, passages: Mapping[KeyPath, Passage], whole: type[BaseModel]) -> RuleError:
    """The first complaint of pydantic, pointing at the value that it is about."""
    complaints = error.errors(include_url=False)
    # A misspelt key is two complaints, of which the unknown key says more than the missing one.
    first = next((each for each in complaints if each["type"] == "extra_forbidden"), complaints[0])
    location, message = in_words(first)
    shown = ".".join(part for part in location if not any(sign in part for sign in "[(")) or whole.__name__.lower()
    if first["type"] == "extra_forbidden":
        known = _known_keys(location, whole)
        message = f"unknown key; there are: {', '.join(known)}{did_you_mean(location[-1], known)}"
        location = (*location, "[key]")
    elif first["type"] == "missing":
        message = "this key is missing" + ("; write SQL there, or name a template" if location == ("match",) else "")
    for length in range(len(location), -1, -1):
        if location[:length] in passages:
            return passages[location[:length]].error(f"{shown}: {message}", 0)
    raise AssertionError("the document itself has a place")


def _known_keys(location: KeyPath, whole: type[BaseModel]) -> list[str]:
    """The keys that may stand where this one does."""
    model: Any = whole
    for part in location[:-1]:
        field = getattr(model, "model_fields", {}).get(part)
        if field is not None:
            model = next((each for each in _models(field.annotation)), None)
    return sorted(field.alias or name for name, field in model.model_fields.items()) if model is not None else []


def _models(annotation: Any) -> list[Any]:
    """The pydantic models in an annotation such as Mapping[str, Zone]."""
    if hasattr(annotation, "model_fields"):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in _models(part)]
