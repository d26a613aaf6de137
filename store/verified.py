"""What a verification found sound, kept so that the next one need not read it again.

Contract: `to_text` and `from_text` are each other's inverse. The text carries its own SHA-256, so that a
damaged one is refused, and names the log that it is about.
"""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Self

from events import GENESIS, Chains, Place, Run, Station, StreamName
from store.audit import Trail
from store.errors import BadProof
from store.proof import NO_HASH
from store.walk import Walk

_FORMAT = 1


@dataclass(frozen=True, slots=True)
class Verified:
    """The log up to a position, as it was found sound."""

    position: int
    order_hash: bytes
    segments: int
    events: int
    runs: Mapping[Place, tuple[Run, ...]]
    """what was there of each stream, with the position of each run's newest segment"""
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
        runs = {place: tuple(each) for place, each in walk.chains.runs.items()}
        copies = {name: _trail(_trail_json(trail)) for name, trail in trails.items()}
        return cls(walk.position, walk.order_hash, walk.segments, walk.events, runs, copies, digested)

    def walk(self) -> Walk:
        """A walk that goes on from here."""
        return Walk(self.position, self.order_hash, self.segments, self.events, Chains(self.runs))

    def to_text(self, log_name: str) -> str:
        """The text, for the log of this name."""
        said = {
            "format": _FORMAT,
            "log": log_name,
            "position": self.position,
            "order_hash": self.order_hash.hex(),
            "segments": self.segments,
            "events": self.events,
            "streams": [_run_row(place, run) for place, runs in self.runs.items() for run in runs],
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
        runs: dict[Place, tuple[Run, ...]] = {}
        for row in said["streams"]:
            place = (StreamName.parse(row[0]), row[1])
            runs[place] = (*runs.get(place, ()), _run(*row[2:]))
        order_hash = bytes.fromhex(said["order_hash"])
        return cls(
            said["position"], order_hash, said["segments"], said["events"], runs, trails, said.get("digested", 0)
        )


def _run_row(place: Place, run: Run) -> list[Any]:
    """A run as JSON has it; where it begins is said of those that do not begin with the stream."""
    behind = [run.after, run.after_hash.hex()] if run.after else []
    return [str(place[0]), place[1], run.sequence, run.chain_hash.hex(), run.position, *behind]


def _run(sequence: int, chain_hash: str, position: int, after: int = 0, after_hash: str = GENESIS.hex()) -> Run:
    return Run(after, bytes.fromhex(after_hash), sequence, bytes.fromhex(chain_hash), position)


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
        "heads": [[str(n), epoch, s, h.hex()] for (n, epoch), signed in trail.heads.items() for s, h in signed.items()],
    }


def _trail(said: dict[str, Any]) -> Trail:
    heads: dict[Place, dict[int, bytes]] = {}
    for name, epoch, sequence, chain_hash in said["heads"]:
        heads.setdefault((StreamName.parse(name), epoch), {})[sequence] = bytes.fromhex(chain_hash)
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
        heads=heads,
    )
