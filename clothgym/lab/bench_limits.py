"""References for the table's rows: a plain step of one sheet, and the limits of the machine.

The plain step vectorizes over the particles of one grid.  A spring of one kind joins each particle to the one at a constant offset
in memory.  So each kind is one loop, and the force on a particle is one sum over the kinds.  The plain step has no contact, no
attachments and no options.

The limits are a roofline (Williams, Waterman and Patterson 2009).  The operations, roots and bytes of a pass are counted for each
spring.  A machine does a given number of each per second, and the slowest of the three bounds the speed.

Kernels here call nothing from other files, so their cache depends on this file alone.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from clothgym._jit import apart, inlined

# --- a plain step -------------------------------------------------------------------------------------------------------------

KINDS = ((0, 1), (1, 0), (1, 1), (1, -1), (0, 2), (2, 0))  # rows and columns from one end of a spring to the other
TINY = 1e-30  # for springs that wrap around the end of a row: they have no stiffness, and their ends may coincide [m^2]


@inlined
def _pull(x0, x1, x2, y0, y1, y2, v0, v1, v2, w0, w1, w2, stiffness, rest, tau, f0, f1, f2, count):
    """Forces of one kind of springs on their first ends [N].  First ends are at ``x``, ``v``; second ends at ``y``, ``w``."""
    one, tiny = rest.dtype.type(1), rest.dtype.type(TINY)
    r, t = rest[0], tau[0]
    for p in range(count):
        dx, dy, dz = y0[p] - x0[p], y1[p] - x1[p], y2[p] - x2[p]
        ux, uy, uz = w0[p] - v0[p], w1[p] - v1[p], w2[p] - v2[p]
        q = one / np.sqrt(dx * dx + dy * dy + dz * dz + tiny)
        g = stiffness[p] * ((one - r * q) + t * (ux * dx + uy * dy + uz * dz) * q * q)
        f0[p], f1[p], f2[p] = g * dx, g * dy, g * dz


@apart
def plain_steps(x, v, f, push, w, places, stiffness, rest, tau, parts, gravity, h, keep, steps):
    """``steps`` semi-implicit steps of ``h`` [s].

    x [m], v [m/s], f, push [N]: (3, particles); push: external forces.  w [1/kg]: (particles,).  places: offset from one end of
    a spring to the other, by kind, (kinds,).  stiffness [N/m]: of the spring that starts at a particle, (kinds, particles).  rest
    [m]: (kinds,).  tau: damping time [s], (1,).  parts: scratch, (3, kinds, margin + particles), zero in the margin.  The margin is
    at least the largest of places.
    """
    n = x.shape[1]
    margin = parts.shape[2] - n
    zero = x.dtype.type(0)
    for _ in range(steps):
        # forces of all springs, by kind
        f[:] = push
        for k in range(6):
            o = places[k]
            _pull(
                x[0], x[1], x[2], x[0, o:], x[1, o:], x[2, o:], v[0], v[1], v[2], v[0, o:], v[1, o:], v[2, o:],
                stiffness[k], rest[k : k + 1], tau, parts[0, k, margin:], parts[1, k, margin:], parts[2, k, margin:], n - o,
            )  # fmt: skip
        for c in range(3):
            g, fc, xc, vc, fall = parts[c], f[c], x[c], v[c], gravity[c]
            a0, a1, a2, a3, a4, a5 = g[0, margin:], g[1, margin:], g[2, margin:], g[3, margin:], g[4, margin:], g[5, margin:]
            b0, b1, b2 = g[0, margin - places[0] :], g[1, margin - places[1] :], g[2, margin - places[2] :]
            b3, b4, b5 = g[3, margin - places[3] :], g[4, margin - places[4] :], g[5, margin - places[5] :]
            # the force on a particle: for each kind, the spring that ends there, then the one that starts there
            for p in range(n):
                ends = fc[p] - b0[p] + a0[p] - b1[p] + a1[p] - b2[p] + a2[p]
                fc[p] = ends - b3[p] + a3[p] - b4[p] + a4[p] - b5[p] + a5[p]
            for p in range(n):
                free = (vc[p] + h * (fc[p] * w[p] + fall)) * keep
                vc[p] = free if w[p] > zero else vc[p]
            for p in range(n):
                xc[p] += h * vc[p]


class PlainSheet:
    """A 1 m sheet of 150 g that hangs by two corners, with plain steps of 10 microseconds.

    Attributes:
        springs: number of springs, without those that wrap around.
        bytes: size of all its arrays.
    """

    def __init__(self, side: int) -> None:
        n, spacing, f4 = side * side, 1 / (side - 1), np.float32
        self.places = np.array([rows * side + columns for rows, columns in KINDS])
        self.rest = np.array([spacing * np.hypot(*kind) for kind in KINDS], f4)
        stiffness = np.zeros((len(KINDS), side, side), f4)
        for k, (rows, columns) in enumerate(KINDS):
            constant = (200, 200, 100, 100, 1, 1)[k]
            stiffness[k, : side - rows, max(0, -columns) : side - max(0, columns)] = constant
        self.springs = int(np.count_nonzero(stiffness))
        self.stiffness = stiffness.reshape(len(KINDS), n)
        row, column = np.divmod(np.arange(n), side)
        flat = np.stack([column * spacing, np.zeros(n), row * spacing])
        self.x = (flat + np.random.default_rng(0).normal(scale=1e-3 * spacing, size=(3, n))).astype(f4)
        self.v, self.f, self.push = (np.zeros((3, n), f4) for _ in range(3))
        self.w = np.full(n, n / 0.15, f4)
        self.w[[n - side, n - 1]] = 0
        self.parts = np.zeros((3, len(KINDS), n + 2 * side + 8), f4)
        self.tau, self.gravity = np.full(1, 1e-4, f4), np.array([0, 0, -9.81], f4)
        arrays = (self.x, self.v, self.f, self.push, self.w, self.stiffness, self.parts)
        self.bytes = sum(array.nbytes for array in arrays)

    def step(self, steps: int) -> None:
        """Advance by ``steps`` plain steps."""
        f4 = np.float32
        plain_steps(
            self.x, self.v, self.f, self.push, self.w, self.places, self.stiffness, self.rest, self.tau, self.parts, self.gravity,
            f4(1e-5), f4(0.99999), steps,
        )  # fmt: skip


# --- what the machine can do --------------------------------------------------------------------------------------------------

LINKS = 3  # multiply-adds of an element between its load and its store; few, so that many chains run at once
LEVELS = ("L1", "L2", "L3", "memory")
SIZES = {"L1": 32 << 10, "L2": 512 << 10, "L3": 16 << 20}  # where the system does not report them [bytes]


@apart
def multiply_and_add(a, factor, term, rounds):
    """``LINKS`` multiply-adds of each element in registers, ``rounds`` times; each element is one chain."""
    for _ in range(rounds):
        for i in range(a.shape[0]):
            t = a[i]
            for _ in range(LINKS):
                t = t * factor + term
            a[i] = t


@apart
def divide_by_roots(a, rounds):
    """A square root and a division of each element, ``rounds`` times."""
    one = a.dtype.type(1)
    for _ in range(rounds):
        for i in range(a.shape[0]):
            a[i] = one / np.sqrt(a[i])


@apart
def stream(a, b, c, factor, rounds):
    """``a = b + factor c``: two loads and a store of each element, ``rounds`` times."""
    for _ in range(rounds):
        for i in range(a.shape[0]):
            a[i] = b[i] + factor * c[i]


def seconds(call: Callable[[], object], repeats: int = 5) -> float:
    """Shortest processor time of several calls in this thread, after one warm-up call [s]."""
    call()
    times = []
    for _ in range(repeats):
        begun = time.thread_time()
        call()
        times.append(time.thread_time() - begun)
    return min(times)


def cache_sizes() -> dict[str, int]:
    """Sizes of a core's data caches [bytes]."""
    sizes = dict(SIZES)
    for folder in sorted(Path("/sys/devices/system/cpu/cpu0/cache").glob("index*")):
        kind, level, size = ((folder / name).read_text().strip() for name in ("type", "level", "size"))
        if kind != "Instruction" and f"L{level}" in sizes:
            sizes[f"L{level}"] = int(size.removesuffix("K")) << 10
    return sizes


