"""A type as a third party would define it, with every kind of field that has a column."""

from typing import Literal

from events import EventType, Float32, JsonText, Part, PersonalBytes, PersonalText, UtcTime


class Axle(Part):
    """One axle."""

    load: Float32 | None
    """load, kg; null where the scale failed"""
    label: str
    """name of the axle"""


class VehicleWeighed(EventType, type="vehicle_weighed", version=1, subject="plate"):
    """A scale weighed a vehicle."""

    plate: PersonalText | None
    """number plate | null where unread"""
    face: PersonalBytes
    """descriptor of the driver"""
    is_heavy: bool
    """above the limit"""
    is_sure: bool | None
    """sure of it"""
    raw: bytes | None
    """what the scale sent"""
    mass: float
    """mass, kg"""
    left_at: UtcTime | None
    """when it left (UTC)"""
    class_of: Literal["car", "truck"] | None
    """class"""
    notes: JsonText | None
    """notes"""
    axles: tuple[Axle, ...]
    """axles, front first"""
    spares: tuple[Axle, ...] | None
    """spare axles"""
