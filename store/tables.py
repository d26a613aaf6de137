"""The tables of the log and its projections, as SQLAlchemy metadata.

Contract: the sum of the migrations equals this metadata; a test compares them. SQLAlchemy describes
tables and migrates them; the hot road speaks psycopg.
"""

from typing import Any

import pyarrow as pa
import sqlalchemy as sa
from sqlalchemy.dialects import postgresql as pg

from events import EventType, schema_of

metadata = sa.MetaData()

TIMESTAMP = sa.TIMESTAMP(timezone=True)

log_head = sa.Table(
    "log_head",
    metadata,
    sa.Column("singleton", sa.Boolean, sa.CheckConstraint("singleton", name="log_head_one_row"), primary_key=True),
    sa.Column(
        "position",
        sa.BigInteger,
        nullable=False,
        comment="position of the newest segment, 0 when there is none",
    ),
    sa.Column(
        "epoch",
        sa.Integer,
        nullable=False,
        comment="epoch of this log's own streams; grows with each restore",
    ),
    sa.Column(
        "recorded_at",
        TIMESTAMP,
        nullable=False,
        server_default=sa.text("'1970-01-01 00:00:00+00'"),
        comment="when the newest segment was taken (UTC); 1970 when there is none",
    ),
    comment="One row: where the log stands. Its lock orders commits.",
)

streams = sa.Table(
    "streams",
    metadata,
    sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
    sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
    sa.Column("epoch", sa.Integer, nullable=False, comment="life of the station's log, from 1"),
    sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
    sa.Column("type", sa.Text, nullable=False, comment="event type"),
    sa.Column("sequence", sa.BigInteger, nullable=False, server_default="0", comment="sequence of the newest event"),
    sa.Column(
        "chain_hash",
        pg.BYTEA,
        nullable=False,
        server_default=sa.text(r"'\x" + "00" * 32 + "'"),
        comment="chain hash of the newest segment, SHA-256",
    ),
    sa.UniqueConstraint("station", "epoch", "source", "type", name="streams_name"),
    comment="One stream is what one source at one station says in one event type; its head.",
)

