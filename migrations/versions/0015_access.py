"""Who may speak for a station: central's registry, one-time codes, and sessions.

Revision: 0015
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0015"
down_revision = "0014"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def upgrade() -> None:
    op.create_table(
        "stations",
        sa.Column("name", sa.Text, primary_key=True, comment="the station"),
        sa.Column("key_id", sa.Text, nullable=False, comment="name of its key, in hexadecimal"),
        sa.Column("public_key", pg.BYTEA, nullable=False, comment="its public key, Ed25519, 32 bytes"),
        sa.Column("operations", pg.ARRAY(sa.Text), nullable=False, comment="what it may do"),
        sa.Column("reads", pg.ARRAY(sa.Text), nullable=False, comment="stations that it may find and query; * for all"),
        sa.Column("enrolled_at", _TIMESTAMP, nullable=False, comment="when it was taken in (UTC)"),
        sa.Column("revoked_at", _TIMESTAMP, comment="when it was shut out (UTC); null: it may speak"),
        sa.Column(
            "challenge_number",
            sa.BigInteger,
            nullable=False,
            server_default="0",
            comment="number of the newest challenge that it answered; no older one counts",
        ),
        sa.CheckConstraint("octet_length(public_key) = 32", name="stations_public_key"),
        comment="The stations that central knows: who has the key may speak. Made of events; one row a station.",
    )
    op.create_table(
        "enrolment_codes",
        sa.Column("code_hash", pg.BYTEA, primary_key=True, comment="SHA-256 of the code"),
        sa.Column("station", sa.Text, nullable=False, comment="the station that it takes in"),
        sa.Column("operations", pg.ARRAY(sa.Text), nullable=False, comment="what the station will be allowed to do"),
        sa.Column("reads", pg.ARRAY(sa.Text), nullable=False, comment="stations that it may find and query; * for all"),
        sa.Column("made_at", _TIMESTAMP, nullable=False, comment="when it was made (UTC)"),
        sa.Column("expires_at", _TIMESTAMP, nullable=False, comment="when it ends (UTC)"),
        sa.Column("used_at", _TIMESTAMP, comment="when it was used (UTC); it does not count again"),
        comment="One-time codes by which stations are taken in.",
    )
    op.create_table(
        "sync_tokens",
        sa.Column("token_hash", pg.BYTEA, primary_key=True, comment="SHA-256 of the token"),
        sa.Column("station", sa.Text, nullable=False, comment="the station that it was given to"),
        sa.Column("made_at", _TIMESTAMP, nullable=False, comment="when it was given (UTC)"),
        sa.Column("expires_at", _TIMESTAMP, nullable=False, comment="when it ends (UTC)"),
        sa.Column("newest", sa.BigInteger, nullable=False, server_default="0", comment="greatest number that came"),
        sa.Column(
            "seen",
            sa.BigInteger,
            nullable=False,
            server_default="0",
            comment="of the 64 numbers up to the greatest, a bit for each that came; the lowest bit is the greatest's",
        ),
        sa.Index("sync_tokens_station", "station"),
        comment="Sessions of stations. Not written ahead: after a crash stations say hello again.",
        prefixes=["UNLOGGED"],
    )
    op.execute("grant select, insert, update on stations, enrolment_codes to vian_writer")
    op.execute("grant select, insert, update, delete on sync_tokens to vian_writer")


def downgrade() -> None:
    # The events stay in the log, and the registry is made of them again.
    for name in ("sync_tokens", "enrolment_codes", "stations"):
        op.drop_table(name)
