"""What the log has found of a camera by those who passed it, in words and as a drawing for the report."""

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from events import CameraCalibrated, EventType, HorizonEstimate, StreamName, decode, events_of
from extractors.calibration import Camera
from store import Log
from vian.evaluation.lines import Horizon

E = TypeVar("E", bound=EventType)


@dataclass(frozen=True, slots=True)
class CameraFound:
    """The newest that the log says of a camera; None where its tracks did not decide it."""

    source: str
    estimate: HorizonEstimate | None
    calibration: CameraCalibrated | None
    true: Camera | None
    """of a rendered scene"""

    @property
    def horizon(self) -> Horizon | None:
        """The estimated horizon."""
        found = self.estimate
        if found is None:
            return None
        mixed = found.slope_offset_covariance
        return Horizon(
            found.slope, found.offset_px, np.array([[found.slope_variance, mixed], [mixed, found.offset_variance]])
        )

    @property
    def true_horizon(self) -> Horizon | None:
        """Where it truly is, of a rendered scene."""
        return Horizon(*self.true.horizon) if self.true else None


def camera_found(log: Log, station: str, source: str, true: Camera | None) -> CameraFound:
    """What stands in the log of the station's source."""
    return CameraFound(
        source,
        _newest(log, StreamName.of(station, source, HorizonEstimate.type_name), HorizonEstimate),
        _newest(log, StreamName.of(station, source, CameraCalibrated.type_name), CameraCalibrated),
        true,
    )


def camera_rows(found: CameraFound) -> Iterator[tuple[str, str]]:
    """Horizon and camera as names and values, each with how sure it is (95 %), and with the truth where it is known."""
    yield f"horizon of {found.source}", _horizon_said(found)
    yield f"camera of {found.source}", _calibration_said(found)


def _horizon_said(found: CameraFound) -> str:
    line, estimate = found.horizon, found.estimate
    if line is None or estimate is None:
        return "not decided (too few pass, or all at one distance)"
    middle = (estimate.width - 1) / 2
    said = f"y = {line.slope:.3f} x {line.offset:+.0f} px, +- {float(line.reach_at(middle)):.0f} px in the middle"
    if found.true_horizon is None:
        return said
    return f"{said} (truly {found.true_horizon.slope:.3f} x {found.true_horizon.offset:+.0f})"


def _calibration_said(found: CameraFound) -> str:
    event = found.calibration
    if event is None or event.focal_px is None or event.pitch_rad is None or event.height_m is None:
        return "not decided (too few upright people pass)"
    assert event.covariance is not None, "who finds a camera in tracks says how sure it is"
    focal, pitch, _, height = 1.96 * np.sqrt(np.diag(json.loads(event.covariance)))
    degrees = math.degrees(event.pitch_rad), math.degrees(pitch)
    said = (
        f"{event.height_m:.1f} +- {height:.1f} m high, {degrees[0]:.0f} +- {degrees[1]:.0f}° down, "
        f"focal length {event.focal_px:.0f} +- {focal:.0f} px"
    )
    if found.true is None:
        return said
    true = found.true
    return f"{said} (truly {true.height_m:.1f} m, {math.degrees(true.pitch_rad):.0f}°, {true.focal_px:.0f} px)"


def _newest(log: Log, stream: StreamName, event_type: type[E]) -> E | None:
    """The last event of the stream; None where it has none."""
    head = log.stream_head(stream).sequence
    newest = None
    for segment in log.read(stream, max(1, head)):
        for event in events_of(decode(segment, log.catalogue)):
            assert isinstance(event, event_type), "a stream holds one type"
            newest = event
    return newest
