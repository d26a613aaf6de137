"""What the append function is sent, what it answers, and what its refusals mean.

Contract: pure functions; the statement is the newest `migrations/sql/*_append_segments.sql`. Streams and
producers go once each, payloads and hashes end to end in one value each: few large values are what
PostgreSQL takes in fastest.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import psycopg

from events import Draft
from store.errors import ChainBroken, LogUnavailable, SequenceConflict, StoreError

APPEND = (
    "select positions, first_sequences, chain_hashes, duplicates from append_segments("
    "%s::int[], %s::text[], %s::text[], %s::text[], %s::text[], %s::text[], %s::bytea[], %s::int[], %s::int[], "
    "%s::bigint[], %s::int[], %s::int[], %s::timestamptz[], %s::timestamptz[], %s::bytea[], %s::int[], %s, %s, %s, "
    "%b::bytea[])"
)
_HASH_BYTES = 32


class PlaceIsSealed(StoreError):
    """A re-sent segment's place lies in a sealed file, which the database cannot read; nothing was stored."""


@dataclass(frozen=True, slots=True)
class Appended:
    """What became of one draft."""

    position: int
    first_sequence: int
    chain_hash: bytes
    was_there: bool
    """It was a re-sent segment: acknowledged, not stored again."""


def append_parameters(
    drafts: Sequence[Draft],
    expected: Sequence[int | None],
    epochs: Sequence[int],
    chain_hashes: Sequence[bytes | None],
) -> list[Any]:
    """The columns of the call: streams, producers, segments, bytes."""
    named = [(epoch, draft.stream) for epoch, draft in zip(epochs, drafts, strict=True)]
    streams = {key: place for place, key in enumerate(dict.fromkeys(named), 1)}
    producers = {key: place for place, key in enumerate(dict.fromkeys(draft.producer for draft in drafts), 1)}
    return [
        [epoch for epoch, _ in streams],
        [stream.station for _, stream in streams],
        [stream.source for _, stream in streams],
        [stream.type for _, stream in streams],
        [producer.name for producer in producers],
        [producer.version for producer in producers],
        [producer.configuration_hash for producer in producers],
        [streams[key] for key in named],
        [producers[draft.producer] for draft in drafts],
        list(expected),
        [draft.event_count for draft in drafts],
        [draft.schema_version for draft in drafts],
        [draft.time_min for draft in drafts],
        [draft.time_max for draft in drafts],
        list(chain_hashes),
        [len(draft.payload) for draft in drafts],
        b"".join(draft.payload_hash for draft in drafts),
        b"".join(draft.payload for draft in drafts),
    ]


def append_answer(row: Sequence[Any]) -> list[Appended]:
    """What the function's one row says of each draft; no position where a sealed file must be asked."""
    positions, first_sequences, hashes, duplicates = row
    chain_hashes = [hashes[at : at + _HASH_BYTES] for at in range(0, len(hashes), _HASH_BYTES)]
    return [Appended(*each) for each in zip(positions, first_sequences, chain_hashes, duplicates, strict=True)]


def append_error(error: psycopg.Error, drafts: Sequence[Draft], expected: Sequence[int | None] | None) -> Exception:
    """Our error for a refusal of the append function, or for a database that went away."""
    refusal = error.sqlstate
    if refusal == "VA007":
        return PlaceIsSealed(str(error))
    if refusal not in ("VA001", "VA002", "VA003"):
        if isinstance(error, psycopg.OperationalError):
            # Gone, full, or shutting down: what was sent can be sent again.
            return LogUnavailable(f"the database could not take an append: {error}".strip())
        return StoreError(f"the append failed: {error}".strip())
    detail = json.loads(error.diag.message_detail or "{}")
    stream = drafts[detail["index"]].stream
    if refusal == "VA003":
        other = (
            f"that behind which sequence {detail['base'] + 1} was begun"
            if "base" in detail
            else "the one that was sent"
        )
        return ChainBroken(stream, None, detail["first_sequence"], f"the chain hash differs from {other}")
    wanted = (expected or [None] * len(drafts))[detail["index"]]
    assert wanted is not None, "only an append with an expected sequence can conflict"
    return SequenceConflict(
        stream, wanted, detail["actual"], detail.get("stored_hash"), detail.get("sent_hash"), detail.get("until")
    )
