"""What the processor may use, how often it saves, and what it takes for a rule or a clock gone wrong."""

from dataclasses import dataclass, field
from datetime import timedelta

from patterns.limits import Limits


@dataclass(frozen=True, slots=True)
class ProcessorLimits:
    """Settings of the processor.

    Attributes:
        segments: Segments read at a time.
        events_together: Events that rules are given at once; their segments are judged one by one all the same.
        save_every_s: Longest time between two saves of what the rules remember, in seconds, while events come.
        save_every_events: Most events between two saves.
        ahead: How far behind what a source sent before, and behind the log's own clock, an event's time may
            be; one further ahead takes part in no match. None: any time is believed.
        event_us: What a rule may take for one event, in microseconds, over a window of events; None: no limit.
        window_events: Events that a window has at least.
        slow_windows: Windows in a row over the limit after which a rule is set aside.
        rules: What each rule may use.
        finish: How long, in event time, a retired version without WITHIN may still finish what it began.
    """

    segments: int = 200
    events_together: int = 65_536
    save_every_s: float = 30.0
    save_every_events: int = 1_000_000
    ahead: timedelta | None = timedelta(days=1)
    event_us: float | None = 1_000.0
    window_events: int = 1_000
    slow_windows: int = 10
    rules: Limits = field(default_factory=Limits)
    finish: timedelta = timedelta(days=1)
