"""What setting a plan changes of what is sent, stream by stream.

Contract: pure. What central holds already, it keeps, whatever the plan says later.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime

from events import StreamName
from sync.plans.entries import Entry
from sync.plans.plan import Plan
from sync.plans.plan_values import time_text


@dataclass(frozen=True, slots=True)
class Change:
    """What becomes different for some streams."""

    what: str
    streams: tuple[StreamName, ...]


def changes_of(present: Plan | None, plan: Plan, streams: Sequence[StreamName]) -> Iterator[Change]:
    """What becomes different for which of the streams, in the order in which it is met; what stays is left out."""
    found: dict[str, list[StreamName]] = {}
    for stream in streams:
        before = _sent(None if present is None else present.chosen(stream))
        for what in _differences(before, _sent(plan.chosen(stream))):
            found.setdefault(what, []).append(stream)
    if present is not None:
        for what in _of_all(present, plan):
            yield Change(what, ())
    for what, changed in found.items():
        yield Change(what, tuple(changed))


def _sent(entry: Entry | None) -> Entry | None:
    return entry if entry is not None and entry.sends else None


def _differences(before: Entry | None, after: Entry | None) -> Iterator[str]:
    if after is None:
        if before is not None:
            yield "stops: nothing more is sent; central keeps what it has"
        return
    if before is None:
        yield f"begins{_filtered(after)}, {_from(after.since)}"
        return
    if before.is_derived != after.is_derived or (after.is_derived and before.filter_hash != after.filter_hash):
        stops = f"the stream ~{before.filter_hash}" if before.is_derived else "the whole stream"
        yield f"begins{_filtered(after)}, {_from(after.since)}; {stops} stops, central keeps what it has of it"
    elif not after.is_derived and _time(before.since) > _time(after.since):
        yield f"is filled in retrospect, {_from(after.since)}"
    elif not after.is_derived and _time(before.since) < _time(after.since):
        yield f"nothing older is sent any more than {time_text(after.since)}; central keeps what it has"
    if before.priority != after.priority:
        yield f"priority {before.priority} becomes {after.priority}"
    if before.order != after.order:
        yield f"order {before.order} becomes {after.order}"
    if before.rate_bps != after.rate_bps:
        yield f"rate {_rate(before.rate_bps)} becomes {_rate(after.rate_bps)}"


def _of_all(present: Plan, plan: Plan) -> Iterator[str]:
    if present.paused != plan.paused:
        yield "the plan pauses" if plan.paused else "the plan goes on"
    if present.rate_bps != plan.rate_bps:
        yield f"the station's rate {_rate(present.rate_bps)} becomes {_rate(plan.rate_bps)}"
    if present.backlog_share != plan.backlog_share:
        yield f"backlog's least share {present.backlog_share:.0%} becomes {plan.backlog_share:.0%}"
    if present.give_up != plan.give_up:
        yield "what may be given up when the disk is full becomes another"


def _filtered(entry: Entry) -> str:
    return f", filtered, as a stream ~{entry.filter_hash} of its own" if entry.is_derived else ""


def _from(since: datetime | None) -> str:
    return "from the beginning" if since is None else f"from {time_text(since)}"


def _time(since: datetime | None) -> float:
    return float("-inf") if since is None else since.timestamp()


def _rate(bps: int | None) -> str:
    return "without limit" if bps is None else f"{bps} bit/s"
