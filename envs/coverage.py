"""How much of the floor a sheet covers, seen from above, as a kernel.

The floor has one grid of square cells, the same for every sheet wherever it lies.  A cell is covered if its middle lies below a
triangle, so no particle and no resolution of the sheet enters: peers count cells around particles, in a grid over their bounding
box, whose cells change with the pose.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined

CELLS = 64  # cells along a side of the sheet
FINE_CELLS = 256  # the same at the evaluation
MARGIN = 1e-9  # in cells: an edge that two triangles share leaves no gap between them


@inlined
def _row_of(value, cell):
    """The first row of cells whose middle lies at or beyond a coordinate [m]."""
    return int(np.ceil(value / cell - 0.5 - MARGIN))


@inlined
def _extend(y, ax, ay, bx, by, ends):
    """Extend the ends of a row's span, at height y, to where an edge from a to b crosses it."""
    if min(ay, by) <= y <= max(ay, by):
        x = ax if ay == by else ax + (bx - ax) * ((y - ay) / (by - ay))
        ends[0], ends[1] = min(ends[0], x), max(ends[1], x)
        if ay == by:
            ends[0], ends[1] = min(ends[0], bx), max(ends[1], bx)


@apart
def window_of(x, cell, window):
    """The cells that sheets may cover: first column and row, and the number of both; x: [m], (3, particles).

    window: (4,), int64, extended if it is not empty (its numbers of columns and rows are positive).
    """
    for c in range(2):
        low, high = np.inf, -np.inf
        for p in range(x.shape[1]):
            low, high = min(low, np.float64(x[c, p])), max(high, np.float64(x[c, p]))
        first, last = _row_of(low, cell), _row_of(high, cell)
        if window[2 + c] > 0:
            first, last = min(first, window[c]), max(last, window[c] + window[2 + c] - 1)
        window[c], window[2 + c] = first, last - first + 1


@apart
def cover(x, triangles, cell, window, covered):
    """Mark the cells of a window whose middles lie below a sheet, in ``covered``, (rows, columns), uint8.

    x: [m], (3, particles).  Each row of cells that a triangle crosses is covered between where its edges cross the row's middle.
    """
    ends = np.empty(2)
    for t in range(triangles.shape[0]):
        i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        ax, ay, bx, by, cx, cy = (
            np.float64(x[0, i]), np.float64(x[1, i]), np.float64(x[0, j]), np.float64(x[1, j]), np.float64(x[0, k]),
            np.float64(x[1, k]),
        )  # fmt: skip
        low, high = min(ay, min(by, cy)), max(ay, max(by, cy))
        for row in range(max(_row_of(low, cell), window[1]), min(_row_of(high, cell), window[1] + window[3] - 1) + 1):
            # the part of this row's middle line that lies in the triangle
            y = (row + 0.5) * cell
            ends[0], ends[1] = np.inf, -np.inf
            _extend(y, ax, ay, bx, by, ends)
            _extend(y, bx, by, cx, cy, ends)
            _extend(y, cx, cy, ax, ay, ends)
            if ends[0] > ends[1]:
                continue
            first, last = _row_of(ends[0], cell), int(np.floor(ends[1] / cell - 0.5 + MARGIN))
            for column in range(max(first, window[0]), min(last, window[0] + window[2] - 1) + 1):
                covered[row - window[1], column - window[0]] = 1


@apart
def covered_area(x, triangles, cell):
    """Area of the floor below a sheet [m^2]; x: [m], (3, particles), finite; cell: of the grid [m]."""
    window = np.zeros(4, np.int64)
    window_of(x, cell, window)
    covered = np.zeros((window[3], window[2]), np.uint8)
    cover(x, triangles, cell, window, covered)
    count = 0
    for row in range(covered.shape[0]):
        for column in range(covered.shape[1]):
            count += covered[row, column]
    return count * cell * cell


@apart
def shared_area(x, other, triangles, cell):
    """Area of the floor below two sheets of one mesh [m^2]: of both, and of either."""
    window = np.zeros(4, np.int64)
    window_of(x, cell, window)
    window_of(other, cell, window)
    first, second = np.zeros((2, window[3], window[2]), np.uint8)
    cover(x, triangles, cell, window, first)
    cover(other, triangles, cell, window, second)
    both, either = 0, 0
    for row in range(window[3]):
        for column in range(window[2]):
            both += first[row, column] & second[row, column]
            either += first[row, column] | second[row, column]
    return both * cell * cell, either * cell * cell
