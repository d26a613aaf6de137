import json
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
import zstandard

from events import (
    SHIPPED,
    CameraCalibrated,
    CameraCalibratedV1,
    Catalogue,
    EventBatch,
    EventType,
    TrackEnded,
    TrackEndedV1,
    TrackEndedV2,
    batch_of_type,
    events_of,
    schema_of,
)
from events.segment import decode_payload, encode_payload

GOLDEN = Path(__file__).parent / "golden"
FROZEN = sorted(path.stem for path in GOLDEN.glob("*.bin"))


def test_every_shipped_type_and_version_is_frozen() -> None:
    catalogue = Catalogue.shipped()
    versions = [version for event_type in SHIPPED for version in catalogue.versions(event_type.type_name)]
    shipped = {f"{event_type.type_name}.v{event_type.version}" for event_type in versions}
    assert shipped == set(FROZEN), (
        "Next: write tests/events/golden/TYPE.vN.json by hand, then python -m tests.events.golden"
    )


@pytest.mark.parametrize("name", FROZEN)
def test_frozen_bytes_decode_to_the_values_of_old(name: str) -> None:
    got = decode_payload((GOLDEN / f"{name}.bin").read_bytes(), schema_of(_type(name)))
    # As text, in which NaN equals itself and -0.0 is not 0.0.
    assert [_plain(row) for row in got.to_pylist()] == [json.dumps(row) for row in _rows(name)]


@pytest.mark.parametrize("name", FROZEN)
def test_the_values_of_old_encode_to_the_frozen_message(name: str) -> None:
    event_type = _type(name)
    batch = batch_of_type(event_type, [event_type.model_validate(row) for row in _rows(name)])
    assert _message(encode_payload(batch)) == _message((GOLDEN / f"{name}.bin").read_bytes())


@pytest.mark.parametrize("name", FROZEN)
def test_frozen_events_are_lawful_today(name: str) -> None:
    batch = EventBatch(_type(name), decode_payload((GOLDEN / f"{name}.bin").read_bytes(), schema_of(_type(name))))
    assert len(events_of(batch)) == len(_rows(name))


def _type(name: str) -> type[EventType]:
    type_name, version = name.split(".v")
    return Catalogue(SHIPPED).find(type_name, int(version))


def _rows(name: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = json.loads((GOLDEN / f"{name}.json").read_text())
    return rows


def _message(payload: bytes) -> bytes:
    return zstandard.ZstdDecompressor().decompress(payload)


def _plain(row: dict[str, Any]) -> str:
    return json.dumps({name: _value(value) for name, value in row.items()})


def _value(value: Any) -> Any:
    if isinstance(value, bytes):
        return value.hex()
    if isinstance(value, datetime):
        return value.isoformat(timespec="microseconds")
    if isinstance(value, float) and value - value != 0:
        return {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}[str(value)]
    return value


_ROOT = 1.4142135381698608
"""Of 2, in 32 bits."""


_NO_BOX = dict.fromkeys(("x1_mean", "y1_mean", "x2_mean", "y2_mean"))


def test_frozen_tracks_of_version_1_are_read_as_the_newest() -> None:
    frozen = decode_payload((GOLDEN / "track_ended.v1.bin").read_bytes(), schema_of(TrackEndedV1))
    new = Catalogue.shipped().upcast(EventBatch(TrackEndedV1, frozen))
    assert new.type is TrackEnded
    distances, durations = (767.058837890625, "NaN", _ROOT, _ROOT), (9.5, 315537897600.0, 0.0, 0.0)
    assert [_plain(row) for row in new.data.to_pylist()] == [
        json.dumps(row | {"displacement_px": distance, "duration_s": duration} | _NO_BOX)
        for row, distance, duration in zip(_rows("track_ended.v1"), distances, durations, strict=True)
    ]


def test_frozen_tracks_of_version_2_are_read_with_their_duration_and_no_mean_box() -> None:
    frozen = decode_payload((GOLDEN / "track_ended.v2.bin").read_bytes(), schema_of(TrackEndedV2))
    new = Catalogue.shipped().upcast(EventBatch(TrackEndedV2, frozen))
    assert [_plain(row) for row in new.data.to_pylist()] == [
        json.dumps(row | {"duration_s": duration} | _NO_BOX)
        for row, duration in zip(_rows("track_ended.v2"), (9.5, 1767268800.000001, 0.0, 0.0), strict=True)
    ]


def test_frozen_calibrations_of_version_1_say_nothing_of_the_camera_in_version_2() -> None:
    frozen = decode_payload((GOLDEN / "camera_calibrated.v1.bin").read_bytes(), schema_of(CameraCalibratedV1))
    new = Catalogue.shipped().upcast(EventBatch(CameraCalibratedV1, frozen))
    assert new.type is CameraCalibrated
    unsaid = dict.fromkeys(("focal_px", "pitch_rad", "roll_rad", "height_m", "covariance", "scale"))
    assert [_plain(row) for row in new.data.to_pylist()] == [
        json.dumps(row | unsaid) for row in _rows("camera_calibrated.v1")
    ]
