"""Payloads that leave a station's disk, and come back.

Revision: 0014
"""

revision = "0014"
down_revision = "0013"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Filled by the changes that follow."""


def downgrade() -> None:
    """Filled by the changes that follow."""
