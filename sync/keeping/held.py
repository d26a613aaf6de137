"""What a log holds of a station's streams, as runs.

Contract: reads only; a stream that holds nothing is not there.
"""

from collections.abc import Iterable

from events import Station, StreamName
from store import Log
from sync.runs import Runs, StreamKey


def held_of(log: Log, station: Station) -> dict[StreamKey, Runs]:
    """The runs of each of the station's streams in which the log holds events.

    Raises:
        LogUnavailable: The database is away.
    """
    return {StreamKey(*place): tuple(runs) for place, runs in log.all_runs(station=station).items() if runs}


def runs_of(log: Log, keys: Iterable[StreamKey]) -> dict[StreamKey, Runs]:
    """The runs of each of these streams; none where the log holds nothing of it.

    Raises:
        LogUnavailable: The database is away.
    """
    wanted = list(keys)
    runs = log.some_runs(wanted)
    return {key: tuple(runs.get(key, ())) for key in wanted}


def hash_at(log: Log, stream: StreamName, epoch: int, sequence: int) -> bytes | None:
    """The chain hash of the segment that ends there; None where none does here.

    Raises:
        ChainBroken: The segment cannot be read.
        LogUnavailable: The database is away.
    """
    segment = next(log.read(stream, sequence, epoch=epoch, with_hollow=True), None)
    return None if segment is None or segment.header.last_sequence != sequence else segment.chain_hash
