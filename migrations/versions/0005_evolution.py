"""Row tables of three more event types, and version 2 of `track_ended`.

`checkpoint_signed`, `loss_recorded` and `plate_read` join the view `events`. `track_ended` gets
`displacement_px`, filled in for the rows that are there as the upcaster would.

Revision: 0005
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0005"
down_revision = "0003"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = ("checkpoint_signed", "loss_recorded", "plate_read")


_DISTANCE = "sqrt((x_exit::float8 - x_entry) ^ 2 + (y_exit::float8 - y_entry) ^ 2)"


def upgrade() -> None:
    _add_displacement()
    _row_table(
        "checkpoint_signed",
        "A station signed the heads of all streams of its log, as they stood at one position.",
        sa.Column(
            "log_position",
            sa.BigInteger,
            nullable=False,
            comment="position of the log at which the heads stood",
        ),
        sa.Column(
            "heads",
            pg.JSONB,
            nullable=False,
            comment="head of each stream: station, epoch, source, type, sequence and chain hash",
        ),
        sa.Column(
            "heads_hash",
            sa.Text,
            nullable=False,
            comment="SHA-256 of the heads' canonical form, in hexadecimal",
        ),
        sa.Column(
            "previous",
            sa.Text,
            nullable=False,
            comment="hash of the checkpoint before, SHA-256 in hexadecimal; 64 zeros for the first",
        ),
        sa.Column("key_id", sa.Text, nullable=False, comment="name of the key that signed, in hexadecimal"),
        sa.Column("algorithm", sa.Text, nullable=False, comment="how it was signed: Ed25519 of RFC 8032"),
        sa.Column("signature", pg.BYTEA, nullable=False, comment="the signature, 64 bytes"),
    )
    _row_table(
        "loss_recorded",
        "Something that should be in a stream is not, and never will be; its time is when that was noticed.",
        sa.Column("stream", sa.Text, nullable=False, comment="stream that lacks it, as station/source/type"),
        sa.Column("what", sa.Text, nullable=False, comment="what was lost"),
        sa.Column("count", sa.BigInteger, nullable=True, comment="how many were lost; null where nobody knows"),
        sa.Column(
            "first_sequence",
            sa.BigInteger,
            nullable=True,
            comment="first sequence that was lost, inclusive; null where none had been given",
        ),
        sa.Column(
            "last_sequence",
            sa.BigInteger,
            nullable=True,
            comment="last sequence that was lost, inclusive; null where none had been given",
        ),
        sa.Column(
            "lost_from_at",
            _TIMESTAMP,
            nullable=True,
            comment="time of the first event that was lost (UTC); null where nobody knows",
        ),
        sa.Column(
            "lost_until_at",
            _TIMESTAMP,
            nullable=True,
            comment="time of the last event that was lost (UTC); null where nobody knows",
        ),
        sa.Column("reason", sa.Text, nullable=False, comment="why it was lost, as told to the user"),
        sa.Column(
            "policy",
            sa.Text,
            nullable=True,
            comment="setting or rule that chose to lose it; null where it was an accident",
        ),
    )
    _row_table(
        "plate_read",
        "A number plate was read in one frame.",
        sa.Column("plate", sa.Text, nullable=False, comment="the plate's text as read, without blanks"),
        sa.Column(
            "confidence",
            sa.REAL,
            nullable=False,
            comment="how sure the reading is, 0 (not at all) to 1 (sure)",
        ),
        sa.Column("frame", sa.BigInteger, nullable=False, comment="number of the frame within the video, from 0"),
        sa.Column("x1", sa.REAL, nullable=False, comment="left edge of the plate's box, px"),
        sa.Column("y1", sa.REAL, nullable=False, comment="upper edge of the plate's box, px"),
        sa.Column("x2", sa.REAL, nullable=False, comment="right edge of the plate's box, px"),
        sa.Column("y2", sa.REAL, nullable=False, comment="lower edge of the plate's box, px"),
        sa.Column(
            "country",
            sa.Text,
            nullable=True,
            comment="country of registration, ISO 3166-1 alpha-2; null where unread",
        ),
        sa.Column(
            "region",
            sa.Text,
            nullable=True,
            comment="region within the country, as the plate shows it; null where unread",
        ),
        sa.Column(
            "candidates",
            pg.JSONB,
            nullable=True,
            comment="other readings, surest first, each with plate and confidence (0 to 1); null where there are none",
        ),
    )
    _show(_projections())


def downgrade() -> None:
    op.drop_column("track_ended", "displacement_px")
    # The rows stay in the log: row tables are rebuilt from it.
    _show([name for name in _projections() if name not in _TYPES])
    for name in _TYPES:
        op.execute(f"delete from projections where name = '{name}'")
        op.drop_table(name)


def _add_displacement() -> None:
    op.add_column(
        "track_ended",
        sa.Column(
            "displacement_px",
            sa.REAL,
            nullable=False,
            server_default="0",
            comment="straight distance between the first and the last ground contact point, px",
        ),
    )
    # One rewrite of each partition, which an update would leave full of dead rows. PostgreSQL holds NaN above all
    # numbers, and refuses a cast to real that overflows, where NumPy gives infinity.
    op.execute(
        "alter table track_ended alter column displacement_px drop default, alter column displacement_px type real "
        f"using (case when {_DISTANCE} = 'NaN' then 'NaN' when {_DISTANCE} > 3.4028235e38 then 'Infinity' "
        f"else {_DISTANCE} end)::real"
    )


def _projections() -> list[str]:
    """All row tables, those of plug-ins too."""
    return list(op.get_bind().scalars(sa.text("select name from projections order by name")))


def _show(names: list[str]) -> None:
    selects = (
        f"select station || '/' || source || '/{name}/' || sequence as id, station, source, "
        f"cast('{name}' as text) as type, subject, time, sequence, position, recorded_at from \"{name}\""
        for name in names
    )
    op.execute("create or replace view events as " + " union all ".join(selects))


def _row_table(name: str, comment: str, *payload: sa.Column[object]) -> None:
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
