"""Whether what central holds of an earlier epoch goes on from what this station has, where central has more of it.

Contract: a station whose disk was put back may have another history of the epoch before, and both may be long. Heads
alone cannot tell then, so central is asked for its segment where this station's history of that epoch ends. That
never changes any more, so once is enough. Nothing is changed here or there.
"""

from store import StreamHead
from sync.errors import HeadsDisagree, Refused
from sync.protocol.wire import Range
from sync.runs import Point
from sync.station.client import Link


def is_open(here: StreamHead, there: Point, epoch: int) -> bool:
    """Whether the heads alone cannot tell.

    Args:
        here: The stream's head at this station.
        there: What central has newest of it.
        epoch: The log's own.
    """
    return here.epoch < epoch and there.sequence > here.sequence > 0


def check_beyond(link: Link, here: StreamHead) -> None:
    """Nothing, if central has the segment with which this station's history of an earlier epoch ends, or cannot say.

    Raises:
        HeadsDisagree: It has another there.
        CentralError: It gives no answer.
    """
    ending = Range(stream=str(here.stream), epoch=here.epoch, first_sequence=here.sequence, last_sequence=here.sequence)
    try:
        segments = link.read(ending)
    except Refused as error:
        if error.code != "not_held":
            raise
        return
    for segment in segments:
        header, end = segment.header, (segment.header.last_sequence, segment.chain_hash)
        is_its = (segment.stream, header.epoch) == (here.stream, here.epoch)
        if is_its and header.first_sequence <= here.sequence <= header.last_sequence and end != _end(here):
            chain_hash = here.chain_hash if header.last_sequence == here.sequence else None
            raise HeadsDisagree(here.stream, here.epoch, header.last_sequence, chain_hash, segment.chain_hash, True)


def _end(here: StreamHead) -> tuple[int, bytes]:
    return here.sequence, here.chain_hash
