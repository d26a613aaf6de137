"""The reference of all event types as Markdown, from their definitions.

`python -m events.reference > docs/reference/events.md` writes the page; a test holds it up to date.
"""

import sys
from collections.abc import Iterable

from events.catalogue import SHIPPED
from events.description import Field, fields_of
from events.door import TIME_END, TIME_MIN, VALUE_MAX_BYTES
from events.model import ENVELOPE, EventType
from events.segment import PAYLOAD_MAX_BYTES

_INTRODUCTION = f"""\
# Event types

Written by `python -m events.reference > docs/reference/events.md` from the definitions in `events/`.
`vian events` tells the same of the types that are installed, plug-ins included, and exports JSON Schema.

Every event has the envelope `{"`, `".join(ENVELOPE)}`. Of these the type itself holds `time` alone; the rest
follows from the stream and the log. Columns and types are those of Arrow; a column marked *null* may be null,
one marked *json* holds JSON as text, one marked *personal* is about a person.
Pixels: origin top-left, x right, y down. Times are UTC with microseconds.

An event that is appended holds what the column *allowed* says; every time lies in {TIME_MIN:%Y-%m-%d} to
{TIME_END:%Y-%m-%d} (not included), a text or binary value has at most {VALUE_MAX_BYTES // 2**20} MiB, and a segment
{PAYLOAD_MAX_BYTES // 2**20} MiB before compression. Other values are refused with the field's name, and nothing of
the call is stored. What was stored before a limit came is read as it is.

A type's version never changes. Events of an older version are read as the newest; those of a version
newer than this program knows stay stored, replicated and verified, and are left out of rows, rules and queries
with a count.
"""


def reference(types: Iterable[type[EventType]]) -> str:
    """The page for these types."""
    return _INTRODUCTION + "".join(f"\n{section}" for section in map(_section, types))


def _section(event_type: type[EventType]) -> str:
    subject = f"`{event_type.subject_field}`" if event_type.subject_field else "none"
    return "\n".join(
        (
            f"## `{event_type.type_name}` version {event_type.version}\n",
            f"{event_type.__doc__}\n",
            f"Subject: {subject}.{_history(event_type)}\n",
            "| field | type | allowed | meaning, unit, frame |",
            "|---|---|---|---|",
            *map(_row, fields_of(event_type)),
            "",
        )
    )


def _history(event_type: type[EventType]) -> str:
    """What came with this version, if there is an older one."""
    older = event_type.older
    if older is None:
        return ""
    new = [f"`{name}`" for name in event_type.model_fields if name not in older.model_fields]
    text = f" New in version {event_type.version}: {', '.join(new) or 'no field'}"
    computed = " ".join((event_type.upcast.__doc__ or "").split()).rstrip(".")
    return f"{text}; read from version {older.version}: {computed[:1].lower()}{computed[1:]}."


def _row(field: Field) -> str:
    is_words = field.kind == "string" and field.allowed
    allowed = f"`{field.allowed.replace(', ', '`, `')}`" if is_words else field.allowed
    return f"| `{field.path}` | {field.marks} | {allowed} | {_cell(field)} |"


def _cell(field: Field) -> str:
    return field.description.replace("|", "\\|")


if __name__ == "__main__":
    sys.stdout.write(reference(SHIPPED))
