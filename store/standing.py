"""Where all streams stand at one moment: heads, runs and bases, and how rows become them.

Contract: pure; a query is text with named parameters. A stream without gaps has one run; one of which nothing is here
has none. `filled_sequence` of a base is how far the run below it has come, so that the runs follow from the bases and
the head.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

from events import GENESIS, Base, Place, Run, StreamName

_NAMED = "s.station = %(station)s and s.source = %(source)s and s.type = %(type)s and s.epoch = %(epoch)s"
_STREAM = "s.station, s.source, s.type, s.epoch"
_BASE = "b.sequence, b.chain_hash, b.position"

STANDING = (
    f"select h.position, {_STREAM}, s.sequence, s.chain_hash, {_BASE}, b.filled_sequence, b.filled_hash "
    "from log_head h left join streams s on true left join stream_bases b on b.stream_id = s.id "
    "order by s.station, s.source, s.type, s.epoch, b.sequence"
)
"""One row a base; a stream without has one row, and so has a log without streams."""

_OPEN = (
    "s.sequence, s.chain_hash, b.sequence, b.chain_hash, b.filled_sequence, b.filled_hash "
    "from streams s left join stream_bases b on b.stream_id = s.id and b.filled_sequence < b.sequence"
)
SOME_RUNS = (
    f"select {_STREAM}, {_OPEN} join unnest(%(stations)s::text[], %(sources)s::text[], %(types)s::text[], "
    f"%(epochs)s::integer[]) as w(station, source, type, epoch) "
    "on w.station = s.station and w.source = s.source and w.type = s.type and w.epoch = s.epoch "
    "order by s.station, s.source, s.type, s.epoch, b.sequence"
)
RUNS = f"select {_OPEN} where {_NAMED} order by b.sequence"
ALL_RUNS = (
    f"select {_STREAM}, {_OPEN} where %(station)s::text is null or s.station = %(station)s "
    "order by s.station, s.source, s.type, s.epoch, b.sequence"
)
"""Bases that what comes before has reached are left out: they may be many."""

BASES = (
    f"select {_STREAM}, {_BASE} from stream_bases b join streams s on s.id = b.stream_id "
    "where b.position between %(first)s and %(last)s order by b.position"
)


@dataclass(frozen=True, slots=True)
class StreamHead:
    """Where one stream stands."""

    stream: StreamName
    epoch: int
    sequence: int
    chain_hash: bytes


@dataclass(frozen=True, slots=True)
class Standing:
    """A log at one moment."""

    position: int
    heads: list[StreamHead]
    """of all streams, by name"""
    runs: dict[Place, list[Run]]
    """of each stream that holds events, ascending"""
    bases: list[Base]
    """of all streams, those included that what comes before has reached"""


@dataclass(slots=True)
class _Stream:
    sequence: int
    chain_hash: bytes
    bases: list[Sequence[Any]]


def standing_of(rows: Iterable[Sequence[Any]]) -> Standing:
    """What the rows of `STANDING` say."""
    streams: dict[Place, _Stream] = {}
    position = 0
    for position, station, source, type_, epoch, sequence, chain_hash, *base in rows:  # noqa: B007  # the same in all
        if station is None:
            continue
        stream = streams.setdefault((StreamName(station, source, type_), epoch), _Stream(sequence, chain_hash, []))
        if base[0] is not None:
            stream.bases.append(base)
    return Standing(
        position,
        [StreamHead(*place, each.sequence, each.chain_hash) for place, each in streams.items()],
        {
            place: runs
            for place, each in streams.items()
            if (runs := runs_of(each.sequence, each.chain_hash, [(b[0], b[1], b[3], b[4]) for b in each.bases]))
        },
        [Base(*place, *base[:3]) for place, each in streams.items() for base in each.bases],
    )


def runs_of(sequence: int, chain_hash: bytes, bases: Iterable[Sequence[Any]]) -> list[Run]:
    """The runs of a stream.

    Args:
        sequence: Its head.
        chain_hash: The head's.
        bases: Sequence, chain hash, filled sequence and its chain hash of each base, ascending.
    """
    runs = []
    after, after_hash = 0, GENESIS
    for base, base_hash, filled, filled_hash in bases:
        if base is None or filled == base:
            continue
        if filled > after:
            runs.append(Run(after, after_hash, filled, filled_hash))
        after, after_hash = base, base_hash
    return [*runs, Run(after, after_hash, sequence, chain_hash)] if sequence > after else runs


def all_runs_of(rows: Iterable[Sequence[Any]]) -> dict[Place, list[Run]]:
    """What the rows of `ALL_RUNS` or `SOME_RUNS` say; a stream without events is left out."""
    runs = {
        (StreamName(*names), epoch): runs_of(each[0][4], each[0][5], [row[6:] for row in each])
        for (*names, epoch), each in ((key, list(group)) for key, group in groupby(rows, lambda row: row[:4]))
    }
    return {place: each for place, each in runs.items() if each}


def base_of(row: Sequence[Any]) -> Base:
    """The base that a row of `BASES` holds."""
    station, source, type_, epoch, sequence, chain_hash, position = row
    return Base(StreamName(station, source, type_), epoch, sequence, chain_hash, position)
