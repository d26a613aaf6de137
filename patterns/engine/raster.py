"""Zones as a raster: which of many polygons a point lies in, exactly, at the price of one look-up.

A picture's zones are drawn once into a grid of cells. A cell that no border touches lies wholly in a
zone or wholly out of it; only points in cells that a border touches are put to the polygon itself.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from patterns.engine.jit import compiled_with_memory
from patterns.engine.kernel import Integers
from patterns.scene.geometry import in_polygon

CELLS = 128
"""cells a side"""
_MARGIN = 1e-6
"""how near to a border, in cells, counts as touched: far above the rounding of doubles"""

Floats = NDArray[np.float64]


class Grid(NamedTuple):
    """Where the cells lie, and for each the words of its bits, a zone a bit."""

    left: float
    top: float
    columns_a_pixel: float
    rows_a_pixel: float
    inside: Integers
    """(cells, words): zones that the whole cell lies in"""
    border: Integers
    """(cells, words): zones whose border touches the cell"""


class Raster:
    """The zones of one picture, as polygons in pixels, at most 64 a word."""

    def __init__(self, polygons: Sequence[Any]) -> None:
        self.polygons = polygons
        self.words = -(-len(polygons) // 64)
        self.grid = _drawn(polygons, self.words)

    def mark(self, x: Floats, y: Floats, is_here: NDArray[np.bool_], rows: Integers, inside: int, outside: int) -> None:
        """Writes which zones the points lie in.

        Args:
            x: In pixels; not finite where unknown.
            y: In pixels.
            is_here: Which points are of this picture; others lie in none of its zones.
            rows: Records of rows; changed.
            inside: The column of the first word that says which zones a point lies in.
            outside: The column of the first word that says which it lies out of; an unknown point is in neither.
        """
        unsure = np.empty(len(x), dtype=np.int64)
        unsure = unsure[: _mark(x, y, is_here, self.grid, rows, inside, outside, unsure)]
        if not len(unsure):
            return
        borders = self.grid.border[_cells(x[unsure], y[unsure], self.grid)]
        for number, polygon in enumerate(self.polygons):
            word, bit = divmod(number, 64)
            asked = unsure[(borders[:, word] >> bit) & 1 != 0]
            if len(asked):
                is_in = in_polygon(polygon, x[asked], y[asked])
                rows[asked, inside + word] |= is_in.astype(np.int64) << bit
                rows[asked, outside + word] |= (~is_in).astype(np.int64) << bit


def _drawn(polygons: Sequence[Any], words: int) -> Grid:
    left, top, right, bottom = shapely.total_bounds(np.array(polygons, dtype=object))
    margin = 1e-3 * max(right - left, bottom - top)
    left, top, right, bottom = left - margin, top - margin, right + margin, bottom + margin
    inside, border = (np.zeros((CELLS * CELLS, words), dtype=np.int64) for _ in range(2))
    columns, rows = CELLS / (right - left), CELLS / (bottom - top)
    for number, polygon in enumerate(polygons):
        corners = (shapely.get_coordinates(polygon) - (left, top)) * (columns, rows)
        word, bit = divmod(number, 64)
        _draw(corners, inside[:, word], border[:, word], np.int64(1 << bit if bit < 63 else -(1 << 63)))
    return Grid(left, top, columns, rows, inside, border)


def _cells(x: Floats, y: Floats, grid: Grid) -> Integers:
    columns = ((x - grid.left) * grid.columns_a_pixel).astype(np.int64)
    rows = ((y - grid.top) * grid.rows_a_pixel).astype(np.int64)
    cells: Integers = rows * CELLS + columns
    return cells


@compiled_with_memory
def _draw(corners, inside, border, bit):
    """Draws one closed polygon, in units of cells."""
    for at in range(len(corners) - 1):
        _touch(corners[at], corners[at + 1], border, bit)
    for cell in range(CELLS * CELLS):
        if border[cell] & bit == 0 and _is_inside(corners, cell % CELLS + 0.5, cell // CELLS + 0.5):
            inside[cell] |= bit


@compiled_with_memory
def _touch(one, other, border, bit):
    """Marks the cells that the edge touches."""
    low, high = min(one[1], other[1]), max(one[1], other[1])
    for row in range(max(int(low - _MARGIN), 0), min(int(high + _MARGIN), CELLS - 1) + 1):
        begin, end = 0.0, 1.0
        if high - low > _MARGIN:
            first = (row - _MARGIN - one[1]) / (other[1] - one[1])
            second = (row + 1 + _MARGIN - one[1]) / (other[1] - one[1])
            begin, end = max(min(first, second), 0.0), min(max(first, second), 1.0)
        left = one[0] + begin * (other[0] - one[0])
        right = one[0] + end * (other[0] - one[0])
        if left > right:
            left, right = right, left
        for column in range(max(int(left - _MARGIN), 0), min(int(right + _MARGIN), CELLS - 1) + 1):
            border[row * CELLS + column] |= bit


@compiled_with_memory
def _is_inside(corners, x, y):
    """Whether a point that is not near the border lies inside: it sees an odd number of edges to its right."""
    is_inside = False
    for at in range(len(corners) - 1):
        x0, y0, x1, y1 = corners[at, 0], corners[at, 1], corners[at + 1, 0], corners[at + 1, 1]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            is_inside = not is_inside
    return is_inside


@compiled_with_memory
def _mark(x, y, is_here, grid, rows, inside, outside, unsure):
    count, words = 0, grid.inside.shape[1]
    for row in range(len(x)):
        for word in range(words):
            rows[row, inside + word] = 0
            rows[row, outside + word] = -1
        if not is_here[row]:
            continue
        if not (np.isfinite(x[row]) and np.isfinite(y[row])):
            for word in range(words):
                rows[row, outside + word] = 0
            continue
        across, down = (x[row] - grid.left) * grid.columns_a_pixel, (y[row] - grid.top) * grid.rows_a_pixel
        if not (0.0 <= across < CELLS and 0.0 <= down < CELLS):
            continue
        cell = int(down) * CELLS + int(across)
        is_unsure = False
        for word in range(words):
            rows[row, inside + word] = grid.inside[cell, word]
            rows[row, outside + word] = ~(grid.inside[cell, word] | grid.border[cell, word])
            is_unsure |= grid.border[cell, word] != 0
        if is_unsure:
            unsure[count] = row
            count += 1
    return count
