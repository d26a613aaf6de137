"""The log: streams, segments, checkpoints, the append function, roles.

Revision: 0001
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0001"
down_revision = None
branch_labels = None
depends_on = None

_FUNCTIONS = (
    "header_text",
    "segment_header",
    "refuse_change",
    "append_segments",
    "ensure_partition",
    "adopt_projection",
)
_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def _sql(name: str) -> str:
    return files("migrations").joinpath("sql", f"0001_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.execute(_sql("roles"))
    op.create_table(
        "log_head",
        sa.Column("singleton", sa.Boolean, sa.CheckConstraint("singleton", name="log_head_one_row"), primary_key=True),
        sa.Column(
            "position",
            sa.BigInteger,
            nullable=False,
            comment="position of the newest segment, 0 when there is none",
        ),
        sa.Column(
            "epoch",
            sa.Integer,
            nullable=False,
            comment="epoch of this log's own streams; grows with each restore",
        ),
        comment="One row: where the log stands. Its lock orders commits.",
    )
    op.execute("insert into log_head values (true, 0, 1)")
    op.create_table(
        "streams",
        sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("epoch", sa.Integer, nullable=False, comment="life of the station's log, from 1"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("type", sa.Text, nullable=False, comment="event type"),
        sa.Column(
            "sequence",
            sa.BigInteger,
            nullable=False,
            server_default="0",
            comment="sequence of the newest event",
        ),
        sa.Column(
            "chain_hash",
            pg.BYTEA,
            nullable=False,
            server_default=sa.text(r"'\x" + "00" * 32 + "'"),
            comment="chain hash of the newest segment, SHA-256",
        ),
        sa.UniqueConstraint("station", "epoch", "source", "type", name="streams_name"),
        comment="One stream is what one source at one station says in one event type; its head.",
    )
    op.create_table(
        "segments",
        sa.Column(
            "position",
            sa.BigInteger,
            primary_key=True,
            autoincrement=False,
            comment="place in this log, gapless",
        ),
        sa.Column("stream_id", sa.BigInteger, sa.ForeignKey("streams.id", name="segments_stream"), nullable=False),
        sa.Column(
            "first_sequence",
            sa.BigInteger,
            nullable=False,
            comment="sequence of the first event in its stream",
        ),
        sa.Column("event_count", sa.Integer, nullable=False, comment="number of events"),
        sa.Column("schema_version", sa.Integer, nullable=False, comment="version of the event type"),
        sa.Column("time_min", _TIMESTAMP, nullable=False, comment="earliest event (UTC)"),
        sa.Column("time_max", _TIMESTAMP, nullable=False, comment="latest event (UTC)"),
        sa.Column("recorded_at", _TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        sa.Column("producer", sa.Text, nullable=False, comment="extractor that said it"),
        sa.Column("producer_version", sa.Text, nullable=False, comment="version of the extractor"),
        sa.Column("configuration_hash", pg.BYTEA, nullable=False, comment="SHA-256 of the extractor's configuration"),
        sa.Column("payload", pg.BYTEA, nullable=False, comment="zstd of an Arrow record batch"),
        sa.Column("payload_hash", pg.BYTEA, nullable=False, comment="SHA-256 of the payload"),
        sa.Column(
            "chain_hash",
            pg.BYTEA,
            nullable=False,
            comment="SHA-256 of previous chain hash, header, payload hash",
        ),
        sa.UniqueConstraint("stream_id", "first_sequence", name="segments_place"),
        sa.CheckConstraint("event_count > 0", name="segments_not_empty"),
        sa.CheckConstraint(
            "octet_length(payload_hash) = 32 and octet_length(configuration_hash) = 32", name="segments_hash"
        ),
        comment="The log: one row is one append of one stream, immutable.",
    )
    op.create_table(
        "checkpoints",
        sa.Column("name", sa.Text, primary_key=True, comment="subscriber"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="newest position that it has dealt with"),
        sa.Column("state", pg.BYTEA, nullable=False, comment="its own state, opaque here"),
        sa.Column("saved_at", _TIMESTAMP, nullable=False, server_default=sa.func.now()),
        comment="How far each subscriber has come.",
    )
    op.create_table(
        "projections",
        sa.Column("name", sa.Text, primary_key=True, comment="row table, named as its event type"),
        comment="The row tables: rebuildable projections of segments.",
    )
    # Payloads are compressed already: keep PostgreSQL from trying again.
    op.execute("alter table segments alter column payload set storage external")
    # Functions keep this path; temporary tables last, lest a writer's own stand in for the log's.
    op.execute("select set_config('search_path', current_setting('search_path') || ', pg_temp', true)")
    for name in _FUNCTIONS:
        op.execute(_sql(name))
    for change in ("update or delete", "truncate"):
        op.execute(
            f"create trigger segments_no_{change.split()[0]} before {change} on segments "
            "for each statement execute function refuse_change()"
        )
    op.execute("revoke execute on function append_segments, ensure_partition, adopt_projection from public")
    op.execute("grant execute on function append_segments, ensure_partition to vian_writer")
    op.execute("grant select on log_head, streams, segments, checkpoints, projections to vian_writer")
    op.execute("grant insert, update, delete on checkpoints to vian_writer")
    op.execute("grant select on streams to vian_reader")


def downgrade() -> None:
    for name in ("adopt_projection", "ensure_partition", "append_segments"):
        op.execute(f"drop function {name}")
    for table in ("projections", "checkpoints", "segments", "streams", "log_head"):
        op.drop_table(table)
    for name in ("refuse_change", "segment_header", "header_text"):
        op.execute(f"drop function {name}")
