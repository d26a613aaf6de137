"""Row tables of the event types that ViAn ships, and the view `events` over them.

Revision: 0002
"""

import sqlalchemy as sa
from alembic import op
from sqlalchemy.dialects import postgresql as pg

revision = "0002"
down_revision = "0001"
branch_labels = None
depends_on = None

_TIMESTAMP = sa.TIMESTAMP(timezone=True)
_TYPES = (
    "video_added",
    "process_started",
    "process_progressed",
    "process_finished",
    "process_failed",
    "track_point",
    "track_ended",
    "activity_interval",
    "situation_detected",
    "rule_deployed",
    "sync_planned",
)


def upgrade() -> None:
    _row_table(
        "video_added",
        "A recorded video became known as footage of a source.",
        sa.Column("video", sa.Text, nullable=False, comment="name of the video: SHA-256 of its bytes in hexadecimal"),
        sa.Column("path", sa.Text, nullable=False, comment="where it was when it was added; for people, not a key"),
        sa.Column("width", sa.BigInteger, nullable=False, comment="width of a frame, px"),
        sa.Column("height", sa.BigInteger, nullable=False, comment="height of a frame, px"),
        sa.Column(
            "fps",
            sa.Double,
            nullable=True,
            comment="nominal frames per second of the container, 1/s; null where it has none",
        ),
        sa.Column(
            "frames_expected",
            sa.BigInteger,
            nullable=True,
            comment="frames that the container announces; null where it does not say",
        ),
        sa.Column("codec", sa.Text, nullable=False, comment="codec of the video stream, as the decoder names it"),
        sa.Column("started_at", _TIMESTAMP, nullable=False, comment="wall-clock time of the first frame (UTC)"),
    )
    _row_table(
        "process_started",
        "An extractor began to work on a video.",
        sa.Column(
            "process",
            sa.Text,
            nullable=False,
            comment="name of the process: hash of source, video, extractor, version and configuration",
        ),
        sa.Column("extractor", sa.Text, nullable=False, comment="name of the extractor"),
        sa.Column("extractor_version", sa.Text, nullable=False, comment="version of the extractor"),
        sa.Column("configuration", pg.JSONB, nullable=False, comment="the extractor's whole configuration"),
        sa.Column("video", sa.Text, nullable=False, comment="the video it works on: SHA-256 in hexadecimal"),
    )
    _row_table(
        "process_progressed",
        "An extractor got so far, or noticed something about its input.",
        sa.Column("process", sa.Text, nullable=False, comment="name of the process"),
        sa.Column("frames", sa.BigInteger, nullable=False, comment="frames worked on so far"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="events emitted so far"),
        sa.Column(
            "note",
            sa.Text,
            nullable=True,
            comment="what was noticed: a gap, a change of the frame's size; null for plain progress",
        ),
    )
    _row_table(
        "process_finished",
        "An extractor came to the end of its input.",
        sa.Column("process", sa.Text, nullable=False, comment="name of the process"),
        sa.Column("frames", sa.BigInteger, nullable=False, comment="frames worked on"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="events emitted"),
        sa.Column(
            "gaps",
            sa.BigInteger,
            nullable=False,
            comment="gaps in the input: undecodable frames, changes of size, frames announced and not there",
        ),
    )
    _row_table(
        "process_failed",
        "An extractor stopped at an error; all that it emitted before stands.",
        sa.Column("process", sa.Text, nullable=False, comment="name of the process"),
        sa.Column("frames", sa.BigInteger, nullable=False, comment="frames worked on before the error"),
        sa.Column("events", sa.BigInteger, nullable=False, comment="events emitted before the error"),
        sa.Column("error", sa.Text, nullable=False, comment="what went wrong, as told to the user"),
    )
    _row_table(
        "track_point",
        "Where one tracked object is in one frame.",
        sa.Column("track_id", sa.BigInteger, nullable=False, comment="number of the track, unique within its source"),
        sa.Column("frame", sa.BigInteger, nullable=False, comment="number of the frame within the video, from 0"),
        sa.Column(
            "x",
            sa.REAL,
            nullable=False,
            comment="filtered ground contact point (middle of the box's lower edge), px",
        ),
        sa.Column(
            "y",
            sa.REAL,
            nullable=False,
            comment="filtered ground contact point (middle of the box's lower edge), px",
        ),
        sa.Column("x1", sa.REAL, nullable=False, comment="left edge of the box, px"),
        sa.Column("y1", sa.REAL, nullable=False, comment="upper edge of the box, px"),
        sa.Column("x2", sa.REAL, nullable=False, comment="right edge of the box, px"),
        sa.Column("y2", sa.REAL, nullable=False, comment="lower edge of the box, px"),
        sa.Column("vx", sa.REAL, nullable=False, comment="filtered velocity of the ground contact point, px/s"),
        sa.Column("vy", sa.REAL, nullable=False, comment="filtered velocity of the ground contact point, px/s"),
        sa.Column(
            "confidence",
            sa.REAL,
            nullable=False,
            comment="how far the box rests on what was seen in this frame, 0 (predicted) to 1 (seen)",
        ),
    )
    _row_table(
        "track_ended",
        "A track came to its end; its time is that of its last point.",
        sa.Column("track_id", sa.BigInteger, nullable=False, comment="number of the track, unique within its source"),
        sa.Column("began_at", _TIMESTAMP, nullable=False, comment="time of the first point (UTC)"),
        sa.Column("first_frame", sa.BigInteger, nullable=False, comment="frame of the first point"),
        sa.Column("last_frame", sa.BigInteger, nullable=False, comment="frame of the last point"),
        sa.Column("points", sa.BigInteger, nullable=False, comment="number of track points"),
        sa.Column("path_px", sa.REAL, nullable=False, comment="length of the path of the ground contact point, px"),
        sa.Column("x_entry", sa.REAL, nullable=False, comment="first ground contact point, px"),
        sa.Column("y_entry", sa.REAL, nullable=False, comment="first ground contact point, px"),
        sa.Column("x_exit", sa.REAL, nullable=False, comment="last ground contact point, px"),
        sa.Column("y_exit", sa.REAL, nullable=False, comment="last ground contact point, px"),
        sa.Column("reason", sa.Text, nullable=False, comment="why it ended"),
    )
    _row_table(
        "activity_interval",
        "A span of time in which something moved; its time is the span's beginning.",
        sa.Column("ended_at", _TIMESTAMP, nullable=False, comment="end of the span (UTC)"),
        sa.Column("first_frame", sa.BigInteger, nullable=False, comment="first frame with motion"),
        sa.Column("last_frame", sa.BigInteger, nullable=False, comment="last frame with motion"),
        sa.Column("tracks_max", sa.BigInteger, nullable=False, comment="most tracks seen at once"),
        sa.Column(
            "area_share_max",
            sa.REAL,
            nullable=False,
            comment="largest share of the picture in motion, 0 to 1",
        ),
    )
    _row_table(
        "situation_detected",
        "A rule's pattern matched; its time is that of the event that decided the match.",
        sa.Column(
            "situation",
            sa.Text,
            nullable=False,
            comment="identity: hash of rule, version, partition, first and last event, in hexadecimal",
        ),
        sa.Column("rule", sa.Text, nullable=False, comment="name of the rule"),
        sa.Column("rule_version", sa.BigInteger, nullable=False, comment="version of the rule"),
        sa.Column(
            "rule_hash",
            sa.Text,
            nullable=False,
            comment="SHA-256 of the rule's canonical form, in hexadecimal",
        ),
        sa.Column("severity", sa.Text, nullable=False, comment="severity that the rule gives"),
        sa.Column("title", sa.Text, nullable=False, comment="title for people, filled in"),
        sa.Column("partition", pg.JSONB, nullable=False, comment="values of the PARTITION BY columns by name"),
        sa.Column("measures", pg.JSONB, nullable=False, comment="values of the MEASURES by name; times in ISO 8601"),
        sa.Column("began_at", _TIMESTAMP, nullable=False, comment="time of the first matched event (UTC)"),
        sa.Column("ended_at", _TIMESTAMP, nullable=False, comment="time of the last matched event (UTC)"),
        sa.Column(
            "lineage",
            pg.JSONB,
            nullable=False,
            comment="the events that the match rests on, by pattern variable",
        ),
    )
    _row_table(
        "rule_deployed",
        "A version of a rule was put into service.",
        sa.Column("rule", sa.Text, nullable=False, comment="name of the rule"),
        sa.Column("rule_version", sa.BigInteger, nullable=False, comment="version of the rule"),
        sa.Column(
            "rule_hash",
            sa.Text,
            nullable=False,
            comment="SHA-256 of the rule's canonical form, in hexadecimal",
        ),
        sa.Column("text", sa.Text, nullable=False, comment="the rule file, whole"),
    )
    _row_table(
        "sync_planned",
        "A station decided which streams to replicate, in which order.",
        sa.Column("central", sa.Text, nullable=False, comment="address of the central server"),
        sa.Column("plan", pg.JSONB, nullable=False, comment="the whole plan: ordered entries"),
        sa.Column(
            "plan_hash",
            sa.Text,
            nullable=False,
            comment="SHA-256 of the plan's canonical form, in hexadecimal",
        ),
    )
    op.execute(_events_view())
    op.execute("grant select on events to vian_writer, vian_reader")


def downgrade() -> None:
    op.execute("drop view events")
    # Those of plug-ins too: row tables are rebuilt from the log.
    op.execute(
        "do $$ declare r record; begin for r in delete from projections returning name loop "
        "execute format('drop table %I', r.name); end loop; end $$"
    )


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


def _events_view() -> str:
    selects = (
        f"select station || '/' || source || '/{name}/' || sequence as id, station, source, "
        f"cast('{name}' as text) as type, subject, time, sequence, position, recorded_at from {name}"
        for name in sorted(_TYPES)
    )
    return "create view events as " + " union all ".join(selects)
