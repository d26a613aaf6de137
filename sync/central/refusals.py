"""Refusals: what central turned away, counted, and recorded in its own log.

Contract: every refusal is counted at once (`counts`). Those alike (claimed station, endpoint, code, address)
within a minute become one event `request_refused`, which `record` appends when the minute is over; what was not
recorded yet when central is killed is lost, but for the counts in its program's log. Memory is bounded: of more
kinds in a minute than `KINDS_MAX`, the rest is recorded by code alone.
"""

import hashlib
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from events import Producer, RequestRefused, Station, StreamName, batch_of, encode
from store import Log
from sync.text import one_line

WINDOW_SECONDS = 60.0
KINDS_MAX = 1000
SOURCE = "sync"
PRODUCER = Producer("refusals", "1", hashlib.sha256(b"{}").digest())
_GOT_MAX = 300


@dataclass(frozen=True, slots=True)
class Kind:
    """What refusals that are counted together have in common."""

    claimed: str | None
    endpoint: str
    code: str
    address: str | None


@dataclass(slots=True)
class _Noted:
    """Refusals of one kind that wait to be recorded."""

    got: str
    first_at: datetime
    began_s: float
    count: int = 0


class Refusals:
    """Counts and records the refusals of one central server; may be used by several threads.

    Args:
        log: Central's log.
        central: Central's own name.
        now: Central's clock, aware.
        clock: Seconds that never go back.
    """

    def __init__(self, log: Log, central: Station, now: Callable[[], datetime], clock: Callable[[], float]) -> None:
        self._log = log
        self._stream = StreamName.of(central, SOURCE, RequestRefused.type_name)
        self._now = now
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()
        self._noted: dict[Kind, _Noted] = {}

    def note(self, kind: Kind, got: str) -> None:
        """Count one refusal; `got` says what was wrong with it."""
        with self._lock:
            self._counts[kind.endpoint, kind.code] += 1
            if kind not in self._noted and len(self._noted) >= KINDS_MAX:
                kind = Kind(None, kind.endpoint, kind.code, None)
            noted = self._noted.setdefault(
                kind, _Noted(one_line(got[: 2 * _GOT_MAX], _GOT_MAX), self._now(), self._clock())
            )
            noted.count += 1

    def counts(self) -> dict[tuple[str, str], int]:
        """How many refusals there were since the start, by endpoint and code."""
        with self._lock:
            return dict(self._counts)

    def record(self, *, is_all: bool = False) -> list[RequestRefused]:
        """Append events for the kinds whose minute is over, or for all; those events.

        Raises:
            LogUnavailable: The database is away; what is not recorded is kept for the next call.
        """
        due = self._take(is_all)
        if not due:
            return []
        events = [_event(kind, noted, self._now()) for kind, noted in due.items()]
        try:
            self._log.append([encode(self._stream, batch_of(events), PRODUCER)])
        except BaseException:
            self._put_back(due)
            raise
        return events

    def _take(self, is_all: bool) -> dict[Kind, _Noted]:
        over = self._clock() - WINDOW_SECONDS
        with self._lock:
            due = {kind: noted for kind, noted in self._noted.items() if is_all or noted.began_s <= over}
            for kind in due:
                del self._noted[kind]
        return due

    def _put_back(self, due: dict[Kind, _Noted]) -> None:
        with self._lock:
            for kind, noted in due.items():
                newer = self._noted.get(kind)
                noted.count += newer.count if newer is not None else 0
                self._noted[kind] = noted


def _event(kind: Kind, noted: _Noted, now: datetime) -> RequestRefused:
    return RequestRefused(
        time=now,
        claimed=kind.claimed,
        endpoint=kind.endpoint,
        code=kind.code,
        got=noted.got,
        address=kind.address,
        count=noted.count,
        first_at=noted.first_at,
    )
