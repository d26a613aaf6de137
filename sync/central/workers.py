"""Workers: the threads in which central checks and stores what stations send.

Contract: as many large bodies are worked at as there are processors, for Python's threads share one lock: more of
them take memory and make all slower. Who sends, and small bodies, have threads of their own, so that an alert does
not wait behind the backlogs of other stations. In order of arrival.
"""

import asyncio
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

from sync.central.room import SMALL_BYTES

_SMALL_THREADS = 2

T = TypeVar("T")


class Workers:
    """The threads of one central server."""

    def __init__(self) -> None:
        self._small = ThreadPoolExecutor(_SMALL_THREADS, "vian-central-small")
        self._large = ThreadPoolExecutor(max(2, os.cpu_count() or 1), "vian-central-large")

    async def do(self, work: Callable[[], T], size: int = 0) -> T:
        """What the work gives, which is on a body of so many bytes."""
        threads = self._small if size <= SMALL_BYTES else self._large
        return await asyncio.get_running_loop().run_in_executor(threads, work)
