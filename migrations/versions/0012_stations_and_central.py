"""Row tables of what stations and central say of each other.

Revision: 0012
"""

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0012"
down_revision = "0011"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = (
    "checkpoint_countersigned",
    "station_enrolled",
    "station_revoked",
    "request_refused",
    "query_answered",
    "segments_pruned",
    "segments_repaired",
)


def upgrade() -> None:
    _row_table(
        "checkpoint_countersigned",
        "Central signed that it holds streams of a station up to where they stood at a checkpoint of the station.",
        sa.Column("of_station", sa.Text, nullable=False, comment="station whose checkpoint it is"),
        sa.Column(
            "checkpoint_sequence",
            sa.BigInteger,
            nullable=False,
            comment="sequence of the station's event `checkpoint_signed`",
        ),
        sa.Column(
            "statement_hash",
            sa.Text,
            nullable=False,
            comment="hash of the station's checkpoint, SHA-256 in hexadecimal",
        ),
        sa.Column(
            "held",
            pg.JSONB,
            nullable=False,
            comment="head of each stream up to which central holds all: station, epoch, source, type, sequence, hash",
        ),
        sa.Column("key_id", sa.Text, nullable=False, comment="name of central's key, in hexadecimal"),
        sa.Column("algorithm", sa.Text, nullable=False, comment="how it was signed: Ed25519 of RFC 8032"),
        sa.Column("signature", pg.BYTEA, nullable=False, comment="the signature, 64 bytes"),
    )
    _row_table(
        "station_enrolled",
        "Central took a station in: who has this key may speak for it.",
        sa.Column("enrolled", sa.Text, nullable=False, comment="the station"),
        sa.Column("key_id", sa.Text, nullable=False, comment="name of its key, in hexadecimal"),
        sa.Column("public_key", pg.BYTEA, nullable=False, comment="its public key, Ed25519, 32 bytes"),
        sa.Column(
            "operations", pg.JSONB, nullable=False, comment="what it may do: a list of `replicate`, `find`, `query`"
        ),
        sa.Column(
            "reads",
            pg.JSONB,
            nullable=False,
            comment="stations whose events it may find and query: a list of names, `*` for all",
        ),
        sa.Column(
            "address", sa.Text, nullable=True, comment="network address that it enrolled from; null where none is known"
        ),
    )
    _row_table(
        "station_revoked",
        "Central shut a station out, from this moment on.",
        sa.Column("revoked", sa.Text, nullable=False, comment="the station"),
        sa.Column(
            "key_id",
            sa.Text,
            nullable=True,
            comment="name of the key that no longer speaks for it, in hexadecimal; null where it had a token only",
        ),
        sa.Column("reason", sa.Text, nullable=True, comment="why; null where no reason was given"),
    )
    _row_table(
        "request_refused",
        "Central refused requests; those alike within a minute are one event.",
        sa.Column(
            "claimed",
            sa.Text,
            nullable=True,
            comment="station that the requests claimed to come from; null where they named none",
        ),
        sa.Column("endpoint", sa.Text, nullable=False, comment="last part of the path that was asked"),
        sa.Column("code", sa.Text, nullable=False, comment="why, as the answer's code says"),
        sa.Column("got", sa.Text, nullable=False, comment="what was wrong with the first of them"),
        sa.Column(
            "address", sa.Text, nullable=True, comment="network address of the first of them; null where none is known"
        ),
        sa.Column("count", sa.BigInteger, nullable=False, comment="how many there were"),
        sa.Column("first_at", _TIMESTAMP, nullable=False, comment="when the first of them came (UTC)"),
    )
    _row_table(
        "query_answered",
        "Central answered, or refused, a question from the field.",
        sa.Column("asked_by", sa.Text, nullable=False, comment="station that asked"),
        sa.Column(
            "person",
            sa.Text,
            nullable=True,
            comment="account at the station that asked, as the station says; null where it said none",
        ),
        sa.Column("kind", sa.Text, nullable=False, comment="what kind of question"),
        sa.Column(
            "question", sa.Text, nullable=False, comment="the question: what was looked for as JSON, or the SQL text"
        ),
        sa.Column("outcome", sa.Text, nullable=False, comment="`cut`: a limit cut the answer short"),
        sa.Column("row_count", sa.BigInteger, nullable=False, comment="rows that were given"),
        sa.Column("duration_s", sa.Double, nullable=False, comment="how long it took, s"),
        sa.Column("reason", sa.Text, nullable=True, comment="why it was refused or failed; null where it was answered"),
    )
    _row_table(
        "segments_pruned",
        "A station took the payloads of segments off its disk, which central holds; their headers and hashes stay.",
        sa.Column("stream", sa.Text, nullable=False, comment="stream, as station/source/type"),
        sa.Column("stream_epoch", sa.BigInteger, nullable=False, comment="epoch of the stream"),
        sa.Column("first_sequence", sa.BigInteger, nullable=False, comment="first sequence that went, inclusive"),
        sa.Column("last_sequence", sa.BigInteger, nullable=False, comment="last sequence that went, inclusive"),
        sa.Column("segments", sa.BigInteger, nullable=False, comment="how many segments"),
        sa.Column("payload_bytes", sa.BigInteger, nullable=False, comment="bytes of their payloads"),
        sa.Column(
            "statement_hash",
            sa.Text,
            nullable=False,
            comment="checkpoint that central countersigned and that covers them, SHA-256 in hexadecimal",
        ),
    )
    _row_table(
        "segments_repaired",
        "Segments that were damaged or taken off the disk hold again the bytes that their hashes name.",
        sa.Column("stream", sa.Text, nullable=False, comment="stream, as station/source/type"),
        sa.Column("stream_epoch", sa.BigInteger, nullable=False, comment="epoch of the stream"),
        sa.Column(
            "first_sequence", sa.BigInteger, nullable=False, comment="first sequence that was put back, inclusive"
        ),
        sa.Column("last_sequence", sa.BigInteger, nullable=False, comment="last sequence that was put back, inclusive"),
        sa.Column("segments", sa.BigInteger, nullable=False, comment="how many segments"),
        sa.Column(
            "origin", sa.Text, nullable=False, comment="where the bytes came from: `central`, or the station's name"
        ),
        sa.Column("reason", sa.Text, nullable=False, comment="what had been wrong with them"),
    )


def downgrade() -> None:
    # The events stay in the log: row tables are rebuilt from it.
    for name in _TYPES:
        op.execute(f"select drop_projection('{name}')")


def _row_table(name: str, comment: str, *payload: sa.Column[Any]) -> None:
    op.create_table(
        name,
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("subject", sa.Text, comment="what it is about"),
        sa.Column("time", _TIMESTAMP, nullable=False, comment="when it happened (UTC)"),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="place in its stream"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position of its segment in this log"),
        sa.Column("recorded_at", _TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        *payload,
        comment=comment,
        postgresql_partition_by="RANGE (time)",
    )
    op.create_index(f"{name}_time", name, ["time"], postgresql_using="brin")
    op.create_index(f"{name}_position", name, ["position"], postgresql_using="brin")
    op.execute(f"select adopt_projection('{name}')")