def measure_limits() -> dict[str, Any]:
    """Rates of one core in float32 [1/s]: operations, inverse roots (a root and a division), and bytes from each memory level.

    Three arrays are streamed.  Together they fill half a cache, or in memory six times the size of the last cache.
    """
    f4 = np.float32
    a = np.full(1024, 0.5, f4)
    arithmetic = 2 * LINKS * a.size * 2000 / seconds(lambda: multiply_and_add(a, f4(0.5), f4(0.25), 2000))
    b = np.full(1024, 0.5, f4)
    roots = b.size * 2000 / seconds(lambda: divide_by_roots(b, 2000))
    sizes, bandwidth = cache_sizes(), {}
    for level in LEVELS:
        whole = sizes[level] // 2 if level in sizes else min(6 * sizes["L3"], 256 << 20)
        length = whole // (3 * 4)
        arrays = [np.zeros(length + 16 * k, f4)[16 * k :] for k in range(3)]  # at different offsets within a page
        rounds = max(1, (64 << 20) // whole)
        bandwidth[level] = 12 * length * rounds / seconds(lambda: stream(*arrays, f4(0.5), rounds))  # noqa: B023
    return {"operations/s": arithmetic, "inverse roots/s": roots, "bytes/s": bandwidth, "cache bytes": sizes}


# --- what a pass must do ------------------------------------------------------------------------------------------------------


class Work(NamedTuple):
    """Work for each element (a spring, a hinge, a particle or a triangle), in float32.

    operations: additions and multiplications.  roots: inverse roots, and other divisions.  numbers: all loads and stores.
    streamed: those of data that no loop has just touched; they come from the cache level that holds the whole sheet.  formula: the
    counts in words.
    """

    operations: float
    roots: float
    numbers: float
    streamed: float
    formula: str

    def times(self, count: float) -> Work:
        """The work of ``count`` elements."""
        counts = (self.operations * count, self.roots * count, self.numbers * count, self.streamed * count)
        return Work(*counts, f"{count:g} x ({self.formula})")

    def plus(self, other: Work) -> Work:
        """The sum of both works."""
        operations, roots = self.operations + other.operations, self.roots + other.roots
        numbers, streamed = self.numbers + other.numbers, self.streamed + other.streamed
        return Work(operations, roots, numbers, streamed, f"{self.formula} + {other.formula}")


# x and v of both ends, stiffness, and a force stored and loaded twice
SPRING = Work(33, 1, 22, 13, "spring: 6 d and u, 6 |d|^2, 5 u.d, 7 factor, 3 force, 6 sums; a root over which is divided")
# of a component: force set, summed, velocity from v, f and w, position from x and v
PARTICLE = Work(21, 0, 33, 33, "particle: 15 velocity, 6 position")
# 13 places of x and v; f loaded and stored
STENCIL = Work(81, 0, 84, 12, "particle: 6 x + tau v, 39 products, 36 sums")
# x and v of four particles, f loaded and stored
HINGE = Work(
    172, 7, 48, 30, "hinge: 65 edges, normals and feet, 37 angle, 34 slopes, 24 rate and moment, 12 sums; 7 roots and quotients"
)
# x and v of three particles, f loaded and stored
TRIANGLE = Work(
    85, 2, 39, 24, "triangle: 6 edges, 9 normal, 18 wind, 16 products, 9 factors, 9 force, 18 shares; 2 roots, of one the inverse"
)
# x, w and v of both ends, places and constants, x stored
PROJECTION = Work(36, 2, 18, 18, "spring: 3 d, 6 |d|^2, 6 factors, 3 force, 18 moves; a root and a quotient")
DAMPED_PROJECTION = Work(52, 2, 24, 24, "spring: 9 d and u, 6 |d|^2, 5 u.d, 11 factors, 3 force, 18 moves; a root and a quotient")


def level_of(size: float, sizes: dict[str, int]) -> str:
    """The first memory level that holds ``size`` bytes."""
    return next((level for level in LEVELS[:-1] if size <= sizes[level]), "memory")


def stand(ns: float, work: Work, springs: int, size: float, limits: dict[str, Any]) -> dict[str, Any]:
    """How close a substep is to the limits: its share of each, and the largest share.

    ns: time per spring.  work: of the whole substep.  springs: number of springs.  size: working set [bytes].
    """
    level = level_of(size, limits["cache bytes"])
    numbers = work.numbers if level == "L1" else work.streamed
    per_second = 1e9 / (ns * springs)
    shares = {
        "arithmetic": work.operations * per_second / limits["operations/s"],
        "inverse roots": work.roots * per_second / limits["inverse roots/s"],
        f"bandwidth of {level}": 4 * numbers * per_second / limits["bytes/s"][level],
    }
    limit = max(shares, key=lambda name: shares[name])
    return {
        "operations a spring": work.operations / springs,
        "inverse roots a spring": work.roots / springs,
        "bytes a spring": 4 * numbers / springs,
        "formula": work.formula,
        "working set": int(size),
        "shares": shares,
        "nearest": limit,
    }
