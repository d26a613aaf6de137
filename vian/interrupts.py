"""Ctrl-C and SIGTERM: an interrupt that Python swallowed is made again; services get an event instead.

Python raises `KeyboardInterrupt` wherever the program happens to be. In a weak reference's callback or in
`__del__` it can go nowhere: Python prints it and goes on as if nobody had asked to stop.
"""

import os
import signal
import sys
import threading
from types import FrameType

_AGAIN_S = 0.01
"""Seconds until a swallowed interrupt is made again: the callback that swallowed it has returned by then."""


def keep_interrupts() -> None:
    """Make an interrupt again where Python could only ignore it."""
    sys.unraisablehook = _again


def stop_on_signals() -> threading.Event:
    """An event that SIGINT or SIGTERM sets, for what ends when it is told to and not by itself."""
    stopping = threading.Event()

    def stop(_number: int, _frame: FrameType | None) -> None:
        stopping.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    return stopping


def _again(ignored: "sys.UnraisableHookArgs") -> None:
    if ignored.exc_type is KeyboardInterrupt:
        # By a true signal from another thread: raised here it would be swallowed once more.
        threading.Timer(_AGAIN_S, os.kill, (os.getpid(), signal.SIGINT)).start()
    else:
        sys.__unraisablehook__(ignored)
