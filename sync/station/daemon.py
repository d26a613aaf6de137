"""The station's side: a daemon that one can step by hand.

Contract: `step` does one bounded thing (log the plan, say hello, send one request, do a piece of a chore, or find
nothing to do) and says what, and how long it may sleep. Central holds the cursors and the log the segments, so
the daemon keeps nothing that a kill could lose. After any doubt (no answer, a refusal, a failure) it
says hello again before it sends. Clocks and randomness are passed in. With one request in flight a step is
over when its request is answered; with more, a step launches one or takes in one that has landed.

Order: `sync.station.scheduling`. A stream whose history differs from central's, as two hellos say, is stopped;
the others go on.
"""

import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import datetime
from itertools import islice, pairwise
from time import monotonic as steady
from time import sleep

from events import Station
from store import Log, LogUnavailable, SequenceConflict
from sync.errors import (
    BadAnswer,
    CentralError,
    HeadsDisagree,
    PlanError,
    Refusal,
    Refused,
    SegmentRefused,
    StreamStopped,
    SyncError,
)
from sync.keeping.countersigning import Countersigning
from sync.keeping.gone import GoneRecorder
from sync.keeping.repair import records_for
from sync.plans.plan import Entry, Plan
from sync.plans.planning import plan_stream, planned_in, set_plan
from sync.protocol.reports import Chore, Pace, State, Status, Step, StreamStatus, saved_status
from sync.protocol.wire import Cursor, HelloAnswer, Range, RunState
from sync.runs import Runs, StreamKey, are_held, end_of
from sync.station.bell import Bell
from sync.station.chores import Chores
from sync.station.client import Greeting, Link
from sync.station.comparing import check_beyond
from sync.station.contact import Contact
from sync.station.flights import BACKLOG, LOOK_SECONDS, Flights, Landed
from sync.station.outbox import Capacity, Outbox
from sync.station.pacing import Caps, Meter, Sizer
from sync.station.reporting import Reporter
from sync.station.scheduling import Share, Work, chosen, in_order
from sync.station.standing import Standing

_FOR_GOOD = ("false_header", "too_many_streams", "too_many_runs")
"""Codes of refusals that the same segment meets again."""
_NOTES_MAX = 3
"""Most streams that stay here of which the status says why."""
_OVERTAKEN_MAX = 20
"""Live requests that go ahead of a signature or a repair: while live work never ends, it has its turn then."""


