"""Row tables of what becomes of rules in service, and version 2 of `rule_deployed`.

`situation_shadowed`, `rule_retired` and `rule_missed` join the view `events`. `rule_deployed` gets
`after_position` and `is_shadow`, filled in for the rows that are there as the upcaster would.

Revision: 0010
"""

from typing import Any

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0010"
down_revision = "0009"
branch_labels = None
depends_on = None

_DEPLOYED_BEFORE = "A version of a rule was put into service."
_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = ("situation_shadowed", "rule_retired", "rule_missed")


def upgrade() -> None:
    _add_place_and_shadow()
    _row_table(
        "situation_shadowed",
        "A rule that runs in shadow matched: what would have been its `situation_detected`. It alerts nobody.",
        sa.Column(
            "situation",
            sa.Text,
            nullable=False,
            comment="identity: hash of rule, version, partition, first and last event, in hexadecimal",
        ),
        *_rule(),
        sa.Column("rule_hash", sa.Text, nullable=False, comment="SHA-256 of the rule's canonical form, in hexadecimal"),
        sa.Column("severity", sa.Text, nullable=False, comment="severity that the rule gives"),
        sa.Column("title", sa.Text, nullable=False, comment="title for people, filled in"),
        sa.Column("partition", pg.JSONB, nullable=False, comment="values of the PARTITION BY columns by name"),
        sa.Column("measures", pg.JSONB, nullable=False, comment="values of the MEASURES by name; times in ISO 8601"),
        sa.Column("began_at", _TIMESTAMP, nullable=False, comment="time of the first matched event (UTC)"),
        sa.Column("ended_at", _TIMESTAMP, nullable=False, comment="time of the last matched event (UTC)"),
        sa.Column(
            "lineage", pg.JSONB, nullable=False, comment="the events that the match rests on, by pattern variable"
        ),
    )
    _row_table(
        "rule_retired",
        "A version of a rule was taken out of service; deploying it again brings it back.",
        *_rule(),
        sa.Column(
            "why",
            sa.Text,
            nullable=False,
            comment="told: somebody said so; replaced: another version took over; failed: it raised; "
            "too_slow: over its budget",
        ),
        sa.Column(
            "open_matches",
            sa.Text,
            nullable=False,
            comment="what becomes of matches that had begun: dropped at once, or still finished, "
            "while no new one begins",
        ),
        sa.Column(
            "reason",
            sa.Text,
            nullable=False,
            comment="why, as told to the user; of a rule that failed, with the position where it did",
        ),
    )
    _row_table(
        "rule_missed",
        "A rule went on without something that it should have had: a sum since the last one, by kind and stream.",
        *_rule(),
        sa.Column(
            "what",
            sa.Text,
            nullable=False,
            comment="events behind the watermark, events far ahead of the log's own clock, or matches that had begun",
        ),
        sa.Column("count", sa.BigInteger, nullable=False, comment="how many"),
        sa.Column(
            "stream",
            sa.Text,
            nullable=True,
            comment="stream of the events, as station/source/type; null for partial matches",
        ),
        sa.Column(
            "first_sequence",
            sa.BigInteger,
            nullable=True,
            comment="least sequence among the events, inclusive; null for partial matches",
        ),
        sa.Column(
            "last_sequence",
            sa.BigInteger,
            nullable=True,
            comment="greatest sequence among the events, inclusive; null for partial matches",
        ),
        sa.Column("began_at", _TIMESTAMP, nullable=False, comment="time of the earliest that was missed (UTC)"),
        sa.Column("ended_at", _TIMESTAMP, nullable=False, comment="time of the latest that was missed (UTC)"),
        sa.Column(
            "partition",
            pg.JSONB,
            nullable=True,
            comment="partition columns of the first partial matches that were given up; null for events",
        ),
        sa.Column("reason", sa.Text, nullable=False, comment="why, and which setting decided it"),
    )


def downgrade() -> None:
    op.execute("drop view rule_deployed_events")
    op.drop_column("rule_deployed", "after_position")
    op.drop_column("rule_deployed", "is_shadow")
    op.create_table_comment("rule_deployed", _DEPLOYED_BEFORE)
    op.execute("update projections set version = 1 where name = 'rule_deployed'")
    op.execute("select make_event_view('rule_deployed')")
    # The events stay in the log: row tables are rebuilt from it.
    for name in _TYPES:
        op.execute(f"select drop_projection('{name}')")


def _rule() -> tuple[sa.Column[Any], ...]:
    return (
        sa.Column("rule", sa.Text, nullable=False, comment="name of the rule"),
        sa.Column("rule_version", sa.BigInteger, nullable=False, comment="version of the rule"),
    )


def _add_place_and_shadow() -> None:
    op.add_column(
        "rule_deployed",
        sa.Column(
            "after_position",
            sa.BigInteger,
            nullable=True,
            server_default="0",
            comment="the rule sees the log behind this position; null: behind this very event",
        ),
    )
    op.add_column(
        "rule_deployed",
        sa.Column(
            "is_shadow",
            sa.Boolean,
            nullable=False,
            server_default="false",
            comment="whether what it finds is recorded as `situation_shadowed`, which alerts nobody",
        ),
    )
    for name in ("after_position", "is_shadow"):
        op.alter_column("rule_deployed", name, server_default=None)
    op.create_table_comment(
        "rule_deployed",
        "A version of a rule was put into service, or back into it, from a place in the log on.",
        existing_comment=_DEPLOYED_BEFORE,
    )
    op.execute("update projections set version = 2 where name = 'rule_deployed'")
    op.execute("select adopt_projection('rule_deployed')")  # its view gets the columns


def _row_table(name: str, comment: str, *payload: sa.Column[object]) -> None:
    op.create_table(
        name,
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("subject", sa.Text, comment="what it is about"),
        sa.Column("time", _TIMESTAMP, nullable=False, comment="when it happened (UTC)"),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="place in its stream"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position of its segment in this log"),
        sa.Column("recorded_at", _TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        *payload,
        comment=comment,
        postgresql_partition_by="RANGE (time)",
    )
    op.create_index(f"{name}_time", name, ["time"], postgresql_using="brin")
    op.create_index(f"{name}_position", name, ["position"], postgresql_using="brin")
    op.execute(f"select adopt_projection('{name}')")
