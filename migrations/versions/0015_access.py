"""Who may speak for a station.

Revision: 0015
"""

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Filled by the changes that follow."""


def downgrade() -> None:
    """Filled by the changes that follow."""