class Daemon:
    """Sends a station's planned streams to central.

    Args:
        log: The station's log.
        station: Whose streams they are.
        plan: What to begin with; a plan that the log names later is followed from then on.
        central: Where to.
        now: The station's clock, aware.
        random: Numbers from 0 to 1, which spread the stations' retries.
        monotonic: Seconds that never go back.
        pace: How much at a time, how long between.
        chores: Further work, done when nothing live waits.
        central_key: Central's public key, under which it countersigns checkpoints; None: it is not asked to.

    Raises:
        PlanError: No entry of the plan can fit a stream of this station.
    """

    def __init__(
        self,
        log: Log,
        station: Station,
        plan: Plan,
        central: Link,
        *,
        now: Callable[[], datetime],
        random: Callable[[], float],
        monotonic: Callable[[], float] = steady,
        pace: Pace | None = None,
        chores: Sequence[Chore] = (),
        central_key: bytes | None = None,
    ) -> None:
        if not any(entry.fits_station(station) for entry in plan.entries):
            raise PlanError(f"the plan names no stream of station {station}; write */... or {station}/... in an entry")
        self._log = log
        self._station = station
        self._plan = plan
        self._central = central
        self._now = now
        self._monotonic = monotonic
        self._pace = pace or Pace()
        name = f"{int(random() * 2**32):08x}"
        self._outbox = Outbox(log)
        self._standing = Standing(log, station)
        self._flights = Flights(central, self._pace.in_flight, name, monotonic)
        self._contact = Contact(self._pace, now, random)
        self._chores = Chores(chores)
        self._countersigning = Countersigning(log, station, central_key, monotonic)
        self._gone = GoneRecorder(log, station, now)
        self._reporter = Reporter(log, name, now, monotonic)
        self._sizer = Sizer(self._pace.latency_s, self._pace.request_bytes_min, self._pace.request_bytes)
        self._meter = Meter()
        self._share = Share()
        self._caps = Caps()
        self._terms = _Terms()
        self._wanted: list[Range] = []
        """what central wants back, of the last hello"""
        self._before: Status | None = None
        """what a daemon before this one said last, which holds until central says more"""
        self._sent: dict[StreamKey, _Sent] = {}
        self._doubts: dict[StreamKey, str] = {}
        self._state: State = "starting"
        self._is_set = False
        self._is_log_away = False
        self._is_chores_turn = True
        self._overtaken = 0
        """live requests that went ahead of the errand that waits"""
        self._log_head = -1
        self._looked_at = 0.0
        self._plan_place: tuple[int, int] | None = None
        self._is_plan_seen = False
        if all(entry.begin != "now" or entry.now is not None for entry in plan.entries):
            self._standing.follow(plan)

    def step(self) -> Step:
        """Do one bounded thing, and say what it was."""
        step = self._step()
        is_at_work = step.did not in ("nothing", "sending")
        error = self._contact.last_error or self._stop_reason()
        self._reporter.report(self._state, error, self.status, is_at_work=is_at_work)
        return step

    @property
    def other_daemons(self) -> int:
        """Others that were seen to run for this station of late: one too many, which does no harm."""
        return self._reporter.others

    def run(self, stop: threading.Event, on_step: Callable[[Step], None] | None = None) -> None:
        """Step until `stop` is set; sleep between steps until the log grows or a pause is over.

        Args:
            stop: Set it to end; it ends within a second, or when a request's deadline is over.
            on_step: Told of every step.
        """
        bell = Bell(self._log, self._station)
        try:
            while not stop.is_set():
                step = self.step()
                if on_step is not None:
                    on_step(step)
                if step.did == "nothing":
                    bell.wait(self._log_head, step.sleep_s, stop)
                elif step.sleep_s:
                    self._pause(step.sleep_s, stop)
        finally:
            bell.close()
            self._flights.close()

    def meanwhile(self) -> bool:
        """Do a piece of a chore while a pause lasts, as when central does not answer; whether there may be more."""
        if self._is_log_away:
            return False
        try:
            self._look()
            return self._chores.step(self._now())
        except (LogUnavailable, PlanError):
            return False  # the next step meets the same, and says it

    def _pause(self, seconds: float, stop: threading.Event) -> None:
        """Wait, and do chores meanwhile; until `stop` is set at most."""
        until = self._monotonic() + seconds
        while not stop.is_set() and (left := until - self._monotonic()) > 0:
            if not self.meanwhile():
                stop.wait(left)

    def catch_up(self, pause: Callable[[float], object] = sleep) -> int:
        """Number of events sent until nothing was left to do.

        Args:
            pause: Waits so many seconds, where a cap on the rate wants it.

        Raises:
            SyncError: A step failed, or a stream was stopped and the others are sent; what was acknowledged stays at
                central.
            LogUnavailable: The station's database is away.
        """
        events = 0
        stopped: SyncError | LogUnavailable | None = None
        while True:
            step = self.step()
            if step.did == "stopped":
                stopped = stopped or step.error
            elif step.error is not None:
                raise step.error
            events += step.events
            if step.did != "nothing":
                continue
            if self._state == "sending":
                pause(step.sleep_s)
                continue
            if stopped is not None:
                raise stopped
            return events

    def status(self) -> Status:
        """Where each planned stream stands, by the station's log and central's last word.

        Raises:
            LogUnavailable: The station's database is away.
        """
        self._look()
        contact, before = self._contact, self._before
        offset = before.clock_offset_s if before and contact.clock_offset_s is None else contact.clock_offset_s
        said = {StreamKey(each.stream, each.epoch): each for each in (before.streams if before else ())}
        keys = self._standing.keys()
        return Status(
            self._station,
            self._central.address,
            tuple(self._stream_status(key, said.get(key)) for key in keys),
            contact.last or (before.last_contact if before else None),
            offset,
            contact.failures,
            contact.last_error or self._stop_reason(),
            state=self._state,
            protocol=self._central.protocol,
            rate_bps=self._meter.bps or (before.rate_bps if before else None),
            countersigned=self._countersigning.sequence,
            notes=(*self._chores.notes, *map(str, islice(self._standing.apart.values(), _NOTES_MAX))),
        )

    def _stream_status(self, key: StreamKey, before: StreamStatus | None) -> StreamStatus:
        planned, held = self._standing.planned[key], self._standing.acknowledged
        stopped, sent = self._standing.stopped.get(key), self._sent.get(key)
        backlog, cursor = self._standing.backlog(key), None
        if isinstance(stopped, HeadsDisagree):
            backlog = None  # What central holds is another history: nothing of this one.
        elif held is not None:
            cursor = end_of(held.get(key, ())).sequence
        elif before is not None and before.backlog is not None:
            cursor, backlog = before.cursor, before.backlog + max(0, planned.head.sequence - before.sequence)
        return StreamStatus(
            key.stream,
            key.epoch,
            planned.entry.priority,
            planned.head.sequence,
            cursor,
            backlog,
            None if stopped is None else str(stopped),
            sent.until if sent else (before.held_until if before else None),
            sent.size / sent.events if sent else (before.bytes_per_event if before else None),
            key in self._standing.apart or (held is None and before is not None and before.is_apart),
        )

    def _stop_reason(self) -> str | None:
        return next((str(error) for error in self._standing.stopped.values()), None)

    def _step(self) -> Step:
        try:
            if self._is_log_away:
                self._log.revive()
                self._is_log_away = False
            return self._do()
        except StreamStopped as error:
            return self._doubted_or_stopped(error)
        except LogUnavailable as error:
            self._is_log_away = True
            return self._failed(error)
        except (CentralError, PlanError) as error:
            return self._failed(error)

    def _do(self) -> Step:
        if not self._is_set:
            return self._set_plan()
        self._look()
        self._heed_plan()
        if (landed := self._flights.landed()) is not None:
            return self._land(landed)
        if self._standing.runs is None and len(self._flights):
            self._flights.wait()  # of what was under way when something failed: its answer is told, not believed
            return Step("sending")
        self._standing.check()
        is_held_up = self._plan.paused or self._is_hello_due()
        if is_held_up and len(self._flights):
            self._flights.wait()
            return Step("sending")
        if self._plan.paused:
            return Step("chore") if self._chores.step(self._now()) else self._rest("paused")
        if is_held_up:
            return self._hello()
        return self._work()

    def _set_plan(self) -> Step:
        """Have the log name the plan, unless it does, and follow what it names."""
        before = saved_status(self._log)
        if before is not None and (before.station, before.central) == (self._station, self._central.address):
            self._before = before
        planned = planned_in(self._log, self._station)
        try:
            if planned is None or (planned.plan, planned.central) != (self._plan, self._central.address):
                planned = set_plan(self._log, self._station, self._plan, self._central.address, self._now())
        except SequenceConflict:
            return Step("planned")  # Others were faster: look again.
        self._is_set = True
        self._follow(planned.plan, (planned.epoch, planned.sequence))
        return Step("planned")

    def _follow(self, plan: Plan, place: tuple[int, int]) -> None:
        self._plan, self._plan_place = plan, place
        self._caps.follow(plan)
        self._standing.follow(plan)
        self._outbox.forget()

    def _look(self) -> None:
        """Take in what the log holds now; while requests are under way not more often than that is worth."""
        at = self._monotonic()
        if len(self._flights) and at - self._looked_at < LOOK_SECONDS[0]:
            return
        self._looked_at = at
        if self._log.head() != self._log_head:
            self._log_head, heads = self._log.heads(self._station)
            self._standing.look(self._log_head, heads)
            self._chores.wake()
            self._is_plan_seen = False

    def _heed_plan(self) -> None:
        """Follow the plan that the log names, if it is another."""
        if self._is_plan_seen:
            return
        newest = self._standing.newest(plan_stream(self._station))
        if newest != self._plan_place:
            planned = planned_in(self._log, self._station)
            assert planned is not None, "it was set at the start"
            self._follow(planned.plan, (planned.epoch, planned.sequence))
        self._is_plan_seen = True

    def _is_hello_due(self) -> bool:
        if self._standing.runs is None:
            return True
        if not self._central.knows_all and not self._standing.planned.keys() <= self._terms.named:
            return True
        at, until = self._monotonic(), self._terms.token_until
        if at - self._terms.at >= self._pace.hello_s:
            return True
        return until is not None and at >= until and self._has_work()

    def _has_work(self) -> bool:
        return bool(self._standing.works(may_jump=self._central.may_jump))

    def _hello(self) -> Step:
        asked = self._now()
        heads = self._standing.heads()
        answer = self._central.hello(
            Greeting(
                self._station,
                self._log.epoch,
                asked,
                heads,
                self._standing.acknowledged,
                self._countersigning.sequence,
            )
        )
        held = self._standing.acknowledged if answer.are_cursors_known else None
        if held is None:
            held = _told(answer.cursors)
            self._countersigning.heed(held)
        self._standing.hear(dict(held))
        self._outbox.forget()
        self._terms = _Terms.of(answer, self._monotonic(), {StreamKey(head.stream, head.epoch) for head in heads})
        self._caps.heed(answer.bits_per_s_max)
        self._wanted = list(answer.wanted)
        self._contact.greeted(asked, answer.time)
        return Step("hello")

    def _work(self) -> Step:
        """Do the most urgent thing: live work, then signatures and repairs, then chores and backlog in turn."""
        works = self._standing.works(may_jump=self._central.may_jump)
        at = self._monotonic()
        waits = {id(work): self._caps.wait_s(work.entry, at, is_live=work.is_live) for work in works}
        ready = [work for work in works if not waits[id(work)]]
        first = self._chosen(ready)
        errand = self._errand(has_time=not works)
        if first and first[0].is_live and (errand is None or self._overtaken < _OVERTAKEN_MAX):
            self._overtaken += errand is not None
            return self._launch(first, at)
        if errand is not None:
            return self._do_errand(errand)
        self._is_chores_turn = not self._is_chores_turn or not first
        if self._is_chores_turn and self._chores.step(self._now()):
            return Step("chore")
        if first:
            return self._launch(first, at)
        if len(self._flights):
            self._flights.wait()
            return Step("sending")
        return self._rest("caught_up" if not works else "sending", min(waits.values(), default=None))

    def _chosen(self, ready: Sequence[Work]) -> Sequence[Work]:
        """What is launched now; what is live does not wait for what is under way of lanes behind its own."""
        if not self._flights.has_slot:
            return in_order(work for work in ready if work.is_live and self._flights.overtakes(work.entry.priority))
        works = chosen(ready, self._share, self._plan.backlog_share, self._sizer.size)
        is_early = bool(works) and not works[0].is_live and not self._flights.is_apart(self._sizer.took_s)
        return [] if is_early else works

    def _rest(self, state: State, wait_s: float | None = None) -> Step:
        self._contact.went_well()
        self._state = state
        until_hello = self._terms.at + self._pace.hello_s - self._monotonic()
        sleep_s = min(self._pace.idle_s, max(until_hello, 0.001))
        return Step("nothing", sleep_s if wait_s is None else min(sleep_s, wait_s))

    def _errand(self, *, has_time: bool) -> Callable[[], Step] | None:
        """A short request of its own that waits: a comparison, a signature, or a range that central wants back."""
        if self._standing.open:
            return self._compare
        held = self._standing.acknowledged
        if held is not None and self._countersigning.is_due(self._standing.here(), held, has_time=has_time):
            return self._countersign
        return self._repair if self._wanted else None

    def _do_errand(self, errand: Callable[[], Step]) -> Step:
        """Do it once nothing is under way; no backlog is launched meanwhile, or it would never be so."""
        if len(self._flights):
            self._flights.wait()
            return Step("sending")
        self._overtaken = 0
        return errand()

    def _compare(self) -> Step:
        """Ask whether what central holds of an earlier epoch goes on from what is here."""
        key = self._standing.open.pop()
        check_beyond(self._central, self._standing.here()[key])
        self._standing.agreed.add(key)
        self._contact.answered()
        return Step("compared")

    def _countersign(self) -> Step:
        try:
            answer = self._central.countersign(self._countersigning.request())
        except Refused:
            self._countersigning.gave_up()
            raise
        self._countersigning.take(answer)
        self._contact.answered()
        return Step("countersigned")

    def _repair(self) -> Step:
        """Send again the next range that central wants back."""
        wanted = self._wanted.pop(0)
        with suppress(Refusal, Refused):  # what is not here, or is another's, central lacks as before
            terms = self._terms
            body = records_for(
                self._log, self._station, wanted, bytes_max=terms.body_bytes_max, segments_max=terms.segments_max
            )
            self._central.repair(body)
            self._contact.answered()
        return Step("repaired")

    def _launch(self, works: Sequence[Work], at: float) -> Step:
        """Send the first segments of these works."""
        parcel = self._outbox.fill([work.gap for work in works], self._capacity(works[0].entry))
        if not parcel.records:
            return Step("sending")  # the gap was filled by another reader: look again
        gone = tuple(map(str, self._gone.record(record.segment for record in parcel.records)))
        entries = self._standing.planned
        sizes: dict[Entry, int] = {}
        for filled in parcel.filled:
            entry = entries[filled.key].entry
            sizes[entry] = sizes.get(entry, 0) + filled.size
        self._caps.sent(sizes, at)
        self._share.sent(parcel.size, was_live=works[0].is_live)
        self._standing.launched(parcel.filled)
        self._state = "sending"
        self._flights.launch(parcel, works[0].entry.priority if works[0].is_live else BACKLOG)
        landed = self._flights.landed() if self._pace.in_flight == 1 else None
        return replace(Step("sending") if landed is None else self._land(landed), gone=gone)

    def _capacity(self, entry: Entry) -> Capacity:
        """What the next request may hold: what the link, or the cap on the entry, carries in the latency."""
        capped = self._caps.bytes_in(entry, self._pace.latency_s)
        wanted = self._sizer.size if capped is None else min(self._sizer.size, capped)
        return Capacity(min(wanted, self._terms.body_bytes_max), self._terms.body_bytes_max, self._terms.segments_max)

    def _land(self, landed: Landed) -> Step:
        """Take in what became of a request."""
        if self._standing.runs is None:
            return Step("sending")  # something failed since it was sent: hello will tell
        if isinstance(landed.answer, BaseException):
            self._standing.doubt()  # whatever it was, nothing of the request counts as sent
            self._outbox.forget()
            raise landed.answer
        told = _told(landed.answer.cursors)
        for each in landed.parcel.filled:
            if not are_held(told.get(each.key, ()), each.after.sequence, each.end):
                raise BadAnswer(
                    f"central at {self._central.address} acknowledged segments of {each.key.stream} up to "
                    f"{each.end.sequence}, but names no cursor there"
                )
        self._standing.landed(told, self._flights.filled())
        self._count(landed)
        self._contact.answered()
        self._contact.went_well()
        parcel = landed.parcel
        return Step("sent", segments=len(parcel.records), events=parcel.events, bytes=parcel.size)

    def _count(self, landed: Landed) -> None:
        parcel = landed.parcel
        self._sizer.took(parcel.size, landed.way_s)
        self._meter.took(parcel.size * (1 + len(self._flights)), landed.seconds)
        for each in parcel.filled:
            self._doubts.pop(each.key, None)
            sent = self._sent.setdefault(each.key, _Sent(each.time_max))
            sent.until = max(sent.until, each.time_max)
            sent.size += each.size
            sent.events += each.end.sequence - each.after.sequence

    def _failed(self, error: CentralError | PlanError | LogUnavailable) -> Step:
        """After a failure: forget what was believed of central, and pause."""
        self._standing.doubt()
        self._outbox.forget()
        self._state = "waiting"
        if isinstance(error, Refused) and error.code in _FOR_GOOD:
            self._stop_refused(error)
        return Step("failed", self._contact.pause_after(error), error=error)

    def _doubted_or_stopped(self, error: StreamStopped) -> Step:
        """Stop the stream if two hellos lead to the same: one answer alone may have been damaged on its way."""
        key = StreamKey(error.stream, error.epoch)
        if self._doubts.get(key) != str(error):
            self._doubts[key] = str(error)
            self._standing.doubt()
            self._outbox.forget()
            return Step("doubted", self._pace.backoff_s)
        if isinstance(error, HeadsDisagree) and error.is_past:
            self._standing.apart[key] = error
            return Step("stopped")
        self._standing.stopped[key] = error
        return Step("stopped", error=error)

    def _stop_refused(self, error: Refused) -> None:
        """Stop the stream whose segment is refused for what it says, so that the others go on."""
        if error.stream is not None and error.epoch is not None:
            refused = SegmentRefused(error.stream, error.epoch, error.first_sequence or 0, str(error))
            self._standing.stopped[StreamKey(error.stream, error.epoch)] = refused


