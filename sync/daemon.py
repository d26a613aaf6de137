"""The station's side: a daemon that one can step by hand.

Contract: `step` does one bounded thing (log the plan, say hello, send one request, or find nothing to
do) and says what, and how long it may sleep. Central holds the cursors and the log the segments, so
the daemon keeps nothing that a kill could lose. After any doubt (no answer, a refusal, a failure) it
says hello again before it sends. Clock and randomness are passed in.

Order: of the streams with a backlog, the smallest priority number first; among equals the one that
waited longest. A stream whose history differs from central's, as two hellos say, is stopped; the others go on.
"""

import threading
from collections.abc import Callable
from datetime import datetime

import httpx

from events import EventError, Producer, Station, StreamName, SyncPlanned, batch_of, decode, encode, events_of
from store import Log, LogUnavailable, SequenceConflict, StreamHead
from sync.bell import Bell
from sync.client import Central
from sync.errors import (
    BadAnswer,
    CentralError,
    NotAuthorised,
    PlanError,
    ProtocolMismatch,
    Refused,
    SegmentRefused,
    StreamStopped,
)
from sync.outbox import Capacity, Outbox, Parcel, StreamKey, check_heads, key_of
from sync.plan import Plan
from sync.reports import Pace, Status, Step, StreamStatus
from sync.wire import STREAMS_MAX, program
from sync.wire_v1 import PROTOCOL, Hello, SegmentsAnswer, StreamState

PRODUCER = "sync"
PRODUCER_VERSION = "1"


