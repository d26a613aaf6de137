"""How the rules stand, as the log says it: for people, from any process."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any

from events import RuleMissed, decode, events_of
from patterns.processor.deploying import Service, standing
from patterns.processor.saving import Mark, stored_mark
from patterns.processor.writing import SOURCE
from store import Log


@dataclass(frozen=True, slots=True)
class Report:
    """How one version of a rule stands.

    Attributes:
        service: How the log says it stands.
        state: In one word: runs, shadow, finishes, retired, failed, too_slow.
        position: Position up to which all that it found is in the log.
        lag: Segments of the log behind that; 0 for one out of service.
        watermark: No event before this time was still expected when it was saved; None: nothing was known.
        counts: What it had seen, found and still remembered when it was saved.
        missed: By kind, what it went without in this version.
        uncalibrated: By source that is not calibrated, of how many events it asked for metres, until it was saved.
    """

    service: Service
    state: str
    position: int
    lag: int
    watermark: datetime | None
    counts: dict[str, Any] = field(default_factory=dict)
    missed: dict[str, int] = field(default_factory=dict)
    uncalibrated: dict[str, int] = field(default_factory=dict)


def reports(log: Log, station: str) -> list[Report]:
    """How every version that was ever deployed stands, in the order of deployment."""
    head = log.head()
    missed = _missed(log, station)
    return [_report(log, station, head, each, missed.get(each.key, {})) for each in standing(log, station).values()]


def _report(log: Log, station: str, head: int, service: Service, missed: dict[str, int]) -> Report:
    mark = stored_mark(log, station, *service.key)
    if mark is None or mark.life != service.life:
        mark = Mark(service.after, service.life)
    state = _state(service, is_done=mark.is_done)
    counts = dict(mark.report)
    watermark = counts.pop("watermark", None)
    uncalibrated = counts.pop("uncalibrated", {})
    position = max(mark.position, service.after)
    return Report(
        service=service,
        state=state,
        position=position,
        lag=head - position if state in ("runs", "shadow", "finishes") else 0,
        watermark=None if watermark is None else datetime.fromisoformat(watermark),
        counts=counts,
        missed=missed,
        uncalibrated=uncalibrated,
    )


def _state(service: Service, *, is_done: bool) -> str:
    gone = service.retirement
    if gone is None:
        return "shadow" if service.is_shadow else "runs"
    if gone.why in ("failed", "too_slow"):
        return gone.why
    return "retired" if is_done or gone.open_matches == "dropped" else "finishes"


def _missed(log: Log, station: str) -> dict[tuple[str, int], dict[str, int]]:
    found: dict[tuple[str, int], dict[str, int]] = {}
    for segment in log.read_all(types=[RuleMissed.type_name], sources=[SOURCE], stations=[station]):
        events: Sequence[Any] = events_of(decode(segment, log.catalogue))
        for event in events:
            sums = found.setdefault((event.rule, event.rule_version), {})
            sums[event.what] = sums.get(event.what, 0) + event.count
    return found