@dataclass(slots=True)
class _Sent:
    """What this daemon has sent of a stream."""

    until: datetime
    size: int = 0
    events: int = 0


@dataclass(frozen=True, slots=True)
class _Terms:
    """What central said at the last hello."""

    at: float = 0.0
    """by the daemon's steady clock"""
    named: frozenset[StreamKey] = frozenset()
    body_bytes_max: int = 1
    segments_max: int = 1
    token_until: float | None = None

    @classmethod
    def of(cls, answer: HelloAnswer, at: float, named: set[StreamKey]) -> "_Terms":
        """The terms that the answer says; a token is renewed before it ends."""
        until = at + 0.9 * answer.token_expires_s if answer.token_expires_s else None
        return cls(at, frozenset(named), answer.body_bytes_max, answer.segments_max, until)


def _told(cursors: Sequence[Cursor]) -> dict[StreamKey, Runs]:
    """What central holds, as it says.

    Raises:
        BadAnswer: It cannot be.
    """
    told = {cursor.key: tuple(map(RunState.run, cursor.runs)) for cursor in cursors}
    for key, runs in told.items():
        ends = [end for run in runs for end in (run.after, run.sequence)]
        if any(low >= high for low, high in pairwise(ends)):
            raise BadAnswer(f"what answers says that it holds events {ends} of {key.stream}, which do not ascend")
    return told
