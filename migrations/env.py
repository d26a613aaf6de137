"""How Alembic reaches the database: through the connection it is given, or VIAN_DSN on the command line."""

import os

import psycopg
import sqlalchemy as sa
from alembic import context

from store.tables import metadata


def run(connection: sa.Connection) -> None:
    """Run the migrations over the connection, in the transaction that is open on it."""
    context.configure(connection=connection, target_metadata=metadata, transaction_per_migration=False)
    with context.begin_transaction():
        context.run_migrations()


given = context.config.attributes.get("connection")
if given is not None:
    run(given)
else:
    engine = sa.create_engine("postgresql+psycopg://", creator=lambda: psycopg.connect(os.environ["VIAN_DSN"]))
    with engine.begin() as opened:
        run(opened)
