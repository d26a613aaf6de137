"""Proof: what a station signed, and what it knows to be lost."""

from typing import Annotated, Literal

from pydantic import Field

from events.model import EventType, JsonText, UtcTime


class CheckpointSigned(EventType, type="checkpoint_signed", version=1, subject="key_id"):
    """A station signed the heads of all streams of its log, as they stood at one position."""

    log_position: Annotated[int, Field(ge=0)]
    """position of the log at which the heads stood"""
    heads: JsonText
    """head of each stream: station, epoch, source, type, sequence and chain hash"""
    heads_hash: str
    """SHA-256 of the heads' canonical form, in hexadecimal"""
    previous: str
    """hash of the checkpoint before, SHA-256 in hexadecimal; 64 zeros for the first"""
    key_id: str
    """name of the key that signed, in hexadecimal"""
    algorithm: Literal["ed25519"]
    """how it was signed: Ed25519 of RFC 8032"""
    signature: bytes
    """the signature, 64 bytes"""


class LossRecorded(EventType, type="loss_recorded", version=1, subject="stream"):
    """Something that should be in a stream is not, and never will be; its time is when that was noticed."""

    stream: str
    """stream that lacks it, as station/source/type"""
    what: Literal["events", "segments", "frames"]
    """what was lost"""
    count: Annotated[int, Field(ge=1)] | None
    """how many were lost; null where nobody knows"""
    first_sequence: Annotated[int, Field(ge=1)] | None
    """first sequence that was lost, inclusive; null where none had been given"""
    last_sequence: Annotated[int, Field(ge=1)] | None
    """last sequence that was lost, inclusive; null where none had been given"""
    lost_from_at: UtcTime | None
    """time of the first event that was lost (UTC); null where nobody knows"""
    lost_until_at: UtcTime | None
    """time of the last event that was lost (UTC); null where nobody knows"""
    reason: str
    """why it was lost, as told to the user"""
    policy: str | None
    """setting or rule that chose to lose it; null where it was an accident"""
