"""Stations and central: what replicates where, who may, what was refused, asked, taken off a disk and put back."""

from typing import Annotated, Literal

from events.model import AtDoor, EventType, JsonText, UtcTime


class SyncPlanned(EventType, type="sync_planned", version=1):
    """A station decided which streams to replicate, in which order."""

    central: str
    """address of the central server"""
    plan: JsonText
    """the whole plan: ordered entries"""
    plan_hash: str
    """SHA-256 of the plan's canonical form, in hexadecimal"""


class CheckpointCountersigned(EventType, type="checkpoint_countersigned", version=1, subject="of_station"):
    """Central signed that it holds streams of a station up to where they stood at a checkpoint of the station."""

    of_station: str
    """station whose checkpoint it is"""
    checkpoint_sequence: Annotated[int, AtDoor(1)]
    """sequence of the station's event `checkpoint_signed`"""
    statement_hash: str
    """hash of the station's checkpoint, SHA-256 in hexadecimal"""
    held: JsonText
    """head of each stream up to which central holds all: station, epoch, source, type, sequence, hash"""
    key_id: str
    """name of central's key, in hexadecimal"""
    algorithm: Literal["ed25519"]
    """how it was signed: Ed25519 of RFC 8032"""
    signature: bytes
    """the signature, 64 bytes"""


class StationEnrolled(EventType, type="station_enrolled", version=1, subject="enrolled"):
    """Central took a station in: who has this key may speak for it."""

    enrolled: str
    """the station"""
    key_id: str
    """name of its key, in hexadecimal"""
    public_key: bytes
    """its public key, Ed25519, 32 bytes"""
    operations: JsonText
    """what it may do: a list of `replicate`, `find`, `query`"""
    reads: JsonText
    """stations whose events it may find and query: a list of names, `*` for all"""
    address: str | None
    """network address that it enrolled from; null where none is known"""


class StationRevoked(EventType, type="station_revoked", version=1, subject="revoked"):
    """Central shut a station out, from this moment on."""

    revoked: str
    """the station"""
    key_id: str | None
    """name of the key that no longer speaks for it, in hexadecimal; null where it had a token only"""
    reason: str | None
    """why; null where no reason was given"""


class RequestRefused(EventType, type="request_refused", version=1, subject="claimed"):
    """Central refused requests; those alike within a minute are one event."""

    claimed: str | None
    """station that the requests claimed to come from; null where they named none"""
    endpoint: str
    """last part of the path that was asked"""
    code: str
    """why, as the answer's code says"""
    got: str
    """what was wrong with the first of them"""
    address: str | None
    """network address of the first of them; null where none is known"""
    count: Annotated[int, AtDoor(1)]
    """how many there were"""
    first_at: UtcTime
    """when the first of them came (UTC)"""


class QueryAnswered(EventType, type="query_answered", version=1, subject="asked_by"):
    """Central answered, or refused, a question from the field."""

    asked_by: str
    """station that asked"""
    person: str | None
    """account at the station that asked, as the station says; null where it said none"""
    kind: Literal["plate", "situation", "sql"]
    """what kind of question"""
    question: str
    """the question: what was looked for as JSON, or the SQL text"""
    outcome: Literal["answered", "cut", "refused", "timed_out", "failed"]
    """`cut`: a limit cut the answer short"""
    row_count: Annotated[int, AtDoor(0)]
    """rows that were given"""
    duration_s: Annotated[float, AtDoor(0)]
    """how long it took, s"""
    reason: str | None
    """why it was refused or failed; null where it was answered"""


class SegmentsPruned(EventType, type="segments_pruned", version=1, subject="stream"):
    """A station took the payloads of segments off its disk, which central holds; their headers and hashes stay."""

    stream: str
    """stream, as station/source/type"""
    stream_epoch: Annotated[int, AtDoor(0)]
    """epoch of the stream"""
    first_sequence: Annotated[int, AtDoor(1)]
    """first sequence that went, inclusive"""
    last_sequence: Annotated[int, AtDoor(1)]
    """last sequence that went, inclusive"""
    segments: Annotated[int, AtDoor(1)]
    """how many segments"""
    payload_bytes: Annotated[int, AtDoor(0)]
    """bytes of their payloads"""
    statement_hash: str
    """checkpoint that central countersigned and that covers them, SHA-256 in hexadecimal"""


class SegmentsRepaired(EventType, type="segments_repaired", version=1, subject="stream"):
    """Segments that were damaged or taken off the disk hold again the bytes that their hashes name."""

    stream: str
    """stream, as station/source/type"""
    stream_epoch: Annotated[int, AtDoor(0)]
    """epoch of the stream"""
    first_sequence: Annotated[int, AtDoor(1)]
    """first sequence that was put back, inclusive"""
    last_sequence: Annotated[int, AtDoor(1)]
    """last sequence that was put back, inclusive"""
    segments: Annotated[int, AtDoor(1)]
    """how many segments"""
    origin: str
    """where the bytes came from: `central`, or the station's name"""
    reason: str
    """what had been wrong with them"""
