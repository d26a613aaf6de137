"""The text of a plan, YAML or TOML, as plain data and the lines at which its parts stand.

Contract: pure; a text that is neither is a PlanError with its line. YAML's scalars stay text, for the
plan's own types decide what they mean. TOML knows no lines of values, only of errors.
"""

import tomllib
from collections.abc import Hashable, Iterator

import yaml

from sync.errors import PlanError

FILE_BYTES_MAX = 256 * 1024
_DEPTH_MAX = 4

Lines = dict[tuple[Hashable, ...], int]
"""The line, from 1, of each place in a document."""


def document(text: str, name: str) -> tuple[object, Lines]:
    """What a text says, and the line of each place in it; TOML where the name ends in `.toml`, else YAML.

    Raises:
        PlanError: It is not of that language.
    """
    return (_toml(text, name), {}) if name.endswith(".toml") else _yaml(text, name)


def _toml(text: str, name: str) -> object:
    try:
        data = tomllib.loads(text)
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise PlanError(f"{name}: not TOML: {' '.join(str(error).split())[:200]}") from error
    if not data:
        raise PlanError(f"{name}: the file is empty; wanted: [[entries]] with stream, from, priority")
    return data


def _yaml(text: str, name: str) -> tuple[object, Lines]:
    loader = None
    try:
        loader = yaml.BaseLoader(text)
        node = loader.get_single_node()
        if node is None:
            raise PlanError(f"{name}: the file is empty; wanted: entries, a list of {{stream, from, priority}}")
        lines = dict(_lines(node, (), name, set()))
        return loader.construct_document(node), lines
    except yaml.MarkedYAMLError as error:
        line = f", line {error.problem_mark.line + 1}" if error.problem_mark else ""
        raise PlanError(f"{name}{line}: not YAML: {error.problem}") from error
    except (yaml.YAMLError, RecursionError) as error:
        raise PlanError(f"{name}: not YAML: {' '.join(str(error).split())[:200]}") from error
    finally:
        if loader is not None:
            loader.dispose()


def _lines(
    node: yaml.Node, path: tuple[Hashable, ...], name: str, seen: set[int]
) -> Iterator[tuple[tuple[Hashable, ...], int]]:
    """The line of each place, from 1; aliases, deep nesting and doubled keys are refused."""
    line = node.start_mark.line + 1
    yield path, line
    if len(path) > _DEPTH_MAX:
        raise PlanError(f"{name}, line {line}: nested too deep for a plan")
    if id(node) in seen:
        raise PlanError(f"{name}, line {line}: an alias repeats this; write it out, a plan has no aliases")
    seen.add(id(node))
    if isinstance(node, yaml.SequenceNode):
        for index, child in enumerate(node.value):
            yield from _lines(child, (*path, index), name, seen)
    elif isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key, child in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise PlanError(f"{name}, line {key.start_mark.line + 1}: a key must be a text")
            if key.value in keys:
                raise PlanError(f"{name}, line {key.start_mark.line + 1}: {key.value[:60]!r} is given twice")
            keys.add(key.value)
            yield from _lines(child, (*path, key.value), name, seen)
