"""The archive: which files old segments were sealed in, and how they leave the log.

Revision: 0006
"""

from importlib.resources import files

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0006"
down_revision = "0005"
branch_labels = None
depends_on = None

_FUNCTIONS = ("plan_sealing", "forget_sealing", "seal_segments", "relocate_archive")
_TABLES = ("archive_head", "sealed_files", "sealed_ranges", "archive_projections")
_TIMESTAMP = sa.TIMESTAMP(timezone=True)


def _sql(name: str, revision: str = "0006") -> str:
    return files("migrations").joinpath("sql", f"{revision}_{name}.sql").read_text(encoding="utf-8").replace(":", r"\:")


def upgrade() -> None:
    op.execute(_sql("roles"))
    op.create_table(
        "archive_head",
        sa.Column(
            "singleton", sa.Boolean, sa.CheckConstraint("singleton", name="archive_head_one_row"), primary_key=True
        ),
        sa.Column(
            "sealed_position", sa.BigInteger, nullable=False, comment="segments up to here are in sealed files only"
        ),
        sa.Column(
            "location",
            sa.Text,
            nullable=False,
            comment="URL or folder of the archive; a relative one lies in the folder of the embedded log",
        ),
        sa.Column("pending_path", sa.Text, comment="file that a sealing is writing, or was when it was killed"),
        sa.Column("pending_position", sa.BigInteger, comment="last position of that file"),
        sa.Column("is_removing", sa.Boolean, nullable=False, comment="true only inside the function seal_segments"),
        comment="One row: where the archive is, and how far the log is sealed.",
    )
    op.execute("insert into archive_head values (true, 0, 'archive', null, null, false)")
    op.create_table(
        "sealed_files",
        sa.Column("first_position", sa.BigInteger, primary_key=True, autoincrement=False, comment="first of its range"),
        sa.Column("last_position", sa.BigInteger, nullable=False, comment="last of its range, which has no hole"),
        sa.Column("path", sa.Text, nullable=False, comment="where it lies in the archive"),
        sa.Column("sha256", pg.BYTEA, nullable=False, comment="SHA-256 of the whole file"),
        sa.Column("bytes", sa.BigInteger, nullable=False, comment="size of the file, bytes"),
        sa.Column("segments", sa.BigInteger, nullable=False, comment="number of segments"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="number of events"),
        sa.Column("time_min", _TIMESTAMP, nullable=False, comment="earliest event (UTC)"),
        sa.Column("time_max", _TIMESTAMP, nullable=False, comment="latest event (UTC)"),
        sa.Column("sealed_at", _TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when it was sealed"),
        sa.UniqueConstraint("last_position", name="sealed_files_last_position"),
        sa.UniqueConstraint("path", name="sealed_files_path"),
        comment="The archive's index: one row is one sealed file, immutable.",
    )
    op.create_table(
        "sealed_ranges",
        sa.Column("stream_id", sa.BigInteger, sa.ForeignKey("streams.id", name="sealed_ranges_stream")),
        sa.Column("first_sequence", sa.BigInteger, nullable=False, comment="sequence of its first event in the file"),
        sa.Column("last_sequence", sa.BigInteger, nullable=False, comment="sequence of its last event in the file"),
        sa.Column(
            "file",
            sa.BigInteger,
            sa.ForeignKey("sealed_files.first_position", name="sealed_ranges_file"),
            nullable=False,
            comment="first position of the file",
        ),
        sa.Column("first_position", sa.BigInteger, nullable=False, comment="position of its first segment in the file"),
        sa.Column("last_position", sa.BigInteger, nullable=False, comment="position of its last segment in the file"),
        sa.Column("time_min", _TIMESTAMP, nullable=False, comment="its earliest event in the file (UTC)"),
        sa.Column("time_max", _TIMESTAMP, nullable=False, comment="its latest event in the file (UTC)"),
        sa.Column("chain_hash", pg.BYTEA, nullable=False, comment="chain hash of its last segment in the file"),
        sa.PrimaryKeyConstraint("stream_id", "first_sequence", name="sealed_ranges_pkey"),
        sa.Index("sealed_ranges_of_file", "file"),
        comment="What each sealed file holds of each stream, immutable.",
    )
    op.create_table(
        "archive_projections",
        sa.Column(
            "file",
            sa.BigInteger,
            sa.ForeignKey("sealed_files.first_position", name="archive_projections_file"),
            primary_key=True,
            autoincrement=False,
            comment="first position of the sealed file",
        ),
        sa.Column("paths", pg.ARRAY(sa.Text), nullable=False, comment="the Parquet files made of it"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="number of events in them"),
        sa.Column("segments_skipped", sa.BigInteger, nullable=False, comment="segments that could not be decoded"),
        sa.Column("note", sa.Text, comment="why the first of these could not"),
        sa.Column("projected_at", _TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when"),
        comment="Which sealed files have their decoded events in Parquet beside them.",
    )
    _set_path()
    for name in ("refuse_removal", *_FUNCTIONS):
        op.execute(_sql(name))
    _replace_append("0006")
    op.execute("drop trigger segments_no_update on segments")
    _refuse("segments", "update", "refuse_change")
    _refuse("segments", "delete", "refuse_removal")
    for table in ("sealed_files", "sealed_ranges"):
        for change in ("update or delete", "truncate"):
            _refuse(table, change, "refuse_change")
    op.execute(f"revoke execute on function {', '.join(_FUNCTIONS)} from public")
    op.execute(f"grant execute on function {', '.join(_FUNCTIONS)} to vian_archiver")
    op.execute(f"grant select on {', '.join(_TABLES)} to vian_writer, vian_archiver")
    op.execute("grant select on log_head, streams, segments to vian_archiver")
    op.execute("grant insert, update on archive_projections to vian_archiver")


def downgrade() -> None:
    op.execute(
        "do $$ begin if exists (select from sealed_files) then "
        "raise exception 'segments lie in sealed files, which the schema before does not know'; end if; end $$"
    )
    op.execute("drop trigger segments_no_update on segments")
    op.execute("drop trigger segments_no_delete on segments")
    _refuse("segments", "update or delete", "refuse_change")
    _set_path()
    _replace_append("0003")
    for name in (*_FUNCTIONS, "refuse_removal"):
        op.execute(f"drop function {name}")
    for table in reversed(_TABLES):
        op.drop_table(table)
    op.execute("revoke select on log_head, streams, segments from vian_archiver")


def _replace_append(of: str) -> None:
    op.execute("drop function append_segments")
    op.execute(_sql("append_segments", of))
    op.execute("revoke execute on function append_segments from public")
    op.execute("grant execute on function append_segments to vian_writer")


def _set_path() -> None:
    """Functions keep this path; temporary tables last, lest a caller's own stand in for the log's."""
    op.execute(
        "select set_config('search_path', "
        "replace(current_setting('search_path'), ', pg_temp', '') || ', pg_temp', true)"
    )


def _refuse(table: str, change: str, function: str) -> None:
    op.execute(
        f"create trigger {table}_no_{change.split()[0]} before {change} on {table} "
        f"for each statement execute function {function}()"
    )
