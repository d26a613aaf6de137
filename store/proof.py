"""What a signed checkpoint says, to the byte: heads, order, statement (docs/reference/proof.md).

Contract: pure functions. A `Statement` is all that a signature covers; `statement_bytes` is its one
spelling. Every number is big-endian; a text is its length as `u16`, then UTF-8, as in a segment's header.
An event `checkpoint_signed` holds a statement and its signature; `event_of` and `checkpoint_of` lead
from one to the other and back.
"""

import hashlib
import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from events import CheckpointSigned, Sequence, Station, StreamName
from events.segment import microseconds, text_bytes
from store.errors import BadProof
from store.standing import StreamHead

SOURCE = "log"
"""Source of the stream of checkpoints: `STATION/log/checkpoint_signed`."""
ALGORITHM = "ed25519"
STATEMENT_MAGIC = b"VIANCHK1"
HEADS_MAGIC = b"VIANHDS1"
NO_HASH = bytes(32)
NO_KEY = bytes(32)
HEADS_TEXT_BYTES_MAX = 4 * 1024 * 1024
"""Most bytes of a checkpoint's heads as JSON: about 30,000 streams."""


@dataclass(frozen=True, slots=True)
class Statement:
    """What a station signs: where all streams of its log stand, and in which order and when it took them."""

    station: Station
    epoch: int
    """epoch of the log when it signed"""
    position: int
    """the log as it stood here"""
    time: datetime
    order_hash: bytes
    """see `order_hash`"""
    heads: tuple[StreamHead, ...]
    previous: bytes
    """hash of the station's statement before, 32 zero bytes for its first"""
    public_key: bytes
    """raw Ed25519 key of 32 bytes, under which the signature holds"""
    successor: bytes = NO_KEY
    """public key that may sign from now on in this one's stead; 32 zero bytes: none"""


@dataclass(frozen=True, slots=True)
class SignedCheckpoint:
    """A statement, its signature, and its place in the station's stream of checkpoints."""

    statement: Statement
    signature: bytes
    sequence: Sequence


def checkpoint_stream(station: str) -> StreamName:
    """The stream that holds a station's checkpoints."""
    return StreamName.of(station, SOURCE, CheckpointSigned.type_name)


def key_id(public_key: bytes) -> str:
    """Name of a key: the first 16 bytes of the SHA-256 of the raw public key, in hexadecimal."""
    return hashlib.sha256(public_key).hexdigest()[:32]


def order_hash(previous: bytes, position: int, recorded_at_us: int, chain_hash: bytes) -> bytes:
    """The order hash at a position: it covers position, recorded_at and chain hash of every segment up to it."""
    return hashlib.sha256(previous + struct.pack(">Qq", position, recorded_at_us) + chain_hash).digest()


def heads_hash(heads: Iterable[StreamHead]) -> bytes:
    """SHA-256 over the heads in the order of station, source, type, epoch, sequence."""
    parts = [head_bytes(head) for head in sorted(heads, key=_by_name)]
    return hashlib.sha256(b"".join((HEADS_MAGIC, struct.pack(">I", len(parts)), *parts))).digest()


def statement_bytes(statement: Statement) -> bytes:
    """What is signed."""
    return b"".join(
        (
            STATEMENT_MAGIC,
            text_bytes(statement.station),
            struct.pack(">IQq", statement.epoch, statement.position, microseconds(statement.time)),
            statement.order_hash,
            heads_hash(statement.heads),
            statement.previous,
            statement.public_key,
            statement.successor,
        )
    )


def statement_hash(statement: Statement) -> bytes:
    """SHA-256 of what is signed; the next statement names it as `previous`."""
    return hashlib.sha256(statement_bytes(statement)).digest()


def event_of(statement: Statement, signature: bytes) -> CheckpointSigned:
    """The event that holds the statement and its signature.

    Raises:
        BadProof: There are more streams than one checkpoint holds.
    """
    text = json.dumps(_heads_json(statement), separators=(",", ":"))
    if len(text) > HEADS_TEXT_BYTES_MAX:
        raise BadProof(
            f"a checkpoint holds at most {HEADS_TEXT_BYTES_MAX} bytes of heads, got {len(text)} for "
            f"{len(statement.heads)} streams. Next: sign on the stations, whose logs hold fewer"
        )
    return CheckpointSigned(
        time=statement.time,
        log_position=statement.position,
        heads=text,
        heads_hash=heads_hash(statement.heads).hex(),
        previous=statement.previous.hex(),
        key_id=key_id(statement.public_key),
        algorithm=ALGORITHM,
        signature=signature,
    )


def checkpoint_of(event: CheckpointSigned, station: str, sequence: int) -> SignedCheckpoint:
    """The checkpoint that the event holds; whether its signature holds is another question.

    Raises:
        BadProof: The event contradicts itself, or holds what no checkpoint can.
    """
    try:
        statement = _statement(event, Station(station))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadProof(f"its heads cannot be read: {error!r}") from error
    if event.algorithm != ALGORITHM:
        raise BadProof(f"it is signed with {event.algorithm!r}, known is {ALGORITHM}")
    if event.heads_hash != heads_hash(statement.heads).hex():
        raise BadProof("its heads do not have the hash that it names")
    if event.key_id != key_id(statement.public_key):
        raise BadProof(f"it names key {event.key_id}, its public key is {key_id(statement.public_key)}")
    return SignedCheckpoint(statement, event.signature, Sequence(sequence))


def _statement(event: CheckpointSigned, station: Station) -> Statement:
    said = json.loads(event.heads)
    return Statement(
        station=station,
        epoch=int(said["epoch"]),
        position=event.log_position,
        time=event.time,
        order_hash=_bytes32(said["order_hash"]),
        heads=tuple(map(_head, said["streams"])),
        previous=_bytes32(event.previous),
        public_key=_bytes32(said["public_key"]),
        successor=_bytes32(said["successor"]),
    )


def _heads_json(statement: Statement) -> dict[str, Any]:
    return {
        "epoch": statement.epoch,
        "order_hash": statement.order_hash.hex(),
        "public_key": statement.public_key.hex(),
        "successor": statement.successor.hex(),
        "streams": head_rows(statement.heads),
    }


def head_rows(heads: Iterable[StreamHead]) -> list[list[Any]]:
    """The heads as JSON has them, in the order in which they are hashed."""
    return [
        [head.stream.station, head.epoch, head.stream.source, head.stream.type, head.sequence, head.chain_hash.hex()]
        for head in sorted(heads, key=_by_name)
    ]


def _head(row: list[Any]) -> StreamHead:
    station, epoch, source, type_, sequence, chain_hash = row
    return StreamHead(StreamName.of(station, source, type_), int(epoch), int(sequence), _bytes32(chain_hash))


def head_bytes(head: StreamHead) -> bytes:
    """A head as it is hashed."""
    return b"".join(
        (
            text_bytes(head.stream.station),
            struct.pack(">I", head.epoch),
            text_bytes(head.stream.source),
            text_bytes(head.stream.type),
            struct.pack(">Q", head.sequence),
            head.chain_hash,
        )
    )


def _by_name(head: StreamHead) -> tuple[StreamName, int, int]:
    return head.stream, head.epoch, head.sequence


def _bytes32(text: str) -> bytes:
    data = bytes.fromhex(text)
    if len(data) != 32:
        raise ValueError(f"a hash or key has 32 bytes, got {len(data)}")
    return data
