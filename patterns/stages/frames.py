"""Final rows of tracks, frame by frame: all points of one source with one time are one frame.

Points of confidence 0 are predicted, not seen, and do not count. Of a track that has two points in one
frame, the last counts.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from patterns.binding.expressions import Kind
from patterns.binding.rows import TIME

READS = {
    "source": Kind.STRING, "track_id": Kind.INT, "x": Kind.FLOAT, "y": Kind.FLOAT, "vx": Kind.FLOAT,
    "vy": Kind.FLOAT, "confidence": Kind.FLOAT,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame's seen points, by ascending track number.

    Attributes:
        source: The source.
        time_us: Its time in microseconds.
        tracks: Track numbers, shape (n,).
        xy: Ground contact points in px, shape (n, 2).
        vxy: Their velocities in px/s, shape (n, 2).
    """

    source: str
    time_us: int
    tracks: NDArray[np.int64]
    xy: NDArray[np.float64]
    vxy: NDArray[np.float64]

    def first(self, count: int) -> "Frame":
        """The frame with the points of the lowest track numbers only, at most so many."""
        return Frame(self.source, self.time_us, self.tracks[:count], self.xy[:count], self.vxy[:count])


def frames(rows: pa.Table) -> Iterator[Frame]:
    """The frames of rows in the total order: by time, at one time by source."""
    if rows.num_rows == 0:
        return
    encoded = rows.column("source").combine_chunks().dictionary_encode()
    names = encoded.dictionary.to_pylist()
    sources = encoded.indices.to_numpy()
    times, tracks = rows.column(TIME).to_numpy(), _numbers(rows, "track_id", np.int64)
    x, y, vx, vy, confidence = (_numbers(rows, name, np.float64) for name in ("x", "y", "vx", "vy", "confidence"))
    rank = np.argsort(np.argsort(np.array(names, dtype=object), kind="stable"))[sources]
    order = np.lexsort((tracks, rank, times))
    starts = np.flatnonzero(
        (np.diff(times[order], prepend=times.min() - 1) != 0) | (np.diff(rank[order], prepend=-1) != 0)
    )
    for begin, end in zip(starts, np.append(starts[1:], len(order)), strict=True):
        here = order[begin:end]
        is_last = np.append(tracks[here][1:] != tracks[here][:-1], True)
        is_seen = (confidence[here] > 0) & np.isfinite(x[here]) & np.isfinite(y[here])
        kept = here[is_last & is_seen]
        xy, vxy = np.column_stack((x[kept], y[kept])), np.nan_to_num(np.column_stack((vx[kept], vy[kept])))
        yield Frame(names[sources[here[0]]], int(times[here[0]]), tracks[kept], xy, vxy)


def _numbers(rows: pa.Table, name: str, dtype: type) -> NDArray[Any]:
    """The column's numbers; a point without confidence is not seen, one without coordinates is nowhere."""
    column = rows.column(name)
    filler = -1 if dtype is np.int64 else np.nan
    return np.asarray(column.fill_null(filler).to_numpy(), dtype=dtype)
