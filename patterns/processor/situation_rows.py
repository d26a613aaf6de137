"""Matches as rows of `situation_detected`, column by column.

Pure: the same match is the same row, whatever others it is written with. No Python object is made for a field of
a situation that a whole column can say.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime, timedelta
from itertools import groupby
from operator import attrgetter

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from events import EventType, schema_of
from patterns.binding.titles import Scalar
from patterns.engine.finds import RUN_FIRST, RUN_LAST, RUN_ROWS, RUN_STREAM, RUN_VARIABLE
from patterns.engine.json_texts import json_texts
from patterns.engine.situations import Match, Said, nearest_us

Integers = NDArray[np.int64]


def situation_rows(event_type: type[EventType], matches: Sequence[Match]) -> pa.RecordBatch:
    """A row for each match, of which there is one at least."""
    schema = schema_of(event_type)
    parts = [_rows(said, places, schema) for said, places in together(matches)]
    return parts[0] if len(parts) == 1 else pa.concat_batches(parts)


def together(matches: Sequence[Match]) -> Iterator[tuple[Said, list[int]]]:
    """The matches in their order, those that were found together as places among them."""
    for said, own in groupby(matches, key=attrgetter("said")):
        yield said, [match.at for match in own]


def json_of(values: Mapping[str, Scalar]) -> str:
    """JSON of partition columns or measures: times in ISO 8601, durations in seconds, NaN as null."""
    (text,) = _objects({name: [value] for name, value in values.items()}, 1)
    return text


def _rows(said: Said, places: list[int], schema: pa.Schema) -> pa.RecordBatch:
    rule, finds, count = said.rule, said.finds, len(places)
    first_us, last_us = ([events.times_us[at] for at in places] for events in (finds.first, finds.last))
    decided_us = [finds.decided_us[at] for at in places]
    time_us = [end if each is None else nearest_us(each) for each, end in zip(decided_us, last_us, strict=True)]
    columns = {
        "time": _times(time_us),
        "situation": said.identities(places),
        "rule": _constant(rule.rule, count),
        "rule_version": _constant(rule.version, count),
        "rule_hash": _constant(said.rule_hash, count),
        "severity": _constant(rule.severity, count),
        "title": said.titles(places),
        "partition": _objects(said.partitions(places), count),
        "measures": _objects(said.measures(places), count),
        "began_at": _times(first_us),
        "ended_at": _times(last_us),
        "lineage": _lineage(said, places, schema.field("lineage").type),
    }
    arrays = [pa.array(columns[field.name], field.type) for field in schema]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _times(microseconds: list[int]) -> pa.Array:
    return pa.array(microseconds, pa.int64()).view(pa.timestamp("us", "UTC"))


def _constant(value: str | int, count: int) -> pa.Array:
    return pa.repeat(pa.scalar(value, pa.int64() if isinstance(value, int) else pa.string()), count)


# Lineage.


def _lineage(said: Said, places: list[int], list_type: pa.DataType) -> pa.Array:
    """For each match its runs of rows, those of one variable together, and then what its rows were judged by."""
    matches, runs = _runs(said, places)
    variables, streams = pa.array(said.variables, pa.string()), pa.array(said.stream_names, pa.string())
    columns = [
        variables.take(pa.array(runs[:, RUN_VARIABLE])),
        streams.take(pa.array(runs[:, RUN_STREAM])),
        *(pa.array(np.ascontiguousarray(runs[:, column])) for column in (RUN_FIRST, RUN_LAST, RUN_ROWS)),
    ]
    if said.judged_by:
        judged = [
            (number, label, each.stream, each.first_sequence, each.last_sequence, each.rows)
            for number, at in enumerate(places)
            for label, ranges in said.judged_by[at].items()
            for each in ranges
        ]
        matches = np.append(matches, [number for number, *_ in judged]).astype(np.int64)
        order = np.argsort(matches, kind="stable")
        more = zip(*judged, strict=True) if judged else ((),) * 6
        columns = [
            pa.concat_arrays([column, pa.array(added, column.type)]).take(pa.array(order))
            for column, added in zip(columns, list(more)[1:], strict=True)
        ]
    parts = pa.StructArray.from_arrays(columns, fields=list(list_type.value_type))
    ends = np.cumsum(np.bincount(matches, minlength=len(places)))
    return pa.ListArray.from_arrays(pa.array(np.append(0, ends), pa.int32()), parts, type=list_type)


def _runs(said: Said, places: list[int]) -> tuple[Integers, Integers]:
    """For each run the number of its match, and the runs: of a match by variables, as these first took rows."""
    finds = said.finds
    begins = finds.begins[places]
    counts = finds.ends[places] - begins
    matches = np.repeat(np.arange(len(places)), counts)
    runs = finds.runs[np.arange(len(matches)) + np.repeat(begins - (np.cumsum(counts) - counts), counts)]
    variables = matches * len(said.variables) + runs[:, RUN_VARIABLE]
    _, firsts, which = np.unique(variables, return_index=True, return_inverse=True)
    order = np.argsort(firsts[which], kind="stable")
    return matches, runs[order]


# JSON.


def _objects(columns: Mapping[str, Sequence[Scalar]], count: int) -> list[str]:
    """For each row an object."""
    if not columns:
        return ["{}"] * count
    names = (name.replace("%", "%%") for name in json_texts(list(columns)))
    template = "{" + ", ".join(f"{name}: %s" for name in names) + "}"
    return [template % values for values in zip(*map(_texts, columns.values()), strict=True)]


def _texts(values: Sequence[Scalar]) -> list[str]:
    kinds = set(map(type, values))
    if len(kinds) > 1:
        return [text for value in values for text in _texts([value])]
    if kinds == {datetime}:
        return [f'"{value.isoformat()}"' for value in values if isinstance(value, datetime)]
    if kinds == {timedelta}:
        return [repr(value.total_seconds()) for value in values if isinstance(value, timedelta)]
    if kinds == {float}:
        return [repr(value) if math.isfinite(value) else "null" for value in values if isinstance(value, float)]
    return json_texts(values)
