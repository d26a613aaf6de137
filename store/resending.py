"""A re-sent segment whose original lies in a sealed file: acknowledged or refused as if it had stayed.

Contract: pure; the append function in the database cannot read files, so its client compares.
"""

from events import Draft, Segment
from store.errors import ChainBroken, SequenceConflict
from store.writing import Appended


def acknowledged(
    draft: Draft, first_sequence: int, head: int, stored: Segment | None, chain_hash: bytes | None
) -> Appended:
    """Where the original stands.

    Args:
        draft: What was sent again.
        first_sequence: Where in its stream it was said to begin.
        head: Where the stream stands.
        stored: The sealed segment that holds that event.
        chain_hash: The chain hash that must come out, if the sender gave one.

    Raises:
        SequenceConflict: The stream holds other bytes there.
        ChainBroken: The chain hash is another, or the file lacks what the index says it holds.
    """
    if stored is None:
        raise ChainBroken(draft.stream, None, first_sequence, "the archive's index names a file that lacks it")
    header = stored.header
    if header.first_sequence != first_sequence or stored.payload_hash != draft.payload_hash:
        raise SequenceConflict(
            draft.stream,
            first_sequence - 1,
            head,
            stored.payload_hash.hex(),
            draft.payload_hash.hex(),
        )
    if chain_hash is not None and chain_hash != stored.chain_hash:
        raise ChainBroken(draft.stream, None, first_sequence, "the chain hash differs from the one that was sent")
    return Appended(stored.position, first_sequence, stored.chain_hash, was_there=True)
