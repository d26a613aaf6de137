"""What one event type is: the base class of the catalogue's types and the markers of their fields.

Contract: a type is one frozen pydantic model. Its Arrow schema (`events.columns`) and its row
table (`store.tables`) derive from it, so a type is written down once. A type's version never
changes after release; the next version is another class, which names the one before as `older` and
brings an `upcast` from it.

A field's docstring gives unit, range and frame; it becomes the comment of the table's column.
"""

import struct
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, ClassVar

import pyarrow as pa
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, GetJsonSchemaHandler, WithJsonSchema
from pydantic_core import CoreSchema, from_json

from events.errors import InvalidEvent
from events.names import TypeName, type_name

ENVELOPE = ("id", "station", "source", "type", "subject", "time", "sequence", "position", "recorded_at")
"""The envelope's names, as in CloudEvents and the log; no payload field but `time` may bear one."""


@dataclass(frozen=True, slots=True)
class Stored:
    """How a field is stored where its Python type does not say it."""

    arrow: pa.DataType
    is_json: bool = False
    is_personal: bool = False


@dataclass(frozen=True, slots=True)
class AtDoor:
    """What a new number must be besides: finite, and between the limits, both inclusive.

    `encode` asks for it, so nothing else gets into a log; the model does not, so that what was stored
    before the limit came is read as it is.
    """

    least: float | None = None
    most: float | None = None

    def __get_pydantic_json_schema__(self, core: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        """The number's JSON Schema with the limits in it."""
        limits = {"minimum": self.least, "maximum": self.most}
        return handler(core) | {name: limit for name, limit in limits.items() if limit is not None}


def _utc(time: datetime) -> datetime:
    try:
        return time.astimezone(UTC).replace(fold=0)
    except OverflowError as error:
        raise ValueError(f"time must lie in the years 1 to 9999 of UTC, got {time.isoformat()}") from error


def _float32(number: float) -> float:
    try:
        (nearest,) = struct.unpack("<f", struct.pack("<f", number))
    except OverflowError as error:
        raise ValueError(f"must fit a float of 32 bits, got {number}") from error
    return float(nearest)


def _json(text: str) -> str:
    from_json(text, allow_inf_nan=False)
    return text


UtcTime = Annotated[AwareDatetime, AfterValidator(_utc)]
"""An aware instant, kept in UTC with microseconds."""

Float32 = Annotated[float, Stored(pa.float32()), AfterValidator(_float32)]
"""A number for which 24 bits of mantissa are enough (pixels, scores), rounded to them."""

Finite32 = Annotated[Float32, AtDoor()]
"""A `Float32` that is a number: pixels, speeds."""

Share32 = Annotated[Float32, AtDoor(0, 1)]
"""A `Float32` from 0 to 1: scores, shares."""

JsonText = Annotated[
    str,
    Stored(pa.string(), is_json=True),
    AfterValidator(_json),
    WithJsonSchema({"type": "string", "contentMediaType": "application/json"}),
]
"""JSON (RFC 8259, so without NaN) as text; a `jsonb` column in the row table."""

PersonalText = Annotated[str, Stored(pa.string(), is_personal=True)]
"""Text about a person (a number plate), which a later version may store encrypted."""

PersonalJson = Annotated[
    str,
    Stored(pa.string(), is_json=True, is_personal=True),
    AfterValidator(_json),
    WithJsonSchema({"type": "string", "contentMediaType": "application/json"}),
]
"""JSON about a person (other readings of a number plate), which a later version may store encrypted."""

PersonalBytes = Annotated[bytes, Stored(pa.binary(), is_personal=True)]
"""Bytes about a person (a descriptor of looks), which a later version may store encrypted."""


class EventType(BaseModel):
    """One thing that can have happened.

    A subclass names itself in its class statement, and says which of its fields is the subject
    that the event is about (a track, a process, a rule):

        class TrackPoint(EventType, type="track_point", version=1, subject="track_id"): ...

    The next version names the one before, and says in `upcast` what old events are in the new form.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        use_attribute_docstrings=True,
        ser_json_inf_nan="strings",
        ser_json_bytes="hex",
        val_json_bytes="hex",
    )

    type_name: ClassVar[TypeName]
    version: ClassVar[int]
    subject_field: ClassVar[str | None]
    older: ClassVar["type[EventType] | None"]
    """the version before; None where there is none, or none that the class brings"""

    time: UtcTime
    """when it happened (UTC, microseconds)"""

    def __init_subclass__(
        cls,
        *,
        type: str,  # noqa: A002 - the envelope's own word
        version: int,
        subject: str | None = None,
        older: "type[EventType] | None" = None,
        **kwargs: Any,
    ) -> None:
        """Keep the names given in the class statement."""
        super().__init_subclass__(**kwargs)
        cls.type_name, cls.version, cls.subject_field, cls.older = type_name(type), version, subject, older

    @classmethod
    def __pydantic_init_subclass__(cls, **_: Any) -> None:
        """Check the finished class.

        Raises:
            InvalidEvent: A field bears an envelope's name, `time` is defined anew, or the subject is no
                field.
        """
        taken = [name for name in cls.model_fields if name in ENVELOPE and name != "time"]
        if taken:
            raise InvalidEvent(f"{cls.type_name}: the envelope already has {', '.join(taken)}; rename these fields")
        if cls.model_fields["time"].annotation is not EventType.model_fields["time"].annotation:
            raise InvalidEvent(f"{cls.type_name}: time belongs to the envelope and cannot be defined anew")
        if cls.version < 1:
            raise InvalidEvent(f"{cls.type_name}: a version is 1 or more, got {cls.version}")
        if cls.subject_field is not None and cls.subject_field not in cls.model_fields:
            raise InvalidEvent(f"{cls.type_name}: subject must be a field of the type, got {cls.subject_field!r}")

    @classmethod
    def upcast(cls, older: pa.RecordBatch) -> pa.RecordBatch:
        """Events of the version before in this one: as many, in the same order, each at the same time.

        Pure and columnar. A value that the old version does not say is null, or follows from the others.
        """
        raise NotImplementedError(f"{cls.type_name} version {cls.version} brings no upcast")

    @classmethod
    def has_upcast(cls) -> bool:
        """Whether this version itself, and not one that it inherits from, says how old events become its own."""
        return "upcast" in vars(cls)


class Part(BaseModel):
    """A structure inside an event's field, for example one matched range of a situation."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", use_attribute_docstrings=True, ser_json_bytes="hex", val_json_bytes="hex"
    )


def stored(metadata: list[Any]) -> Stored | None:
    """The `Stored` marker among a field's metadata, if there is one."""
    return next((m for m in metadata if isinstance(m, Stored)), None)
