"""What central signs when it countersigns a checkpoint, to the byte (docs/reference/sync.md).

Contract: pure functions. Central says of each stream of the checkpoint from where to where it holds it: all of it, or
what lies behind a base. A signature in which no stream has a base is laid out as before there were any, so whoever
knows only those goes on reading most.
"""

import hashlib
import json
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from events import GENESIS, CheckpointCountersigned, EventError, StreamName
from events.segment import microseconds, text_bytes
from store import StreamHead
from store.keys import is_signed
from store.proof import ALGORITHM, head_bytes, head_rows, heads_hash, key_id

MAGIC = b"VIANCSG1"
"""Every stream is held from its first event on."""
MAGIC_BASES = b"VIANCSG2"
"""Some streams are held from a base on."""
HELD_MAGIC = b"VIANHLD1"
_HASH_BYTES = 32


@dataclass(frozen=True, slots=True, order=True)
class Held:
    """A stream that central holds from one event on up to a head of the checkpoint."""

    head: StreamHead
    after: int = 0
    """what it holds begins behind this sequence; 0: it holds all"""
    after_hash: bytes = GENESIS
    """chain hash there"""

    def holds(self, first_sequence: int, last_sequence: int) -> bool:
        """Whether it holds these events."""
        return self.after < first_sequence and last_sequence <= self.head.sequence


def countersigned_bytes(
    station: str, sequence: int, statement: bytes, held: Sequence[Held], time: datetime, public_key: bytes
) -> bytes:
    """What central signs.

    Args:
        station: Whose checkpoint it is.
        sequence: Of the event checkpoint_signed.
        statement: Hash of the station's statement.
        held: What central holds.
        time: When it signs.
        public_key: Central's raw public key.
    """
    has_bases = any(each.after for each in held)
    return b"".join(
        (
            MAGIC_BASES if has_bases else MAGIC,
            text_bytes(station),
            struct.pack(">Q", sequence),
            statement,
            held_hash(held) if has_bases else heads_hash(each.head for each in held),
            struct.pack(">q", microseconds(time)),
            public_key,
        )
    )


def held_hash(held: Iterable[Held]) -> bytes:
    """SHA-256 over what is held, bases included, in the order of the heads."""
    parts = [
        head_bytes(each.head) + struct.pack(">Q", each.after) + each.after_hash for each in sorted(held, key=_by_name)
    ]
    return hashlib.sha256(b"".join((HELD_MAGIC, struct.pack(">I", len(parts)), *parts))).digest()


def is_countersigned(event: CheckpointCountersigned, public_key: bytes) -> bool:
    """Whether the event's signature is that of central's key, over all that the event says."""
    try:
        said = countersigned_bytes(
            event.of_station,
            event.checkpoint_sequence,
            bytes.fromhex(event.statement_hash),
            held_in(event.held),
            event.time,
            public_key,
        )
    except (ValueError, struct.error):
        return False
    is_named = event.key_id == key_id(public_key) and event.algorithm == ALGORITHM
    return is_named and is_signed(public_key, event.signature, said)


def held_text(held: Iterable[Held]) -> str:
    """What is held as JSON text; a stream with a base has its sequence and chain hash behind its head."""
    rows = []
    for each in sorted(held, key=_by_name):
        (row,) = head_rows([each.head])
        rows.append([*row, each.after, each.after_hash.hex()] if each.after else row)
    return json.dumps(rows, separators=(",", ":"))


def held_in(text: str) -> list[Held]:
    """What the JSON text says that is held.

    Raises:
        ValueError: It says nothing of the kind.
    """
    try:
        return [_held(*row) for row in json.loads(text)]
    except (TypeError, EventError) as error:
        raise ValueError(f"no heads: {error}") from error


def _held(
    station: str,
    epoch: Any,
    source: str,
    type_: str,
    sequence: Any,
    chain_hash: str,
    after: Any = 0,
    after_hash: str = GENESIS.hex(),
) -> Held:
    head = StreamHead(StreamName.of(station, source, type_), int(epoch), int(sequence), bytes.fromhex(chain_hash))
    held = Held(head, int(after), bytes.fromhex(after_hash))
    if not 0 <= held.after < head.sequence or len(held.after_hash) != _HASH_BYTES:
        raise ValueError(f"no range of {head.stream}: behind {after} up to {sequence}")
    return held


def _by_name(held: Held) -> tuple[StreamName, int, int]:
    return held.head.stream, held.head.epoch, held.head.sequence
