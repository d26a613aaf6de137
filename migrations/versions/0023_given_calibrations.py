"""A calibration that people give holds for its whole view: the view of track points on the ground, anew.

Revision: 0023
"""

from importlib import import_module
from importlib.resources import files

from alembic import op

revision = "0023"
down_revision = "0022"
branch_labels = None
depends_on = None


def upgrade() -> None:
    op.execute(files("migrations").joinpath("sql", "0023_track_ground.sql").read_text(encoding="utf-8"))


def downgrade() -> None:
    before = import_module("migrations.versions.0022_track_ground")
    names = ("east", "north", "depth")
    rows = {name: before._row(at, "s.x", "s.y", "1") for at, name in enumerate(names)}
    rates = {f"{name}_rate": before._row(at, "s.vx", "s.vy", "0") for at, name in enumerate(names)}
    op.execute((before._VIEW % (rows | rates)).replace("create view", "create or replace view"))
