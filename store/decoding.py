"""Many segments decoded at once: the hot road from the log to columns.

Contract: what comes out is in the order of what went in, each segment with its events, or with why this
program does not know them: the caller decides whether it goes on without. Decompression leaves Python's
lock, so a few threads decode while the database sends what follows. Memory is bounded by the chunks that
are on their way.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from itertools import islice

from events import Catalogue, EventBatch, Segment, UnknownType, decode

THREADS = 2
_CHUNK_SEGMENTS = 50
"""Handed to a thread at a time, so that the handing over costs little."""

Decoded = tuple[Segment, EventBatch | UnknownType]


def decoded(segments: Iterable[Segment], catalogue: Catalogue, threads: int = THREADS) -> Iterator[Decoded]:
    """The segments, each with its events, or with the error that its type or version is not known here.

    Args:
        segments: The segments.
        catalogue: The event types.
        threads: How many decode at once.

    Raises:
        CorruptSegment: A segment's bytes do not decode to what its header says.
    """
    remaining = iter(segments)
    with ThreadPoolExecutor(threads, thread_name_prefix="decodes") as pool:
        waiting: deque[Future[list[Decoded]]] = deque()
        while chunk := list(islice(remaining, _CHUNK_SEGMENTS)):
            waiting.append(pool.submit(_decoded, chunk, catalogue))
            if len(waiting) > threads:
                yield from waiting.popleft().result()
        while waiting:
            yield from waiting.popleft().result()


def _decoded(chunk: list[Segment], catalogue: Catalogue) -> list[Decoded]:
    return [(segment, _events(segment, catalogue)) for segment in chunk]


def _events(segment: Segment, catalogue: Catalogue) -> EventBatch | UnknownType:
    try:
        return decode(segment, catalogue)
    except UnknownType as error:
        return error
