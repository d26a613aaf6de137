"""Questions from the field.

Revision: 0016
"""

revision = "0016"
down_revision = "0015"
branch_labels = None
depends_on = None


def upgrade() -> None:
    """Filled by the changes that follow."""


def downgrade() -> None:
    """Filled by the changes that follow."""
