"""A situation's title: the rule's text with names in braces, and values in their place."""

import re
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime, timedelta
from string import Formatter
from typing import Any

from patterns.binding.expressions import Kind
from patterns.files.rule import Rule

Scalar = bool | int | float | str | datetime | timedelta | None

_LONG_NUMBER = re.compile(r"\d{4,}")
_SAMPLES: dict[Kind, Scalar] = {
    Kind.BOOL: True, Kind.INT: -1, Kind.FLOAT: 1.0, Kind.STRING: "a", Kind.TIME: datetime(2026, 1, 1, tzinfo=UTC),
    Kind.DURATION: timedelta(seconds=1), Kind.NULL: None,
}  # fmt: skip


def title_fields(rule: Rule) -> list[str]:
    """The names between braces in the rule's title.

    Raises:
        RuleError: A brace that is not closed, or more than a name and a format between braces.
    """
    names = []
    try:
        for _, name, spec, conversion in Formatter().parse(rule.title):
            if name is None:
                continue
            if _LONG_NUMBER.search(spec or ""):
                raise ValueError(f"a width or precision has at most 3 digits, got {spec!r}")
            if not name.isidentifier() or conversion or "{" in (spec or ""):
                raise ValueError(f"wanted {{name}} or {{name:format}}, got {{{name}}}")
            names.append(name)
    except ValueError as error:
        raise rule.error(f"title: {error}", "title") from error
    return names


def check_formats(rule: Rule, kinds: dict[str, Kind]) -> None:
    """Checks that each value can be shown in the format that the title gives it.

    Raises:
        RuleError: A format that values of the type do not have.
    """
    try:
        filled_titles(rule.title, {name: [_SAMPLES[kind]] for name, kind in kinds.items()}, 1)
    except (ValueError, OverflowError) as error:
        raise rule.error(f"title: {error}", "title") from error


def filled_titles(title: str, columns: Mapping[str, Sequence[Scalar]], count: int) -> list[str]:
    """So many titles, each `{name}` or `{name:format}` in its place; NULL is shown as `?`."""
    parts = [(text.replace("%", "%%"), name, spec or "") for text, name, spec, _ in Formatter().parse(title)]
    shown = [_shown(columns[name], spec) for _, name, spec in parts if name is not None]
    template = "".join(text if name is None else f"{text}%s" for text, name, _ in parts)
    return [template % values for values in zip(*shown, strict=True)] if shown else [template % ()] * count


def _shown(values: Sequence[Scalar], spec: str) -> list[str]:
    """Values of one type, or NULL, as a title shows them."""
    kind = next((type(value) for value in values if value is not None), None)
    show = _shows(kind, spec)
    return ["?" if value is None else show(value) for value in values]


def _shows(kind: type | None, spec: str) -> Callable[[Any], str]:
    if kind is timedelta:
        return lambda value: f"{value.total_seconds():{spec or 'g'}} s"
    if spec:
        return lambda value: format(value, spec)
    return (lambda value: value.isoformat().replace("+00:00", "Z")) if kind is datetime else str
