"""Up to where a derived stream is old: the state of the checkpoint under which it is made."""

import struct

_MARK = struct.Struct(">Q32s")


def mark_state(sequence: int, chain_hash: bytes) -> bytes:
    """The state of a checkpoint that says up to where its derived stream was made of what was old already."""
    return _MARK.pack(sequence, chain_hash)


def mark_in(state: bytes) -> tuple[int, bytes] | None:
    """The sequence and the chain hash there that a state says; None while all that is made is old."""
    return _MARK.unpack(state) if state else None
