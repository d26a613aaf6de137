"""Operations: a record of backups and restores, and an account that is no more than a writer.

Revision: 0008
"""

import sqlalchemy as sa
from alembic import op

revision = "0008"
down_revision = "0006"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def upgrade() -> None:
    op.create_table(
        "maintenance",
        sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
        sa.Column("at", _TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when it was done (UTC)"),
        sa.Column("action", sa.Text, nullable=False, comment="backed_up, restore_began, restored or verified"),
        sa.Column("place", sa.Text, nullable=False, comment="folder of the backup"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position up to which it holds"),
        sa.CheckConstraint(
            "action in ('backed_up', 'restore_began', 'restored', 'verified')", name="maintenance_action"
        ),
        comment="Backups of this log, and the restore that it came from.",
    )
    op.execute("grant select, insert on maintenance to vian_writer")
    # So that a program may run as an account that is no more than a writer: it looks whether the schema is its own.
    op.execute("grant select on alembic_version to vian_writer")


def downgrade() -> None:
    op.execute("revoke select on alembic_version from vian_writer")
    op.drop_table("maintenance")
