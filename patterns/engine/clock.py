"""Event time: how far the sources have come, and so which rows are final.

The watermark is the least of the live sources' newest times, less the
lateness; it never goes back. A source that has not spoken yet holds nothing. A
source that ended, or has been silent for the idle time, holds nothing either.
When every live source is silent, all that has arrived is final.
"""

from dataclasses import asdict, dataclass, field
from typing import Any

_BEFORE_ALL_US = -(2**62)
"""The newest time of a source that has sent nothing."""


@dataclass(slots=True)
class SourceTime:
    """How far one source has come.

    Attributes:
        newest_us: The newest time that it has sent.
        has_ended: Whether it will send no more.
        has_spoken: Whether it has sent anything since idleness was last looked at.
        quiet_since_us: When, by the clock on the wall, it was last known to speak.
        is_idle: Whether it has been silent for the idle time.
    """

    newest_us: int
    has_ended: bool = False
    has_spoken: bool = True
    quiet_since_us: int | None = None
    is_idle: bool = False


@dataclass(slots=True)
class Clock:
    """The sources' times and the watermark, in microseconds.

    Attributes:
        lateness_us: How much older than its source's newest a row may be.
        idle_us: After how long a silent source holds nothing; None: never.
        watermark_us: No row before it is still to come; None: nothing is known yet.
        sources: By name.
    """

    lateness_us: int
    idle_us: int | None
    watermark_us: int | None = None
    sources: dict[str, SourceTime] = field(default_factory=dict)

    def observe(self, source: str, newest_us: int, *, revives: bool = True) -> None:
        """The source has sent rows up to this time.

        Args:
            source: The source.
            newest_us: The newest time among them.
            revives: Whether a source that had ended is live again. Situations do not make it so: they
                come after the end of the source that they are about.
        """
        known = self.sources.get(source)
        if known is None:
            self.sources[source] = SourceTime(newest_us)
            return
        known.newest_us = max(known.newest_us, newest_us)
        if known.has_ended and not revives:
            return
        known.has_ended = known.is_idle = False
        known.has_spoken = True

    def end(self, source: str) -> bool:
        """The source will send no more; whether all sources have now ended."""
        if source in self.sources:
            self.sources[source].has_ended = True
        return bool(self.sources) and all(each.has_ended for each in self.sources.values())

    def end_unheard(self, source: str) -> None:
        """The source will send no more, whether it has sent anything or not: situations about it may still come."""
        self.sources.setdefault(source, SourceTime(_BEFORE_ALL_US)).has_ended = True

    def have_ended(self, apart: str) -> bool:
        """Whether there are sources, and all but this one will send no more."""
        ended = [each.has_ended for name, each in self.sources.items() if name != apart]
        return bool(ended) and all(ended)

    def look_for_idle(self, now_us: int) -> None:
        """Marks the sources that have been silent for the idle time, by the clock on the wall."""
        for source in self.sources.values():
            if source.has_spoken or source.quiet_since_us is None:
                source.has_spoken = False
                source.quiet_since_us = now_us
            elif self.idle_us is not None and now_us - source.quiet_since_us >= self.idle_us:
                source.is_idle = True

    def advance(self) -> int | None:
        """The watermark, after what was observed."""
        live = [source for source in self.sources.values() if not source.has_ended]
        holding = [source.newest_us for source in live if not source.is_idle]
        if holding:
            reached = min(holding) - self.lateness_us
        elif live:
            reached = max(source.newest_us for source in self.sources.values()) + 1
        else:
            return self.watermark_us
        self.watermark_us = reached if self.watermark_us is None else max(self.watermark_us, reached)
        return self.watermark_us

    def newest_us(self) -> int:
        """The newest time that any source has sent; 0 when none has."""
        return max((source.newest_us for source in self.sources.values()), default=0)

    def reset(self) -> None:
        """Forgets all sources: their input has ended, and what comes next begins anew."""
        self.sources.clear()
        self.watermark_us = None

    def to_json(self) -> dict[str, Any]:
        """What `restored` takes."""
        return {
            "watermark_us": self.watermark_us,
            "sources": {name: asdict(source) for name, source in self.sources.items()},
        }

    def restore(self, saved: dict[str, Any]) -> None:
        """Goes on from what `to_json` gave."""
        self.watermark_us = saved["watermark_us"]
        self.sources = {name: SourceTime(**source) for name, source in saved["sources"].items()}
