from pathlib import Path

import pytest

from events import SHIPPED, EventType, schema_of
from events.reference import reference
from tests.events.plugged import VehicleWeighed

PAGE = Path(__file__).parents[2] / "docs/reference/events.md"


def test_the_reference_of_events_is_up_to_date() -> None:
    assert PAGE.read_text() == reference(SHIPPED), (
        "docs/reference/events.md is out of date. Next: python -m events.reference > docs/reference/events.md"
    )


@pytest.mark.parametrize("event_type", SHIPPED, ids=lambda t: t.type_name)
def test_every_field_of_a_shipped_type_stands_in_its_section(event_type: type[EventType]) -> None:
    (section,) = (
        part for part in PAGE.read_text().split("\n## ") if part.startswith(f"`{event_type.type_name}` version")
    )
    for field in schema_of(event_type):
        assert f"| `{field.name}` | " in section
        assert field.metadata[b"description"].decode() in section


def test_marks_limits_and_parts_are_told() -> None:
    rows = reference([VehicleWeighed]).splitlines()
    assert "| `plate` | string, personal, null |  | number plate \\| null where unread |" in rows
    assert "| `notes` | string, json, null |  | notes |" in rows
    assert "| `axles[].load` | float, null |  | load, kg; null where the scale failed |" in rows
    assert "| `class_of` | string, null | `car`, `truck` | class |" in rows
