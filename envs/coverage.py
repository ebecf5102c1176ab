"""How much of the floor a sheet covers, seen from above: by triangles on a grid of the world, and by particles as SoftGym does.

The grid's cells lie where they lie, whatever the sheet does.  A cell is covered if its center is in the projection of a triangle,
so that the same surface covers the same cells, however many triangles it is made of.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import apart, inlined

CELL, FINE_CELL = 0.01, 0.0025  # of the grid after each step, and at an episode's start and end [m]
MOST_CELLS = 2000  # along a side of the measured area, from the sheet's lowest x and y
BITS, ALL = 64, np.uint64(2**64 - 1)  # of a word of cells
PAIRS, NIBBLES, BYTES, ONES = (np.uint64(byte * (2**64 // 255)) for byte in (0x55, 0x33, 0x0F, 0x01))  # in each byte
SOFTGYM_CELLS = 100  # along a side of the particles' bounding box


@apart
def window(x, cell, first, count):
    """The cells that a sheet may cover: first cell and number of cells along x and y, (2,) each, out.

    x: [m], (3, particles), finite.  A ``count`` above zero is extended.
    """
    for c in range(2):
        least, most = np.float64(x[c, 0]), np.float64(x[c, 0])
        for p in range(1, x.shape[1]):
            least, most = min(least, np.float64(x[c, p])), max(most, np.float64(x[c, p]))
        low, high = int(np.floor(least / cell)), int(np.floor(most / cell))
        if count[c] > 0:
            low, high = min(low, first[c]), max(high, first[c] + count[c] - 1)
        first[c], count[c] = low, min(high - low + 1, MOST_CELLS)


@inlined
def _slope(u, v, low, high):
    """How far an edge goes along u while it goes 1 along v; the same for both triangles at it."""
    return (u[high] - u[low]) / (v[high] - v[low]) if v[high] > v[low] else 0.0


@apart
def cover(x, triangles, cell, first, covered):
    """Mark the cells whose centers are in the projection of a triangle, in ``covered``, (rows, words): a bit for each column.

    x: [m], (3, particles), finite.  cell: side of the grid's cells [m]; centers at (i + 1/2) cell.  first: cell of the first bit.
    """
    columns = BITS * covered.shape[1]
    # corners in cells, from the center of the first
    u, v = np.empty(x.shape[1]), np.empty(x.shape[1])
    for p in range(x.shape[1]):
        u[p] = x[0, p] / cell - (first[0] + 0.5)
        v[p] = x[1, p] / cell - (first[1] + 0.5)
    for t in range(triangles.shape[0]):
        # corners from low to high: neighbors go along an edge they share in the same direction, and round alike
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if v[b] < v[a] or (v[b] == v[a] and b < a):
            a, b = b, a
        if v[c] < v[b] or (v[c] == v[b] and c < b):
            b, c = c, b
            if v[b] < v[a] or (v[b] == v[a] and b < a):
                a, b = b, a
        # the rows of centers between them, and how far each edge goes along u in a row
        bottom, top = max(int(np.ceil(v[a])), 0), min(int(np.ceil(v[c])), covered.shape[0])
        if bottom >= top:
            continue
        lower, upper, whole = _slope(u, v, a, b), _slope(u, v, b, c), _slope(u, v, a, c)
        # each from one edge to the other: the lower end belongs to the triangle, the upper does not
        for row in range(bottom, top):
            one = u[a] + lower * (row - v[a]) if row < v[b] else u[b] + upper * (row - v[b])
            other = u[a] + whole * (row - v[a])
            start, end = max(int(np.ceil(min(one, other))), 0), min(int(np.ceil(max(one, other))), columns)
            if start < end:
                # the bits from there on, and those before that, of the words between
                for word in range(start // BITS, (end - 1) // BITS + 1):
                    head, tail = max(start - BITS * word, 0), max(BITS * (word + 1) - end, 0)
                    covered[row, word] |= (ALL << np.uint64(head)) & (ALL >> np.uint64(tail))


@inlined
def room_for_cells(count):
    """Cells of which none is covered, (rows, words)."""
    return np.zeros((count[1], (count[0] + BITS - 1) // BITS), np.uint64)


@inlined
def bits_of(word):
    """How many bits of a word are set: sums of 2, 4 and 8 bits, and of its bytes by a product (Warren, Hacker's Delight, 5-1)."""
    word = word - ((word >> np.uint64(1)) & PAIRS)
    word = (word & NIBBLES) + ((word >> np.uint64(2)) & NIBBLES)
    word = (word + (word >> np.uint64(4))) & BYTES
    return np.int64((word * ONES) >> np.uint64(56))


@apart
def covered_area(x, triangles, cell):
    """Area of the union of a sheet's triangles, seen from above [m^2].

    x: [m], (3, particles), finite.  triangles: (triangles, 3).  cell: side of the grid's cells [m].
    """
    first, count = np.zeros(2, np.int64), np.zeros(2, np.int64)
    window(x, cell, first, count)
    covered = room_for_cells(count)
    cover(x, triangles, cell, first, covered)
    total = 0
    for row in range(covered.shape[0]):
        for word in range(covered.shape[1]):
            total += bits_of(covered[row, word])
    return total * cell * cell


@apart
def shared_area(x, other, triangles, cell):
    """Area of the floor below two sheets of one mesh, seen from above [m^2]: below both, and below either."""
    first, count = np.zeros(2, np.int64), np.zeros(2, np.int64)
    window(x, cell, first, count)
    window(other, cell, first, count)
    one, two = room_for_cells(count), room_for_cells(count)
    cover(x, triangles, cell, first, one)
    cover(other, triangles, cell, first, two)
    both, either = 0, 0
    for row in range(one.shape[0]):
        for word in range(one.shape[1]):
            both += bits_of(one[row, word] & two[row, word])
            either += bits_of(one[row, word] | two[row, word])
    return both * cell * cell, either * cell * cell


@apart
def softgym_area(x, radius):
    """Covered area as SoftGym's cloth tasks measure it [m^2]: of cells within ``radius`` of a particle along both axes.

    The cells are 100 x 100 in the bounding box of the particles, so that they change with the pose.
    """
    low, span = np.empty(2), np.empty(2)
    for c in range(2):
        low[c] = x[c].min()
        span[c] = max((x[c].max() - low[c]) / SOFTGYM_CELLS, 1e-9)
    covered = np.zeros((SOFTGYM_CELLS, SOFTGYM_CELLS), np.uint8)
    for p in range(x.shape[1]):
        # from the nearest cell border below the particle to that above it
        u, v = x[0, p] - low[0], x[1, p] - low[1]
        for i in range(max(round((u - radius) / span[0]), 0), min(round((u + radius) / span[0]), SOFTGYM_CELLS)):
            for j in range(max(round((v - radius) / span[1]), 0), min(round((v + radius) / span[1]), SOFTGYM_CELLS)):
                covered[i, j] = 1
    return covered.sum() * span[0] * span[1]
