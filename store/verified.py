"""What a verification found sound, kept so that the next one need not read it again.

Contract: `to_text` and `from_text` are each other's inverse. The text carries its own SHA-256, so that a
damaged one is refused, and names the log that it is about.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Self

from events import Station, StreamName
from store.audit import Trail
from store.errors import BadProof
from store.log import StreamHead
from store.proof import NO_HASH
from store.walk import At, Place, Walk

_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Verified:
    """The log up to a position, as it was found sound."""

    position: int
    order_hash: bytes
    segments: int
    events: int
    streams: Mapping[Place, tuple[int, bytes, int]]
    """sequence, chain hash and position of each stream's newest segment"""
    trails: Mapping[str, Trail] = field(default_factory=dict)
    digested: int = 0
    """Position up to which the sealed files were compared to the byte; a file that was sealed since was not."""

    @classmethod
    def nothing(cls) -> Self:
        """Where a first run begins."""
        return cls(0, NO_HASH, 0, 0, {})

    @classmethod
    def of(cls, walk: Walk, trails: Mapping[str, Trail], digested: int) -> Self:
        """What a walk found sound so far."""
        streams = {place: (at.sequence, at.chain_hash, at.position) for place, at in walk.streams.items()}
        copies = {name: _trail(_trail_json(trail)) for name, trail in trails.items()}
        return cls(walk.position, walk.order_hash, walk.segments, walk.events, streams, copies, digested)

    def walk(self) -> Walk:
        """A walk that goes on from here."""
        streams = {place: At(*at) for place, at in self.streams.items()}
        return Walk(self.position, self.order_hash, self.segments, self.events, streams)

    def heads(self) -> Iterator[tuple[StreamHead, int]]:
        """Where each stream stood, and at which position."""
        for (name, epoch), (sequence, chain_hash, position) in self.streams.items():
            yield StreamHead(name, epoch, sequence, chain_hash), position

    def to_text(self, log_name: str) -> str:
        """The text, for the log of this name."""
        said = {
            "format": _FORMAT,
            "log": log_name,
            "position": self.position,
            "order_hash": self.order_hash.hex(),
            "segments": self.segments,
            "events": self.events,
            "streams": [[str(n), e, s, h.hex(), p] for (n, e), (s, h, p) in self.streams.items()],
            "digested": self.digested,
            "trails": [_trail_json(trail) for trail in self.trails.values()],
        }
        body = json.dumps(said, separators=(",", ":"))
        return f"{hashlib.sha256(body.encode()).hexdigest()}\n{body}\n"

    @classmethod
    def from_text(cls, text: str, log_name: str) -> Self:
        """What the text holds.

        Raises:
            BadProof: It is damaged, of another log, or of another version of ViAn.
        """
        digest, _, body = text.rstrip("\n").partition("\n")
        if hashlib.sha256(body.encode()).hexdigest() != digest:
            raise BadProof("it is damaged: its SHA-256 is not the one in its first line")
        said = json.loads(body)
        if said["format"] != _FORMAT:
            raise BadProof(f"it has format {said['format']}, known is {_FORMAT}")
        if said["log"] != log_name:
            raise BadProof(f"it is about another log: {said['log']}, this one is {log_name}")
        trails = {str(trail.station): trail for trail in map(_trail, said["trails"])}
        streams = {(StreamName.parse(n), e): (s, bytes.fromhex(h), p) for n, e, s, h, p in said["streams"]}
        order_hash = bytes.fromhex(said["order_hash"])
        return cls(
            said["position"], order_hash, said["segments"], said["events"], streams, trails, said.get("digested", 0)
        )


def _trail_json(trail: Trail) -> dict[str, Any]:
    return {
        "station": trail.station,
        "epoch": trail.epoch,
        "sequence": trail.sequence,
        "previous": trail.previous.hex(),
        "key": trail.key.hex(),
        "successors": [key.hex() for key in trail.successors],
        "former": [key.hex() for key in trail.former],
        "position": trail.position,
        "signed_at": None if trail.signed_at is None else trail.signed_at.isoformat(),
        "checkpoints": trail.checkpoints,
        "heads": [[str(name), epoch, s, h.hex()] for (name, epoch), (s, h) in trail.heads.items()],
    }


def _trail(said: dict[str, Any]) -> Trail:
    return Trail(
        station=Station(said["station"]),
        epoch=said["epoch"],
        sequence=said["sequence"],
        previous=bytes.fromhex(said["previous"]),
        key=bytes.fromhex(said["key"]),
        successors=[bytes.fromhex(key) for key in said["successors"]],
        former=[bytes.fromhex(key) for key in said["former"]],
        position=said["position"],
        signed_at=None if said["signed_at"] is None else datetime.fromisoformat(said["signed_at"]),
        checkpoints=said["checkpoints"],
        heads={(StreamName.parse(n), e): (s, bytes.fromhex(h)) for n, e, s, h in said["heads"]},
    )
