"""A stream may begin behind its first event, and have gaps that fill later.

Revision: 0013
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0013"
down_revision = "0012"
branch_labels = None
depends_on = None


def _sql(name: str, of: str = "0013") -> str:
    return files("migrations").joinpath("sql", f"{of}_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.create_table(
        "stream_bases",
        sa.Column("stream_id", sa.BigInteger, sa.ForeignKey("streams.id", name="stream_bases_stream")),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="a run of the stream begins behind it"),
        sa.Column("chain_hash", pg.BYTEA, nullable=False, comment="chain hash after it, SHA-256"),
        sa.Column(
            "position",
            sa.BigInteger,
            nullable=False,
            comment="position of the segment that begins the run; 0 until its append has one",
        ),
        sa.Column(
            "filled_sequence",
            sa.BigInteger,
            nullable=False,
            comment="newest event of the run below; where it is the base itself, the two runs are one",
        ),
        sa.Column("filled_hash", pg.BYTEA, nullable=False, comment="chain hash after it, SHA-256"),
        sa.PrimaryKeyConstraint("stream_id", "sequence", name="stream_bases_pkey"),
        sa.CheckConstraint("sequence > 0 and octet_length(chain_hash) = 32", name="stream_bases_base"),
        sa.CheckConstraint(
            "filled_sequence >= 0 and filled_sequence <= sequence and octet_length(filled_hash) = 32 "
            "and (filled_sequence < sequence or filled_hash = chain_hash)",
            name="stream_bases_filled",
        ),
        comment="Where a stream was begun without what comes before it, and how far that has come since.",
    )
    op.create_index(
        "stream_bases_open",
        "stream_bases",
        ["stream_id", "sequence"],
        postgresql_where=sa.text("filled_sequence < sequence"),
    )
    op.create_index("stream_bases_position", "stream_bases", ["position"])
    _set_path()
    op.execute(_sql("refuse_rebasing"))
    op.execute(
        "create trigger stream_bases_no_update before update on stream_bases "
        "for each row execute function refuse_rebasing()"
    )
    for change in ("delete", "truncate"):
        op.execute(
            f"create trigger stream_bases_no_{change} before {change} on stream_bases "
            "for each statement execute function refuse_change()"
        )
    op.execute("grant select on stream_bases to vian_writer, vian_archiver")
    _replace("append_segments", "0013", "vian_writer")
    _replace("seal_segments", "0013", "vian_archiver")


def downgrade() -> None:
    op.execute(
        "do $$ begin if exists (select from stream_bases) then "
        "raise exception 'streams have gaps, which the schema before does not know'; end if; end $$"
    )
    _set_path()
    _replace("append_segments", "0006", "vian_writer")
    _replace("seal_segments", "0006", "vian_archiver")
    op.drop_table("stream_bases")
    op.execute("drop function refuse_rebasing")


def _replace(function: str, of: str, role: str) -> None:
    op.execute(f"drop function {function}")
    op.execute(_sql(function, of))
    op.execute(f"revoke execute on function {function} from public")
    op.execute(f"grant execute on function {function} to {role}")


def _set_path() -> None:
    """Functions keep this path; temporary tables last, lest a caller's own stand in for the log's."""
    op.execute(
        "select set_config('search_path', "
        "replace(current_setting('search_path'), ', pg_temp', '') || ', pg_temp', true)"
    )
