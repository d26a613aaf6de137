"""The reference of all event types as Markdown, from their definitions.

`python -m events.reference > docs/reference/events.md` writes the page; a test holds it up to date.
"""

import sys
from collections.abc import Iterable, Iterator
from typing import Any

import pyarrow as pa

from events.catalogue import SHIPPED
from events.columns import schema_of
from events.model import ENVELOPE, EventType

_INTRODUCTION = f"""\
# Event types

Written by `python -m events.reference > docs/reference/events.md` from the definitions in `events/`.

Every event has the envelope `{"`, `".join(ENVELOPE)}`. Of these the type itself holds `time` alone; the rest
follows from the stream and the log. Columns and types are those of Arrow; a column marked *null* may be null,
one marked *json* holds JSON as text, one marked *personal* is about a person.
Pixels: origin top-left, x right, y down. Times are UTC with microseconds, in the years 1 to 9999.
"""


def reference(types: Iterable[type[EventType]]) -> str:
    """The page for these types."""
    return _INTRODUCTION + "".join(f"\n{section}" for section in map(_section, types))


def _section(event_type: type[EventType]) -> str:
    limits = event_type.model_json_schema()["properties"]
    rows = [
        f"| `{path}` | {_kind(field)} | {_limit(limits.get(path, {}))} | {_description(field)} |"
        for path, field in _fields("", schema_of(event_type))
    ]
    subject = f"`{event_type.subject_field}`" if event_type.subject_field else "none"
    return "\n".join(
        (
            f"## `{event_type.type_name}` version {event_type.version}\n",
            f"{event_type.__doc__}\n",
            f"Subject: {subject}.\n",
            "| field | type | allowed | meaning, unit, frame |",
            "|---|---|---|---|",
            *rows,
            "",
        )
    )


def _fields(path: str, fields: Iterable[pa.Field]) -> Iterator[tuple[str, pa.Field]]:
    for field in fields:
        yield path + field.name, field
        if pa.types.is_list(field.type):
            yield from _fields(f"{path}{field.name}[].", field.type.value_type)


def _kind(field: pa.Field) -> str:
    kind = "list" if pa.types.is_list(field.type) else str(field.type)
    marks = [mark for mark in ("json", "personal") if mark.encode() in field.metadata]
    return ", ".join([kind, *marks, *(["null"] if field.nullable else [])])


def _limit(limits: dict[str, Any]) -> str:
    limits = limits.get("anyOf", [limits])[0]
    if "enum" in limits:
        return ", ".join(f"`{value}`" for value in limits["enum"])
    if "minimum" in limits:
        return f"≥ {limits['minimum']}"
    return f"> {limits['exclusiveMinimum']}" if "exclusiveMinimum" in limits else ""


def _description(field: pa.Field) -> str:
    return str(field.metadata[b"description"].decode()).replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(reference(SHIPPED))
