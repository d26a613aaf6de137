"""What the append function is sent, and what its refusals mean.

Contract: pure functions; the statement is `migrations/sql/*_append_segments.sql`.
"""

import json
from collections.abc import Sequence
from typing import Any

import psycopg

from events import Draft
from store.errors import ChainBroken, LogUnavailable, SequenceConflict, StoreError

APPEND = (
    "select out_position, out_first_sequence, out_chain_hash, duplicate from append_segments("
    "%s::int[], %s::text[], %s::text[], %s::text[], %s::bigint[], %s::int[], %s::int[], %s::timestamptz[], "
    "%s::timestamptz[], %s::text[], %s::text[], %b::bytea[], %b::bytea[], %b::bytea[], %b::bytea[]) "
    "order by ordinal"
)


def append_parameters(
    drafts: Sequence[Draft],
    expected: Sequence[int | None],
    epochs: Sequence[int],
    chain_hashes: Sequence[bytes | None],
) -> list[Any]:
    """The columns of the call, one entry a draft in each."""
    return [
        list(epochs),
        [draft.stream.station for draft in drafts],
        [draft.stream.source for draft in drafts],
        [draft.stream.type for draft in drafts],
        list(expected),
        [draft.event_count for draft in drafts],
        [draft.schema_version for draft in drafts],
        [draft.time_min for draft in drafts],
        [draft.time_max for draft in drafts],
        [draft.producer.name for draft in drafts],
        [draft.producer.version for draft in drafts],
        [draft.producer.configuration_hash for draft in drafts],
        [draft.payload for draft in drafts],
        [draft.payload_hash for draft in drafts],
        list(chain_hashes),
    ]


def append_error(error: psycopg.Error, drafts: Sequence[Draft], expected: Sequence[int | None] | None) -> Exception:
    """Our error for a refusal of the append function, or for a database that went away."""
    refusal = error.sqlstate
    if refusal not in ("VA001", "VA002", "VA003"):
        if isinstance(error, psycopg.OperationalError):
            # Gone, full, or shutting down: what was sent can be sent again.
            return LogUnavailable(f"the database could not take an append: {error}".strip())
        return StoreError(f"the append failed: {error}".strip())
    detail = json.loads(error.diag.message_detail or "{}")
    stream = drafts[detail["index"]].stream
    if refusal == "VA003":
        return ChainBroken(stream, None, detail["first_sequence"], "the chain hash differs from the one that was sent")
    wanted = (expected or [None] * len(drafts))[detail["index"]]
    assert wanted is not None, "only an append with an expected sequence can conflict"
    return SequenceConflict(stream, wanted, detail["actual"], detail.get("stored_hash"), detail.get("sent_hash"))
