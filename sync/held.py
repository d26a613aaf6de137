"""What a log holds of a station's streams, as runs.

Contract: reads only; a stream that holds nothing is not there.
"""

from collections.abc import Iterable

from events import Station
from store import Log
from sync.runs import Run, StreamKey

_ZEROS = bytes(32)


def held_of(log: Log, station: Station) -> dict[StreamKey, tuple[Run, ...]]:
    """The runs of each of the station's streams in which the log holds events.

    Raises:
        LogUnavailable: The database is away.
    """
    return {
        StreamKey(head.stream, head.epoch): (Run(0, _ZEROS, head.sequence, head.chain_hash),)
        for head in log.streams()
        if head.stream.station == station and head.sequence
    }


def runs_of(log: Log, keys: Iterable[StreamKey]) -> dict[StreamKey, tuple[Run, ...]]:
    """The runs of each of these streams; none where the log holds nothing of it.

    Raises:
        LogUnavailable: The database is away.
    """
    heads = {key: log.stream_head(key.stream, epoch=key.epoch) for key in keys}
    return {
        key: (Run(0, _ZEROS, head.sequence, head.chain_hash),) if head.sequence else () for key, head in heads.items()
    }
