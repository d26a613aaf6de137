"""Calibrate a camera from the track points that its log holds.

Contract: each event that is found is appended once; run again over the same points and with the same scale, nothing is
appended. Track points are never touched: what they mean on the ground is a query (`track_ground`).
"""

from dataclasses import dataclass

from events import (
    CameraCalibrated,
    Producer,
    StreamName,
    TrackPoint,
    batch_of,
    decode,
    encode,
    events_of,
    source_name,
    station_name,
)
from extractors.calibration import NAME, VERSION, CalibrationConfig, CalibrationFold, KnownLength, Scale
from store import Log
from vian.errors import WorldFailed, WrongUsage
from vian.exclusive import exclusively
from vian.zoning import frame_size_of


@dataclass(frozen=True, slots=True)
class Calibrating:
    """What it came to.

    Attributes:
        points: Track points read.
        newest: The newest calibration of this run; None: the tracks decide none.
        appended: Events appended now.
        reason: Why the last look said nothing new.
    """

    points: int
    newest: CameraCalibrated | None
    appended: int
    reason: str


def calibrate_from_tracks(
    log: Log, station: str, source: str, config: CalibrationConfig, scale: Scale | None
) -> Calibrating:
    """Read the source's track points and record the calibrations that follow.

    Raises:
        InvalidName: The station or the source cannot be one.
        WorldFailed: The log has no track points or no video of the source, or another process is at it.
    """
    station_name(station), source_name(source)
    size = frame_size_of(log, station, source)
    if size is None:
        raise WorldFailed(
            f"the log has no video of source {source} of station {station}, and so no size of its frames. "
            f"Next: vian extract motion VIDEO --source {source}"
        )
    if isinstance(scale, KnownLength):
        _check_inside(scale, size)
    with exclusively(log, f"calibration of source {source} of station {station}"):
        fold = CalibrationFold(config, size, scale)
        points, found = 0, list[CameraCalibrated]()
        for segment in log.read_lives(StreamName.of(station, source, TrackPoint.type_name)):
            batch = decode(segment, log.catalogue)
            points += len(batch)
            fold.add(batch)
        for batch in fold.finish():
            found += [event for event in events_of(batch) if isinstance(event, CameraCalibrated)]
        if not points:
            raise WorldFailed(
                f"the log has no track points of source {source} of station {station}. "
                f"Next: vian extract motion VIDEO --source {source}"
            )
        return Calibrating(
            points, found[-1] if found else None, _append(log, station, source, config, found), fold.reason
        )


def _append(log: Log, station: str, source: str, config: CalibrationConfig, found: list[CameraCalibrated]) -> int:
    """Append what the stream does not hold yet; how many these are."""
    stream = StreamName.of(station, source, CameraCalibrated.type_name)
    known = {
        event.model_dump_json()
        for segment in log.read_lives(stream)
        for event in events_of(decode(segment, log.catalogue))
    }
    new = [event for event in found if event.model_dump_json() not in known]
    if new:
        producer = Producer(NAME, VERSION, config.config_hash)
        log.append([encode(stream, batch_of(new), producer)], [log.stream_head(stream).sequence])
    return len(new)


def _check_inside(length: KnownLength, size: tuple[int, int]) -> None:
    """Refuse points outside the picture: they are of another frame size.

    Raises:
        WrongUsage: One lies outside.
    """
    for x, y in (length.xy, length.other_xy):
        if not (0 <= x <= size[0] and 0 <= y <= size[1]):
            raise WrongUsage(f"--length: the point {x:g},{y:g} lies outside the frame of {size[0]} x {size[1]} px")
