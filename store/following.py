"""Following chains where a fault ends the matter: backup, restore, sealing.

Contract: pure; whoever goes on behind a fault takes `store.walk`.
"""

from events import Chains, Segment
from store.errors import ChainBroken


def follow(chains: Chains, segment: Segment) -> None:
    """Take the segment as the next one.

    Raises:
        ChainBroken: It is not what its hashes say, or does not follow.
    """
    fault = chains.follow(segment)
    if fault is not None:
        raise ChainBroken(segment.stream, segment.position, segment.header.first_sequence, fault.reason)
