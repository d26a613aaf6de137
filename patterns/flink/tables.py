"""The tables that a script reads: columns by the event type's schema, event time, watermark."""

from collections.abc import Mapping

import pyarrow as pa

from patterns.flink.names import MILLISECOND_US, interval, later_sql, quoted, text

ROWTIME = "rowtime"
"""The column of event time in Flink's precision, which is milliseconds; `time` keeps its microseconds."""

_ENVELOPE = {"station": "STRING", "source": "STRING", "subject": "STRING", "time": "TIMESTAMP_LTZ(6)",
             "sequence": "BIGINT"}  # fmt: skip
_ALWAYS = ("station", "source", "time", "sequence")
_TYPES = (
    (pa.types.is_boolean, "BOOLEAN"), (pa.types.is_int8, "TINYINT"), (pa.types.is_int16, "SMALLINT"),
    (pa.types.is_int32, "INT"), (pa.types.is_integer, "BIGINT"), (pa.types.is_float32, "FLOAT"),
    (pa.types.is_floating, "DOUBLE"), (pa.types.is_timestamp, "TIMESTAMP_LTZ(6)"), (pa.types.is_duration, "BIGINT"),
)  # fmt: skip


def table_columns(reads: Mapping[str, object], schema: pa.Schema, *, has_stations: bool) -> dict[str, str]:
    """Names and Flink types of the columns that are needed of an event type: those read, and the envelope's."""
    names = [name for name in _ALWAYS if has_stations or name != "station"]
    names += [name for name in reads if name not in names and name != "type"]
    return {name: _ENVELOPE.get(name) or _flink_type(schema.field(name).type) for name in names}


def create_table(
    name: str, columns: Mapping[str, str], connector: Mapping[str, str], lateness_us: int, later_us: int = 0
) -> str:
    """CREATE TABLE with event time.

    The watermark lies a millisecond before what the lateness says: Flink drops rows that tie with it.

    Args:
        name: Of the table.
        columns: Physical columns with their types.
        connector: Its options.
        lateness_us: How late an event may be.
        later_us: How much later than the event its row is to come: for timers.
    """
    moved = later_sql("`time`", later_us) if later_us else "`time`"
    late = interval(lateness_us + MILLISECOND_US + (-lateness_us) % MILLISECOND_US)
    lines = [f"{quoted(each)} {kind}" for each, kind in columns.items()]
    lines.append(f"{quoted(ROWTIME)} AS CAST({moved} AS TIMESTAMP_LTZ(3))")
    lines.append(f"WATERMARK FOR {quoted(ROWTIME)} AS {quoted(ROWTIME)} - {late}")
    body = ",\n".join(f"    {line}" for line in lines)
    options = ",\n".join(f"    {text(key)} = {text(value)}" for key, value in connector.items())
    return f"CREATE TABLE {quoted(name)} (\n{body}\n) WITH (\n{options}\n)"


def kafka(topic: str) -> dict[str, str]:
    """A connector to be filled in: a Kafka topic of JSON objects."""
    return {
        "connector": "kafka",
        "topic": topic,
        "properties.bootstrap.servers": "HOST:9092",
        "scan.startup.mode": "earliest-offset",
        "format": "json",
        "json.timestamp-format.standard": "ISO-8601",
    }


def _flink_type(arrow_type: pa.DataType) -> str:
    if pa.types.is_dictionary(arrow_type):
        return _flink_type(arrow_type.value_type)
    return next((name for check, name in _TYPES if check(arrow_type)), "STRING")
