"""What the catalogue says of a type: its fields for people, and its JSON Schema for programs.

Contract: pure functions of the definition. The JSON Schema (draft 2020-12) is of one event as ViAn prints
it in JSON, `time` and payload without the rest of the envelope; it asks what the door asks.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import pyarrow as pa
from pydantic.json_schema import GenerateJsonSchema, JsonSchemaValue
from pydantic_core import core_schema

from events.columns import schema_of
from events.door import TIME_END, TIME_MIN, VALUE_MAX_BYTES, allowed
from events.model import EventType

DIALECT = "https://json-schema.org/draft/2020-12/schema"


@dataclass(frozen=True, slots=True)
class Field:
    """One field of a type; one of a part in a list has the path `list[].field`."""

    path: str
    kind: str
    """Type of its column, as Arrow names it."""
    is_nullable: bool
    is_json: bool
    is_personal: bool
    allowed: str
    """Which values are taken; empty where all are."""
    description: str
    """Meaning, unit, frame."""

    @property
    def marks(self) -> str:
        """The kind with what is special: json, personal, null."""
        special = {"json": self.is_json, "personal": self.is_personal, "null": self.is_nullable}
        return ", ".join([self.kind, *(mark for mark, holds in special.items() if holds)])


def fields_of(event_type: type[EventType]) -> list[Field]:
    """The type's fields in order, those of parts behind their list."""
    asked = allowed(event_type)
    return [
        Field(
            path=path,
            kind="list" if pa.types.is_list(field.type) else str(field.type),
            is_nullable=field.nullable,
            is_json=b"json" in field.metadata,
            is_personal=b"personal" in field.metadata,
            allowed="" if b"json" in field.metadata or path not in asked else str(asked[path]),
            description=field.metadata[b"description"].decode(),
        )
        for path, field in _paths("", schema_of(event_type))
    ]


def json_schema(event_type: type[EventType]) -> dict[str, Any]:
    """The JSON Schema of the type's events, in the version of this class."""
    schema = event_type.model_json_schema(schema_generator=_Generator)
    for name, field in schema["properties"].items():
        if b"personal" in schema_of(event_type).field(name).metadata:
            field["x-personal"] = True
    name = {"type": event_type.type_name, "version": event_type.version, "subject": event_type.subject_field}
    title = {"$schema": DIALECT, "$id": f"urn:vian:event:{event_type.type_name}:{event_type.version}"}
    return title | schema | {"title": event_type.type_name, "x-vian": name}


class _Generator(GenerateJsonSchema):
    """Writes times, bytes and text as ViAn prints and takes them."""

    def datetime_schema(self, schema: core_schema.DatetimeSchema) -> JsonSchemaValue:
        span = {"x-minimum": TIME_MIN.isoformat(), "x-exclusiveMaximum": TIME_END.isoformat()}
        return super().datetime_schema(schema) | span

    def bytes_schema(self, schema: core_schema.BytesSchema) -> JsonSchemaValue:
        text = {"type": "string", "contentEncoding": "base16", "pattern": "^([0-9a-f]{2})*$"}
        return text | {"maxLength": 2 * VALUE_MAX_BYTES}


def _paths(prefix: str, fields: Iterable[pa.Field]) -> Iterator[tuple[str, pa.Field]]:
    for field in fields:
        yield prefix + field.name, field
        if pa.types.is_list(field.type):
            yield from _paths(f"{prefix}{field.name}[].", field.type.value_type)
