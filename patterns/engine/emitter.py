"""Which matches become situations: `once_per` and `cooldown`, in event time.

Matches come in the order of the times that decided them, so the same rows give
the same situations however they arrived. A match is held back when its key had
a situation less than the cooldown before; what is held back extends nothing.
"""

from typing import Any

from patterns.binding.rows import findable
from patterns.durations import microseconds
from patterns.engine.situations import Match, as_microseconds
from patterns.files.rule import EmitSettings


class Emitter:
    """Remembers, by key, when the last situation was; `held_back` counts the matches that were not emitted."""

    def __init__(self, settings: EmitSettings) -> None:
        self.once_per = settings.once_per
        self.cooldown_us = None if settings.cooldown is None else microseconds(settings.cooldown)
        self.is_open = settings.once_per is None and settings.cooldown is None
        self.last_us: dict[tuple[Any, ...], int] = {}
        self.held_back = 0

    def lets_through(self, match: Match, now_us: int) -> bool:
        """Whether the match, decided at this time, becomes a situation."""
        if self.is_open:
            return True
        key = self._key(match)
        last_us = self.last_us.get(key)
        if last_us is not None and (self.cooldown_us is None or now_us < last_us + self.cooldown_us):
            self.held_back += 1
            return False
        self.last_us.pop(key, None)
        self.last_us[key] = now_us
        return True

    def forget(self, watermark_us: int) -> None:
        """Forgets keys whose cooldown is over at this time; the oldest come first."""
        if self.cooldown_us is None:
            return
        over = []
        for key, last_us in self.last_us.items():
            if last_us + self.cooldown_us > watermark_us:
                break
            over.append(key)
        for key in over:
            del self.last_us[key]

    def reset(self) -> None:
        """Forgets running cooldowns; what is once for good stays."""
        if self.cooldown_us is not None:
            self.last_us.clear()

    def to_json(self) -> dict[str, Any]:
        """What `restore` takes."""
        return {"held_back": self.held_back, "last_us": [[list(key), last] for key, last in self.last_us.items()]}

    def restore(self, saved: dict[str, Any]) -> None:
        """Goes on from what `to_json` gave."""
        self.held_back = saved["held_back"]
        self.last_us = {findable(key): last for key, last in saved["last_us"]}

    def _key(self, match: Match) -> tuple[Any, ...]:
        values = {**match.measures, **match.partition}
        names = match.partition if self.once_per is None else self.once_per
        return findable(as_microseconds(values[name]) for name in names)