class Daemon:
    """Sends a station's planned streams to central.

    Args:
        log: The station's log.
        station: Whose streams they are.
        plan: Which streams, in which order.
        client: Has central's address as `base_url`, and a timeout.
        token: The station's token.
        now: The station's clock, aware.
        random: Numbers from 0 to 1, which spread the stations' retries.
        pace: How much at a time, how long between.

    Raises:
        PlanError: No entry of the plan can fit a stream of this station.
        GrantError: The token cannot be one.
    """

    def __init__(
        self,
        log: Log,
        station: Station,
        plan: Plan,
        client: httpx.Client,
        *,
        token: str,
        now: Callable[[], datetime],
        random: Callable[[], float],
        pace: Pace | None = None,
    ) -> None:
        if not any(entry.fits_station(station) for entry in plan.entries):
            raise PlanError(f"the plan names no stream of station {station}; write */... or {station}/... in an entry")
        self._log = log
        self._station = station
        self._plan = plan
        self._central = Central(client, token)
        self._now = now
        self._random = random
        self._pace = pace or Pace()
        self._outbox = Outbox(log)
        self._priorities: dict[StreamName, int | None] = {}
        self._is_planned = False
        self._is_log_away = False
        self._cursors: dict[StreamKey, StreamHead] | None = None
        self._capacity = Capacity(self._pace.request_bytes, 0, 0)
        self._stopped: dict[StreamKey, StreamStopped] = {}
        self._doubts: dict[StreamKey, str] = {}
        self._turns: dict[StreamKey, int] = {}
        self._turn = 0
        self._failures = 0
        self._last_error: str | None = None
        self._last_contact: datetime | None = None
        self._clock_offset_s: float | None = None

    def step(self) -> Step:
        """Do one bounded thing, and say what it was."""
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

    def run(self, stop: threading.Event, on_step: Callable[[Step], None] | None = None) -> None:
        """Step until `stop` is set; sleep between steps until the log grows or a pause is over.

        Args:
            stop: Set it to end; it ends within a second, or when a request's timeout is over.
            on_step: Told of every step.
        """
        bell = Bell(self._log, self._station)
        try:
            while not stop.is_set():
                bell.arm()
                step = self.step()
                if on_step is not None:
                    on_step(step)
                if step.did == "nothing":
                    bell.wait(step.sleep_s, stop)
                elif step.sleep_s:
                    stop.wait(step.sleep_s)
        finally:
            bell.close()

    def catch_up(self) -> int:
        """Number of events sent until nothing was left to do.

        Raises:
            SyncError: A step failed or a stream was stopped; what was acknowledged stays at central.
            LogUnavailable: The station's database is away.
        """
        events = 0
        while (step := self.step()).did != "nothing":
            if step.error is not None:
                raise step.error
            events += step.events
        return events

    def status(self) -> Status:
        """Where each planned stream stands, by the station's log and central's last word.

        Raises:
            LogUnavailable: The station's database is away.
        """
        cursors = self._cursors or {}
        streams = []
        for priority, head in self._planned():
            cursor, stopped = cursors.get(key_of(head)), self._stopped.get(key_of(head))
            streams.append(
                StreamStatus(
                    head.stream,
                    head.epoch,
                    priority,
                    head.sequence,
                    cursor.sequence if cursor else None,
                    max(0, head.sequence - cursor.sequence) if cursor else None,
                    str(stopped) if stopped else None,
                )
            )
        return Status(
            self._station,
            self._central.address,
            tuple(streams),
            self._last_contact,
            self._clock_offset_s,
            self._failures,
            self._last_error,
        )

    def _do(self) -> Step:
        if not self._is_planned:
            return self._log_plan()
        planned = self._planned()
        cursors = self._cursors
        if cursors is None or any(key_of(head) not in cursors for _, head in planned):
            return self._hello([head for _, head in planned])
        return self._send(planned, cursors)

    def _log_plan(self) -> Step:
        """Append the plan to the station's log, unless it is what the log says already."""
        stream = StreamName.of(self._station, "sync", SyncPlanned.type_name)
        head = self._log.stream_head(stream)
        plan_hash = self._plan.plan_hash
        if self._newest_plan(head) != (self._central.address, plan_hash.hex()):
            event = SyncPlanned(
                time=self._now(), central=self._central.address, plan=self._plan.canonical(), plan_hash=plan_hash.hex()
            )
            draft = encode(stream, batch_of([event]), Producer(PRODUCER, PRODUCER_VERSION, plan_hash))
            try:
                self._log.append([draft], [head.sequence])
            except SequenceConflict:
                return Step("planned")  # Another daemon of this station was faster: look again.
        self._is_planned = True
        return Step("planned")

    def _newest_plan(self, head: StreamHead) -> tuple[str, str] | None:
        """Address and hash of the plan that the log names last; None if there is none that reads."""
        for segment in self._log.read(head.stream, head.sequence, epoch=head.epoch) if head.sequence else ():
            try:
                event = events_of(decode(segment, self._log.catalogue))[-1]
            except EventError:
                return None  # A newer ViAn wrote it, or it is damaged: the plan is said once more.
            assert isinstance(event, SyncPlanned)
            return event.central, event.plan_hash
        return None

    def _hello(self, heads: list[StreamHead]) -> Step:
        asked = self._now()
        answer = self._central.hello(
            Hello(
                protocol=PROTOCOL,
                program=program(),
                station=self._station,
                epoch=self._log.epoch,
                time=asked,
                streams=tuple(map(StreamState.of, heads)),
            )
        )
        cursors = {key_of(state.head()): state.head() for state in answer.cursors}
        unanswered = [str(head.stream) for head in heads if key_of(head) not in cursors]
        if unanswered:
            raise BadAnswer(f"central at {self._central.address} gave no cursor for {', '.join(unanswered[:5])}")
        self._outbox.forget()
        self._cursors = cursors
        wanted = min(self._pace.request_bytes, answer.body_bytes_max)
        self._capacity = Capacity(wanted, answer.body_bytes_max, answer.segments_max)
        self._last_contact = self._now()
        self._clock_offset_s = (answer.time - asked).total_seconds()
        return Step("hello")

    def _send(self, planned: list[tuple[int, StreamHead]], cursors: dict[StreamKey, StreamHead]) -> Step:
        parcel = self._outbox.fill(self._queue(planned, cursors), self._capacity)
        if not parcel.segments:
            self._went_well()
            return Step("nothing", self._pace.idle_s)
        self._acknowledged(parcel, self._central.send(parcel.body), cursors)
        return Step("sent", segments=parcel.segments, events=parcel.events, bytes=len(parcel.body))

    def _acknowledged(self, parcel: Parcel, answer: SegmentsAnswer, cursors: dict[StreamKey, StreamHead]) -> None:
        stands = {key_of(state.head()): state.head() for state in answer.cursors}
        for key, end in parcel.ends.items():
            if key not in stands or stands[key].sequence < end.sequence:
                raise BadAnswer(
                    f"central at {self._central.address} acknowledged segments of {key[0]} up to {end.sequence}, "
                    "but names no cursor there"
                )
        self._turn += 1
        for key in parcel.ends:
            cursors[key] = stands[key]
            self._doubts.pop(key, None)
            self._turns[key] = self._turn
        self._last_contact = self._now()
        self._went_well()

    def _queue(self, planned: list[tuple[int, StreamHead]], cursors: dict[StreamKey, StreamHead]) -> list[StreamHead]:
        """The cursors of the streams with a backlog, in the order in which they are served."""
        waiting = []
        for priority, head in planned:
            key = key_of(head)
            if key in self._stopped:
                continue
            if head.epoch < self._log.epoch and cursors[key].sequence > head.sequence:
                continue  # of before a restore: central has what came after the backup, and keeps it
            check_heads(head, cursors[key])
            if cursors[key].sequence < head.sequence:
                waiting.append(((priority, self._turns.get(key, 0), head.stream, head.epoch), cursors[key]))
        return [cursor for _, cursor in sorted(waiting, key=lambda each: each[0])]

    def _planned(self) -> list[tuple[int, StreamHead]]:
        """This station's streams that the plan sends, with their priority."""
        planned = []
        for head in self._log.streams():
            if head.stream.station != self._station or not head.sequence:
                continue
            if head.stream not in self._priorities:
                self._priorities[head.stream] = self._plan.priority_of(head.stream)
            priority = self._priorities[head.stream]
            if priority is not None:
                planned.append((priority, head))
        if len(planned) > STREAMS_MAX:
            raise PlanError(f"the plan names {len(planned)} streams of this station, at most {STREAMS_MAX} can be sent")
        return planned

    def _went_well(self) -> None:
        self._failures = 0
        if not self._stopped:
            self._last_error = None

    def _failed(self, error: CentralError | PlanError | LogUnavailable) -> Step:
        """After a failure: forget what was believed of central, and pause."""
        self._cursors = None
        self._outbox.forget()
        self._failures += 1
        self._last_error = str(error)
        if isinstance(error, Refused) and error.code == "false_header":
            self._stop_refused(error)
        if isinstance(error, NotAuthorised | ProtocolMismatch | PlanError):
            pause = self._pace.backoff_s_max  # Only a person can change that.
        else:
            pause = min(self._pace.backoff_s_max, self._pace.backoff_s * 2 ** min(self._failures - 1, 30))
        return Step("failed", pause * (0.5 + self._random() / 2), error=error)

    def _doubted_or_stopped(self, error: StreamStopped) -> Step:
        """Stop the stream if two hellos lead to the same: one answer alone may have been damaged on its way."""
        key = error.stream, error.epoch
        if self._doubts.get(key) != str(error):
            self._doubts[key] = str(error)
            self._cursors = None
            self._outbox.forget()
            return Step("doubted", self._pace.backoff_s)
        self._stopped[key] = error
        self._last_error = str(error)
        return Step("stopped", error=error)

    def _stop_refused(self, error: Refused) -> None:
        """Stop the stream whose segment is refused for what it says, so that the others go on."""
        if error.stream is not None and error.epoch is not None:
            refused = SegmentRefused(error.stream, error.epoch, error.first_sequence or 0, str(error))
            self._stopped[error.stream, error.epoch] = refused
