"""How messages leave the decoding process: straight on, or through a queue of the newest pictures.

Contract: messages keep their order. `Straight` waits for the parent. `Newest` never waits: when its queue is
full the oldest picture in it is left out, and counted; nothing but pictures is ever left out.
"""

import threading
import time
from collections import deque
from typing import Any, Protocol

from extractors.media import GapReason, Image
from extractors.wire import Header, Kind, Writable, pack, write_json

REPORT_EVERY_S = 10.0
"""Time between two reports of pictures left out, s: with too slow a machine it is most of them."""


class Outlet(Protocol):
    """Takes messages in order."""

    def frame(self, header: Header, image: Image) -> None:
        """Send a picture."""
        ...

    def json(self, kind: Kind, index: int = 0, **content: Any) -> None:
        """Send a message of text and numbers."""
        ...

    def close(self) -> None:
        """Send what waits; returns when it is gone."""
        ...


class Straight:
    """Writes each message at once, and waits where the parent does not read."""

    def __init__(self, out: Writable) -> None:
        self._out = out

    def frame(self, header: Header, image: Image) -> None:
        """Write the picture."""
        self._out.write(pack(header))
        self._out.write(image.data.cast("B"))

    def json(self, kind: Kind, index: int = 0, **content: Any) -> None:
        """Write the message."""
        write_json(self._out, kind, index, **content)

    def close(self) -> None:
        """Nothing waits."""


class Newest:
    """Writes in a thread of its own; of pictures that wait, only the newest are kept."""

    def __init__(self, out: Writable, frames_max: int) -> None:
        self._straight = Straight(out)
        self._flush = getattr(out, "flush", None)
        self._frames_max = frames_max
        self._waiting: deque[tuple[Header, Image] | tuple[Kind, int, dict[str, Any]]] = deque()
        self._frames = 0
        self._dropped = 0
        self._report_due_s = 0.0
        self._is_closed = False
        self._error: BaseException | None = None
        self._changed = threading.Condition()
        self._writer = threading.Thread(target=self._write_all, daemon=True)
        self._writer.start()

    def frame(self, header: Header, image: Image) -> None:
        """Queue the picture; leave the oldest one out where there are too many."""
        with self._changed:
            self._check()
            if self._frames == self._frames_max:
                self._drop_oldest()
            self._waiting.append((header, image))
            self._frames += 1
            self._report(header.index + 1)
            self._changed.notify_all()

    def json(self, kind: Kind, index: int = 0, **content: Any) -> None:
        """Queue the message; the end is preceded by what was left out."""
        with self._changed:
            self._check()
            if kind is Kind.END:
                self._report_due_s = 0.0
                self._report(index)
            self._waiting.append((kind, index, content))
            self._changed.notify_all()

    def close(self) -> None:
        """Wait until all is written."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._writer.join()
        self._check()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error

    def _drop_oldest(self) -> None:
        at = next(i for i, waiting in enumerate(self._waiting) if isinstance(waiting[0], Header))
        del self._waiting[at]
        self._frames -= 1
        self._dropped += 1

    def _report(self, index: int) -> None:
        if not self._dropped or time.monotonic() < self._report_due_s:
            return
        detail = f"{self._dropped} pictures were left out: they came faster than they were worked on"
        self._waiting.append((Kind.GAP, index, {"reason": GapReason.DROPPED, "detail": detail}))
        self._dropped, self._report_due_s = 0, time.monotonic() + REPORT_EVERY_S

    def _write_all(self) -> None:
        try:
            while (message := self._next()) is not None:
                if isinstance(message[0], Header):
                    self._straight.frame(*message)
                else:
                    kind, index, content = message
                    self._straight.json(kind, index, **content)
                if self._flush is not None:
                    self._flush()
        except BaseException as error:  # told to who sends next
            with self._changed:
                self._error = error

    def _next(self) -> tuple[Header, Image] | tuple[Kind, int, dict[str, Any]] | None:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._is_closed)
            if not self._waiting:
                return None
            message = self._waiting.popleft()
            self._frames -= isinstance(message[0], Header)
            return message