segments = sa.Table(
    "segments",
    metadata,
    sa.Column("position", sa.BigInteger, primary_key=True, autoincrement=False, comment="place in this log, gapless"),
    sa.Column("stream_id", sa.BigInteger, sa.ForeignKey("streams.id", name="segments_stream"), nullable=False),
    sa.Column("first_sequence", sa.BigInteger, nullable=False, comment="sequence of the first event in its stream"),
    sa.Column("event_count", sa.Integer, nullable=False, comment="number of events"),
    sa.Column("schema_version", sa.Integer, nullable=False, comment="version of the event type"),
    sa.Column("time_min", TIMESTAMP, nullable=False, comment="earliest event (UTC)"),
    sa.Column("time_max", TIMESTAMP, nullable=False, comment="latest event (UTC)"),
    sa.Column("recorded_at", TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
    sa.Column("producer", sa.Text, nullable=False, comment="extractor that said it"),
    sa.Column("producer_version", sa.Text, nullable=False, comment="version of the extractor"),
    sa.Column("configuration_hash", pg.BYTEA, nullable=False, comment="SHA-256 of the extractor's configuration"),
    sa.Column("payload", pg.BYTEA, comment="zstd of an Arrow record batch; null: it left the disk"),
    sa.Column("payload_hash", pg.BYTEA, nullable=False, comment="SHA-256 of the payload"),
    sa.Column("chain_hash", pg.BYTEA, nullable=False, comment="SHA-256 of previous chain hash, header, payload hash"),
    sa.UniqueConstraint("stream_id", "first_sequence", name="segments_place"),
    sa.CheckConstraint("event_count > 0", name="segments_not_empty"),
    sa.CheckConstraint(
        "octet_length(payload_hash) = 32 and octet_length(configuration_hash) = 32", name="segments_hash"
    ),
    comment="The log: one row is one append of one stream, immutable.",
)

stream_bases = sa.Table(
    "stream_bases",
    metadata,
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
    sa.Index("stream_bases_open", "stream_id", "sequence", postgresql_where=sa.text("filled_sequence < sequence")),
    sa.Index("stream_bases_position", "position"),
    comment="Where a stream was begun without what comes before it, and how far that has come since.",
)

checkpoints = sa.Table(
    "checkpoints",
    metadata,
    sa.Column("name", sa.Text, primary_key=True, comment="subscriber"),
    sa.Column("position", sa.BigInteger, nullable=False, comment="newest position that it has dealt with"),
    sa.Column("state", pg.BYTEA, nullable=False, comment="its own state, opaque here"),
    sa.Column("saved_at", TIMESTAMP, nullable=False, server_default=sa.func.now()),
    comment="How far each subscriber has come.",
)

projections = sa.Table(
    "projections",
    metadata,
    sa.Column("name", sa.Text, primary_key=True, comment="row table, named as its event type"),
    sa.Column(
        "version",
        sa.Integer,
        nullable=False,
        server_default="1",
        comment="version of the event type that the table's columns are of",
    ),
    sa.Column("retained_from", sa.Date, comment="first day (UTC) that retention has left; null where it took none"),
    comment="The row tables: rebuildable projections of segments.",
)

archive_head = sa.Table(
    "archive_head",
    metadata,
    sa.Column("singleton", sa.Boolean, sa.CheckConstraint("singleton", name="archive_head_one_row"), primary_key=True),
    sa.Column("sealed_position", sa.BigInteger, nullable=False, comment="segments up to here are in sealed files only"),
    sa.Column(
        "location",
        sa.Text,
        nullable=False,
        comment="URL or folder of the archive; a relative one lies in the folder of the embedded log",
    ),
    sa.Column("pending_path", sa.Text, comment="file that a sealing is writing, or was when it was killed"),
    sa.Column("pending_position", sa.BigInteger, comment="last position of that file"),
    sa.Column("is_removing", sa.Boolean, nullable=False, comment="true only inside the function seal_segments"),
    sa.Column(
        "is_rewriting",
        sa.Boolean,
        nullable=False,
        server_default=sa.text("false"),
        comment="true only inside the functions that take payloads off the disk and put them back",
    ),
    comment="One row: where the archive is, and how far the log is sealed.",
)

sealed_files = sa.Table(
    "sealed_files",
    metadata,
    sa.Column("first_position", sa.BigInteger, primary_key=True, autoincrement=False, comment="first of its range"),
    sa.Column("last_position", sa.BigInteger, nullable=False, comment="last of its range, which has no hole"),
    sa.Column("path", sa.Text, nullable=False, comment="where it lies in the archive"),
    sa.Column("sha256", pg.BYTEA, nullable=False, comment="SHA-256 of the whole file"),
    sa.Column("bytes", sa.BigInteger, nullable=False, comment="size of the file, bytes"),
    sa.Column("segments", sa.BigInteger, nullable=False, comment="number of segments"),
    sa.Column("events", sa.BigInteger, nullable=False, comment="number of events"),
    sa.Column("time_min", TIMESTAMP, nullable=False, comment="earliest event (UTC)"),
    sa.Column("time_max", TIMESTAMP, nullable=False, comment="latest event (UTC)"),
    sa.Column("sealed_at", TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when it was sealed"),
    sa.UniqueConstraint("last_position", name="sealed_files_last_position"),
    sa.UniqueConstraint("path", name="sealed_files_path"),
    comment="The archive's index: one row is one sealed file, immutable.",
)

sealed_ranges = sa.Table(
    "sealed_ranges",
    metadata,
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
    sa.Column("time_min", TIMESTAMP, nullable=False, comment="its earliest event in the file (UTC)"),
    sa.Column("time_max", TIMESTAMP, nullable=False, comment="its latest event in the file (UTC)"),
    sa.Column("chain_hash", pg.BYTEA, nullable=False, comment="chain hash of its last segment in the file"),
    sa.PrimaryKeyConstraint("stream_id", "first_sequence", name="sealed_ranges_pkey"),
    sa.Index("sealed_ranges_of_file", "file"),
    comment="What each sealed file holds of each stream, immutable.",
)

archive_projections = sa.Table(
    "archive_projections",
    metadata,
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
    sa.Column("projected_at", TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when"),
    comment="Which sealed files have their decoded events in Parquet beside them.",
)

maintenance = sa.Table(
    "maintenance",
    metadata,
    sa.Column("id", sa.BigInteger, sa.Identity(always=True), primary_key=True),
    sa.Column("at", TIMESTAMP, nullable=False, server_default=sa.func.now(), comment="when it was done (UTC)"),
    sa.Column("action", sa.Text, nullable=False, comment="backed_up, restore_began, restored or verified"),
    sa.Column("place", sa.Text, nullable=False, comment="folder of the backup"),
    sa.Column("position", sa.BigInteger, nullable=False, comment="position up to which it holds"),
    sa.CheckConstraint("action in ('backed_up', 'restore_began', 'restored', 'verified')", name="maintenance_action"),
    comment="Backups of this log, and the restore that it came from.",
)

field_callers = sa.Table(
    "field_callers",
    metadata,
    sa.Column(
        "transaction",
        sa.BigInteger,
        primary_key=True,
        autoincrement=False,
        comment="transaction that answers a question",
    ),
    sa.Column("stations", pg.ARRAY(sa.Text), comment="stations whose events it may read; null for all"),
    comment="Whom a question from the field is answered for: seen by its transaction alone, which never commits.",
    prefixes=["UNLOGGED"],
)


_LOOKED_UP = {"plate_read": "plate_key(plate)"}
"""Row tables whose events are looked for by a text of theirs: what is looked at. It and the time have an index."""

stations = sa.Table(
    "stations",
    metadata,
    sa.Column("name", sa.Text, primary_key=True, comment="the station"),
    sa.Column("key_id", sa.Text, nullable=False, comment="name of its key, in hexadecimal"),
    sa.Column("public_key", pg.BYTEA, nullable=False, comment="its public key, Ed25519, 32 bytes"),
    sa.Column("operations", pg.ARRAY(sa.Text), nullable=False, comment="what it may do"),
    sa.Column("reads", pg.ARRAY(sa.Text), nullable=False, comment="stations that it may find and query; * for all"),
    sa.Column("enrolled_at", TIMESTAMP, nullable=False, comment="when it was taken in (UTC)"),
    sa.Column("revoked_at", TIMESTAMP, comment="when it was shut out (UTC); null: it may speak"),
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

enrolment_codes = sa.Table(
    "enrolment_codes",
    metadata,
    sa.Column("code_hash", pg.BYTEA, primary_key=True, comment="SHA-256 of the code"),
    sa.Column("station", sa.Text, nullable=False, comment="the station that it takes in"),
    sa.Column("operations", pg.ARRAY(sa.Text), nullable=False, comment="what the station will be allowed to do"),
    sa.Column("reads", pg.ARRAY(sa.Text), nullable=False, comment="stations that it may find and query; * for all"),
    sa.Column("made_at", TIMESTAMP, nullable=False, comment="when it was made (UTC)"),
    sa.Column("expires_at", TIMESTAMP, nullable=False, comment="when it ends (UTC)"),
    sa.Column("used_at", TIMESTAMP, comment="when it was used (UTC); it does not count again"),
    comment="One-time codes by which stations are taken in.",
)

sync_tokens = sa.Table(
    "sync_tokens",
    metadata,
    sa.Column("token_hash", pg.BYTEA, primary_key=True, comment="SHA-256 of the token"),
    sa.Column("station", sa.Text, nullable=False, comment="the station that it was given to"),
    sa.Column("made_at", TIMESTAMP, nullable=False, comment="when it was given (UTC)"),
    sa.Column("expires_at", TIMESTAMP, nullable=False, comment="when it ends (UTC)"),
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

station_contacts = sa.Table(
    "station_contacts",
    metadata,
    sa.Column("station", sa.Text, primary_key=True, comment="the station"),
    sa.Column("last_contact_at", TIMESTAMP, nullable=False, comment="when it was last heard of (UTC)"),
    sa.Column("hello_at", TIMESTAMP, nullable=False, comment="when its newest hello came (UTC)"),
    sa.Column("program", sa.Text, nullable=False, comment="its program, as it said"),
    sa.Column("protocol", sa.Integer, nullable=False, comment="version of the protocol in which it said so"),
    sa.Column("epoch", sa.Integer, nullable=False, comment="life of its log, as it said"),
    sa.Column("clock_offset_s", sa.Double, nullable=False, comment="how far central's clock was ahead of its own, s"),
    sa.Column("heads", pg.JSONB, nullable=False, comment="of each stream that it sends: name, epoch, sequence"),
    comment="What central heard last of each station. For people to look at: nothing is decided by it.",
)


_SQL_TYPES: dict[pa.DataType, Any] = {
    pa.bool_(): sa.Boolean(),
    pa.int64(): sa.BigInteger(),
    pa.float64(): sa.Double(),
    pa.float32(): sa.REAL(),
    pa.string(): sa.Text(),
    pa.binary(): pg.BYTEA(),
    pa.timestamp("us", tz="UTC"): TIMESTAMP,
}


def is_json(field: pa.Field) -> bool:
    """Whether a field of an event type becomes a `jsonb` column."""
    return b"json" in (field.metadata or {}) or pa.types.is_list(field.type)


def projection_table(event_type: type[EventType], into: sa.MetaData) -> sa.Table:
    """The row table of an event type: the envelope's columns and the type's fields.

    The order of its columns is nobody's contract: people read the views `events` and `<type>_events`.
    """
    payload = [
        sa.Column(
            field.name,
            pg.JSONB() if is_json(field) else _SQL_TYPES[field.type],
            nullable=field.nullable,
            comment=field.metadata[b"description"].decode(),
        )
        for field in schema_of(event_type)
        if field.name != "time"
    ]
    name = event_type.type_name
    table = sa.Table(
        name,
        into,
        sa.Column("station", sa.Text, nullable=False, comment="station that recorded it"),
        sa.Column("source", sa.Text, nullable=False, comment="camera or sensor"),
        sa.Column("subject", sa.Text, comment="what it is about"),
        sa.Column("time", TIMESTAMP, nullable=False, comment="when it happened (UTC)"),
        sa.Column("sequence", sa.BigInteger, nullable=False, comment="place in its stream"),
        sa.Column("position", sa.BigInteger, nullable=False, comment="position of its segment in this log"),
        sa.Column("recorded_at", TIMESTAMP, nullable=False, comment="when this log took it (UTC)"),
        *payload,
        sa.Column("epoch", sa.Integer, nullable=False, server_default="1", comment="life of the station's log, from 1"),
        sa.Index(f"{name}_time", "time", postgresql_using="brin"),
        sa.Index(f"{name}_position", "position", postgresql_using="brin"),
        comment=" ".join((event_type.__doc__ or name).split()),
        postgresql_partition_by="RANGE (time)",
    )
    if name in _LOOKED_UP:
        key: Any = sa.literal_column(_LOOKED_UP[name]).label("key")
        sa.Index(f"{name}_key", key, table.c.time, postgresql_ops={"key": "text_pattern_ops"})
    return table
