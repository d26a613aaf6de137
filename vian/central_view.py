"""How the stations stand with this central server, as its operator wants to see it: from its log alone.

Contract: reads, and decides nothing. What a station holds itself is what it said in its newest hello, which comes
every 15 minutes or when something changed; what central holds is counted.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from events import RequestRefused, Run, Station, StationEnrolled, StreamName, decode, events_of
from store import Log
from store.health import newest_recorded
from sync.central.contacts import StationContact, contacts_of
from sync.central.registry import Registered, Registry
from sync.keeping.gone import Gone, gone_in
from sync.runs import StreamKey

REFUSALS_OVER = timedelta(days=1)
UNKNOWN = "(unknown)"
"""Who is named for refused requests that name no station that is known here."""


@dataclass(frozen=True, slots=True)
class HeldStream:
    """What central holds of one stream."""

    stream: StreamName
    epoch: int
    at_station: int | None
    """newest event there, by the station's newest hello; None where that named none"""
    sequence: int
    """newest event here"""
    behind: int
    """events that the station has beyond that"""
    gaps: int
    """ranges before it that are not here"""
    missing: int
    """events in them"""
    lag_s: float
    """how long ago central stored the newest, where the station has more; else 0"""


@dataclass(frozen=True, slots=True)
class StationRow:
    """How one station stands."""

    station: Station | str
    state: str
    """`enrolled`, `revoked`, `has a token` or `unknown`"""
    last_contact_at: datetime | None
    last_contact_age_s: float | None
    clock_offset_s: float | None
    protocol: int | None
    program: str | None
    streams: tuple[HeldStream, ...]
    refusals: Mapping[str, int]
    """requests that were refused over the last day, by code"""
    gone: tuple[Gone, ...] = ()
    """ranges whose payload is gone here and at the station"""

    @property
    def behind(self) -> int:
        """Events that the station has beyond what is here."""
        return sum(each.behind for each in self.streams)

    @property
    def missing(self) -> int:
        """Events in gaps."""
        return sum(each.missing for each in self.streams)

    @property
    def lag_s(self) -> float:
        """Of the stream that waits longest, s."""
        return max((each.lag_s for each in self.streams), default=0.0)


@dataclass(frozen=True, slots=True)
class CentralView:
    """How all stations stand."""

    central: Station
    position: int
    invitations: int
    """codes that can still be used"""
    stations: tuple[StationRow, ...]


def is_central(log: Log, registry: Registry) -> bool:
    """Whether the log is one that stations send to."""
    return bool(registry.stations() or registry.invitations() or contacts_of(log))


def central_view(log: Log, registry: Registry, now: datetime) -> CentralView:
    """How the stations stand.

    Raises:
        LogUnavailable: The database is away.
    """
    registered = {each.name: each for each in registry.stations()}
    contacts = contacts_of(log)
    refused = _refusals(log, now, registered.keys() | contacts.keys())
    names = sorted(registered.keys() | contacts.keys())
    held = _held(log, names)
    recorded = newest_recorded(log, names)
    own = _own_name(log, registry)
    gone = gone_in(log, own)
    rows = []
    for name in names:
        contact = contacts.get(name)
        streams = tuple(_streams(held.get(name, {}), contact, recorded, now))
        row = _row(name, registered.get(name), contact, streams, refused.get(name, Counter()), now)
        rows.append(replace(row, gone=tuple(each for each in gone if each.stream.station == name)))
    if UNKNOWN in refused:
        rows.append(_row(UNKNOWN, None, None, (), refused[UNKNOWN], now))
    return CentralView(own, log.head(), len(registry.invitations()), tuple(rows))


def _own_name(log: Log, registry: Registry) -> Station:
    """Central's name, as its log knows it; as the settings say where it does not."""
    known = sorted({head.stream.station for head in log.streams() if head.stream.type == StationEnrolled.type_name})
    return registry.central if registry.central in known or not known else known[0]


def _row(
    name: str,
    registered: Registered | None,
    contact: StationContact | None,
    streams: tuple[HeldStream, ...],
    refusals: Mapping[str, int],
    now: datetime,
) -> StationRow:
    return StationRow(
        station=name,
        state=_state(registered, contact),
        last_contact_at=contact.last_contact_at if contact else None,
        last_contact_age_s=max(0.0, (now - contact.last_contact_at).total_seconds()) if contact else None,
        clock_offset_s=contact.clock_offset_s if contact else None,
        protocol=contact.protocol if contact else None,
        program=contact.program if contact else None,
        streams=streams,
        refusals=dict(refusals),
    )


def _state(registered: Registered | None, contact: StationContact | None) -> str:
    if registered is not None:
        return "enrolled" if registered.revoked_at is None else "revoked"
    return "has a token" if contact is not None else "unknown"


def _held(log: Log, stations: Iterable[Station]) -> dict[str, dict[StreamKey, list[Run]]]:
    found: dict[str, dict[StreamKey, list[Run]]] = {name: {} for name in stations}
    for place, runs in log.all_runs().items():
        key = StreamKey(*place)
        if key.stream.station in found:
            found[key.stream.station][key] = list(runs)
    return found


def _streams(
    held: Mapping[StreamKey, list[Run]],
    contact: StationContact | None,
    recorded: Mapping[tuple[StreamName, int], datetime],
    now: datetime,
) -> Iterable[HeldStream]:
    said = contact.heads if contact is not None else {}
    for key in sorted(held.keys() | said.keys()):
        runs = held.get(key, [])
        end = runs[-1].sequence if runs else 0
        behind = max(0, said.get(key, 0) - end)
        before = [0, *(run.sequence for run in runs)]
        gaps = [run.after - last for run, last in zip(runs, before, strict=False) if run.after > last]
        since = recorded.get(key) or (contact.hello_at if contact else now)
        lag = max(0.0, (now - since).total_seconds()) if behind else 0.0
        yield HeldStream(key.stream, key.epoch, said.get(key), end, behind, len(gaps), sum(gaps), lag)


def _refusals(log: Log, now: datetime, known: Iterable[str]) -> dict[str, Counter[str]]:
    """How many requests were refused over the last day, by the known station that they named, and by code."""
    names, found = set(known), dict[str, Counter[str]]()
    for segment in log.read_all(types=[RequestRefused.type_name], since=now - REFUSALS_OVER):
        if segment.stream.station in names:
            continue  # what a station refused that is a central server itself
        for event in events_of(decode(segment, log.catalogue)):
            if isinstance(event, RequestRefused) and event.time >= now - REFUSALS_OVER:
                name = event.claimed if event.claimed in names else UNKNOWN
                found.setdefault(name or UNKNOWN, Counter())[event.code] += event.count
    return found
