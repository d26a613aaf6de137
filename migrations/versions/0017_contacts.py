"""What central heard last of each station.

Revision: 0017
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0017"
down_revision = "0016"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def upgrade() -> None:
    op.create_table(
        "station_contacts",
        sa.Column("station", sa.Text, primary_key=True, comment="the station"),
        sa.Column("last_contact_at", _TIMESTAMP, nullable=False, comment="when it was last heard of (UTC)"),
        sa.Column("hello_at", _TIMESTAMP, nullable=False, comment="when its newest hello came (UTC)"),
        sa.Column("program", sa.Text, nullable=False, comment="its program, as it said"),
        sa.Column("protocol", sa.Integer, nullable=False, comment="version of the protocol in which it said so"),
        sa.Column("epoch", sa.Integer, nullable=False, comment="life of its log, as it said"),
        sa.Column(
            "clock_offset_s", sa.Double, nullable=False, comment="how far central's clock was ahead of its own, s"
        ),
        sa.Column("heads", pg.JSONB, nullable=False, comment="of each stream that it sends: name, epoch, sequence"),
        comment="What central heard last of each station. For people to look at: nothing is decided by it.",
    )
    op.execute("grant select, insert, update on station_contacts to vian_writer")


def downgrade() -> None:
    op.drop_table("station_contacts")
