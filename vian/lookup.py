"""Plates and situations in this station's own log: the same question that central answers, without a link.

Contract: straight from the segments, so that no projection is needed and rows that retention dropped are found too.
What is kept in memory is what was found, and of that no more than is asked for, but for one segment. Events whose
payload left this station's disk are not found here; central has them.
"""

import logging
import re
from collections.abc import Iterator
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from events import EventBatch, Segment, UnknownType, decode, with_envelope
from store import Log
from sync.central.lookup import KEY, SEPARATORS, columns_of, like, plate_key
from sync.protocol.questions import FindQuestion

logger = logging.getLogger(__name__)

TYPES = {"plate": "plate_read", "situation": "situation_detected"}
_KEPT_MIN = 10_000
"""Rows that are gathered before the newest are chosen among them."""


def look_up(log: Log, question: FindQuestion, limit: int | None) -> list[dict[str, Any]]:
    """The newest rows that answer the question, as central would give them; all for no limit."""
    found: list[pa.Table] = []
    rows = 0
    for segment, events in _decoded(log, question):
        table = _matching(_placed(segment, events), question)
        if table.num_rows:
            found.append(table)
            rows += table.num_rows
        if limit is not None and rows > max(limit, _KEPT_MIN):
            found = [_newest(found, limit)]
            rows = found[0].num_rows
    if not found:
        return []
    names = [column.name for column in columns_of(question.kind)]
    newest = _newest(found, limit).select(names)
    values = {name: _values(newest.column(name)) for name in names}
    return [dict(zip(names, row, strict=True)) for row in zip(*values.values(), strict=True)]


def _decoded(log: Log, question: FindQuestion) -> Iterator[tuple[Segment, EventBatch]]:
    segments = log.read_all(
        types=[TYPES[question.kind]],
        sources=[question.source] if question.source else None,
        stations=[question.station] if question.station else None,
        since=question.since,
        until=question.until,
    )
    for segment in segments:
        try:
            yield segment, decode(segment, log.catalogue)
        except UnknownType as error:
            logger.warning("the answer leaves out %d events: %s", segment.header.event_count, error)


def _placed(segment: Segment, events: EventBatch) -> pa.Table:
    """The events with what tells them apart: epoch and id."""
    batch = with_envelope(segment.stream, segment.header.first_sequence, events)
    epoch = segment.header.epoch
    prefix = f"{segment.stream}/{f'{epoch}:' if epoch > 1 else ''}"
    ids = pc.binary_join_element_wise(prefix, batch.column("sequence").cast(pa.string()), "")
    epochs = pa.repeat(pa.scalar(epoch, pa.int32()), batch.num_rows)
    return pa.table(batch.append_column("id", ids).append_column("epoch", epochs))


def _matching(table: pa.Table, question: FindQuestion) -> pa.Table:
    conditions = []
    if question.since is not None:
        conditions.append(pc.field("time") >= pa.scalar(question.since, pa.timestamp("us", tz="UTC")))
    if question.until is not None:
        conditions.append(pc.field("time") < pa.scalar(question.until, pa.timestamp("us", tz="UTC")))
    if question.severity is not None:
        conditions.append(pc.field("severity") == question.severity)
    for condition in conditions:
        table = table.filter(condition)
    if question.plate is not None:
        table = table.filter(pc.match_like(_keys(table.column("plate")), like(plate_key(question.plate))))
    if question.rule is not None:
        table = table.filter(pc.match_like(table.column("rule"), like(question.rule)))
    return table


def _keys(plates: pa.ChunkedArray) -> pa.ChunkedArray:
    """Each plate as `plate_key` gives it."""
    return pc.replace_substring_regex(pc.ascii_upper(plates), f"[{re.escape(SEPARATORS)}]", "")


def _values(column: pa.ChunkedArray) -> list[Any]:
    """The values; a float of 32 bits with the digits that it has, as central tells it."""
    if not pa.types.is_float32(column.type):
        return list(column.to_pylist())
    return [None if text is None else float(text) for text in column.cast(pa.string()).to_pylist()]


def _newest(tables: list[pa.Table], limit: int | None) -> pa.Table:
    table = pa.concat_tables(tables).sort_by([(name, "descending") for name in KEY])
    return table if limit is None else table.slice(0, limit)
