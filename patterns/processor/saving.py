"""What is kept of a rule in the log's checkpoints, so that it goes on after a restart.

Two checkpoints for each version of a rule:

- the *mark* moves with the situations, in their transaction: up to its position, all that the rule
  found is in the log. It is small.
- the *saved state* is all that the rule remembers, as it was at an earlier position. It is large, and
  written now and then. What lies between the two is read again after a restart, and what it
  finds is there already.

Both begin with four bytes that name kind and layout. A state of another layout is not read: the log
is, from where the rule began, and situations that are there already are known by their identity.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import zstandard

from patterns.errors import StateError
from store import Checkpoint, Log

_MARK = b"VPM1"
_STATE = b"VPS1"


@dataclass(frozen=True, slots=True)
class Mark:
    """How far the situations of a rule are in the log.

    Attributes:
        position: All that it found up to here is appended.
        life: Which of its times in service this is: see `Service.life`.
        idles: How often silence, which the log does not hold, has moved its watermark.
        saved: Position of its saved state; 0 where nothing is saved.
        is_done: Whether it has left service for good in this life.
        report: How it stood when it was saved last, for those who ask.
    """

    position: int = 0
    life: int = 0
    idles: int = 0
    saved: int = 0
    is_done: bool = False
    report: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class SavedState:
    """All that a rule remembers, at a position of the log.

    Attributes:
        position: It has seen the log up to here.
        life: Which of its times in service this is.
        run: What its run remembers.
        newest_us: For each stream the newest time that was let in.
        finish_after_us: When it leaves service, in event time, if it is about to.
        foreknown_to: Up to where what the log says of cameras is known to it before its turn; 0: that is all behind.
    """

    position: int
    life: int
    run: bytes
    newest_us: Mapping[str, int] = field(default_factory=dict)
    finish_after_us: int | None = None
    foreknown_to: int = 0


def mark_name(station: str, rule: str, version: int) -> str:
    """Name of the checkpoint that moves with the situations."""
    return f"rule/{station}/{rule}/{version}"


def state_name(station: str, rule: str, version: int) -> str:
    """Name of the checkpoint that holds the saved state."""
    return f"rule-state/{station}/{rule}/{version}"


def mark_bytes(mark: Mark) -> bytes:
    """The mark without its position, which the checkpoint has."""
    said = asdict(replace(mark, report=dict(mark.report)))
    del said["position"]
    return _MARK + json.dumps(said, separators=(",", ":")).encode()


def mark_of(checkpoint: Checkpoint) -> Mark | None:
    """The mark that a checkpoint holds; None: it is of an older ViAn, or there is none."""
    if not checkpoint.state.startswith(_MARK):
        return None
    return Mark(position=checkpoint.position, **json.loads(checkpoint.state[len(_MARK) :]))


def state_bytes(state: SavedState) -> bytes:
    """The saved state without its position, which the checkpoint has."""
    header = {
        "life": state.life,
        "newest_us": dict(state.newest_us),
        "finish_after_us": state.finish_after_us,
        "foreknown_to": state.foreknown_to,
    }
    packed = zstandard.ZstdCompressor().compress(json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode())
    return _STATE + struct.pack(">I", len(packed)) + packed + state.run


def state_of(checkpoint: Checkpoint) -> SavedState | None:
    """The saved state that a checkpoint holds; None where nothing is saved.

    Raises:
        StateError: It is of another layout, or damaged.
    """
    if not checkpoint.state:
        return None
    if not checkpoint.state.startswith(_STATE):
        raise StateError(
            f"the saved state has layout {checkpoint.state[:4]!r}, this ViAn reads {_STATE!r}. "
            "Next: nothing; the log is read again from where the rule began"
        )
    try:
        (length,) = struct.unpack(">I", checkpoint.state[4:8])
        header = json.loads(zstandard.ZstdDecompressor().decompress(checkpoint.state[8 : 8 + length]))
        return SavedState(position=checkpoint.position, run=checkpoint.state[8 + length :], **header)
    except (struct.error, zstandard.ZstdError, ValueError, TypeError) as error:
        raise StateError(f"the saved state is damaged: {error}") from error


def stored_mark(log: Log, station: str, rule: str, version: int) -> Mark | None:
    """The mark in the log; None where there is none that this ViAn wrote."""
    return mark_of(log.checkpoint(mark_name(station, rule, version)))


def stored_state(log: Log, station: str, rule: str, version: int) -> SavedState | None:
    """The saved state in the log; None where there is none.

    Raises:
        StateError: It is of another layout, or damaged.
    """
    return state_of(log.checkpoint(state_name(station, rule, version)))
