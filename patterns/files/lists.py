"""Lists that stand in a file of their own, beside the rule: one value a line."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from patterns.language.text import Passage

VALUES_MOST = 100_000
"""Most values that a list has."""
_CHARACTERS_MOST = 16_000_000


def is_file(value: Any) -> bool:
    """Whether a parameter's value is `{file: NAME}`."""
    return isinstance(value, Mapping) and set(value) == {"file"} and isinstance(value["file"], str)


def file_values(name: str, passage: Passage, folder: Path | None) -> tuple[str, ...]:
    """The values of the file, each once, in their order; blank lines and those that begin with # are left out.

    Args:
        name: The file's name.
        passage: Where it is named, for errors.
        folder: Where the rule file lies; None: it is not a file.

    Raises:
        RuleError: The file cannot be read, or has no values or too many.
    """
    if folder is None:
        raise passage.error(f"{name}: a rule that is no file itself has no files beside it", 0)
    try:
        with (folder / name).open(encoding="utf-8") as file:
            text = file.read(_CHARACTERS_MOST + 1)
    except OSError as error:
        raise passage.error(f"{folder / name} cannot be read: {error.strerror}", 0) from error
    except UnicodeDecodeError as error:
        raise passage.error(f"{folder / name}: a list is UTF-8 text, a value a line; here it is not", 0) from error
    if len(text) > _CHARACTERS_MOST:
        raise passage.error(f"{folder / name}: a list has at most {_CHARACTERS_MOST} characters, got more", 0)
    lines = text.splitlines()
    values = tuple(dict.fromkeys(line.strip() for line in lines if line.strip() and not line.startswith("#")))
    if not 0 < len(values) <= VALUES_MOST:
        raise passage.error(f"{folder / name}: a list has 1 to {VALUES_MOST} values, got {len(values)}", 0)
    return values
