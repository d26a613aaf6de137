"""The input of one clause as the clause sees it: sorted by partition and order."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from patterns.querying.duck import Duck, quoted

_NUMBER = "row number at hand"


@dataclass(frozen=True, slots=True)
class OrderedRows:
    """Rows by partition and, within one, in their order.

    Attributes:
        table: The rows.
        partitions: For each row the number of its partition, ascending.
        bounds: Where each partition begins, and the end.
    """

    table: pa.Table
    partitions: NDArray[np.int64]
    bounds: NDArray[np.int64]

    def shifted(self, column: pa.ChunkedArray, shift: int) -> pa.ChunkedArray:
        """For each row the column's value so many rows further on in its partition; NULL beyond it."""
        return column if shift == 0 else self.at(column, np.arange(len(self.partitions)) + shift, self.partitions)

    def at(self, column: pa.ChunkedArray, rows: NDArray[np.int64], partitions: NDArray[np.int64]) -> pa.ChunkedArray:
        """The column's value at each of these rows; NULL where there is none in the partition said."""
        count = len(self.partitions)
        if count == 0:
            return pa.chunked_array([pa.nulls(len(rows), column.type)])
        inside = (rows >= 0) & (rows < count)
        indices = np.where(inside, rows, 0)
        inside &= self.partitions[indices] == partitions
        return column.take(pa.array(indices, mask=~inside))


def ordered(duck: Duck, table: pa.Table, partition_by: Sequence[str], order_by: Sequence[str]) -> OrderedRows:
    """The rows sorted by these partition columns, then by these terms of ORDER BY, then as they came."""
    numbered = table.append_column(_NUMBER, pa.array(np.arange(table.num_rows)))
    columns = [quoted(column) for column in partition_by]
    rank = f"dense_rank() OVER (ORDER BY {', '.join(columns)}) - 1" if columns else "0"
    order = ", ".join(("partition_number", *order_by, quoted(_NUMBER)))
    found = duck.table(
        f"SELECT {quoted(_NUMBER)} AS number, CAST({rank} AS BIGINT) AS partition_number FROM rows_at_hand "
        f"ORDER BY {order}",
        rows_at_hand=numbered,
    )
    partitions = found.column("partition_number").to_numpy().astype(np.int64)
    bounds = np.concatenate(([0], np.flatnonzero(np.diff(partitions)) + 1, [len(partitions)])).astype(np.int64)
    rows = table.take(found.column("number")) if table.num_rows else table
    return OrderedRows(rows, partitions, bounds if table.num_rows else np.zeros(1, dtype=np.int64))
