"""Two motions with a truth from outside: the free swing of a hanging sheet, and the fling of a benchmark with filmed cloths.

The swing has closed forms: Bernoulli's period of a hanging chain, and the decay of its first mode in quadratic air.  The fling is
that of Blanco-Mulero et al. 2024, Benchmarking the sim-to-real gap in cloth manipulation (IEEE RA-L 9(3), arXiv:2310.09543).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import progress
from clothgym.checks import count, finite, not_negative, positive
from clothgym.collisions import Plane
from clothgym.material import Material
from clothgym.mesh import grid
from clothgym.parameters import AIR_DENSITY
from clothgym.simulation import GRAVITY, Simulation

BESSEL_ZERO = 2.404825557695773  # first zero of J_0
FRAME = 1 / 120  # control step of both motions [s]

# cloth and table of the fling [m]
CLOTH, HANDS, HELD_HEIGHT, TABLE = (0.5, 0.7), (0.02, 0.498), 1.0, 0.2
LIFT, GRASP = 0.06, -0.51051  # of the hands over their first height, at the back and the front and at the end [m]
# the hands' pieces: duration [s]; then y and z at the piece's end, each with its speed and acceleration there [m, m/s, m/s^2]
PIECES = (
    (1.1, (-0.25, -0.7, 3.0), (HELD_HEIGHT + LIFT, 0.0, 0.0)),
    (1.5, (0.30, 0.0, -1.0), (HELD_HEIGHT + LIFT, 0.0, 0.0)),
    (1.3, (0.15, -0.3, -0.5), (HELD_HEIGHT + GRASP, 0.0, 0.02)),
    (0.5, (-0.10, 0.0, 0.0), (HELD_HEIGHT + GRASP, 0.0, 0.0)),
)
DURATION = sum(piece[0] for piece in PIECES)  # of the fling [s]
CALM_DRAG, CALM, CLOSING = 5.0, 4.0, 1.0  # before the fling: rate of a linear drag [1/s]; time; share in which the hands close [s]
TOUCH = 2e-3  # height over the table at which cloth counts as touching it [m]


class Swing(NamedTuple):
    """Results of a free swing.

    times: [s], (steps,).  amplitude: of the first mode at the free edge, with its sign [m], (steps,).  period: of each whole swing
    [s], (swings,).  peaks: times and heights of the turning points [s, m], (points, 2).
    """

    times: NDArray[np.float64]
    amplitude: NDArray[np.float64]
    period: NDArray[np.float64]
    peaks: NDArray[np.float64]


class Fling(NamedTuple):
    """Results of a fling.

    contact: when the cloth first touches the table [s]; nan if it does not.  times: [s], (steps,).  lowest: height of the lowest
    particle [m], (steps,).  positions: after each step [m], (steps, particles, 3).
    """

    contact: float
    times: NDArray[np.float64]
    lowest: NDArray[np.float64]
    positions: NDArray


def hanging_period(length: float) -> float:
    """Period of the first mode of an inextensible sheet without rigidity that hangs from its upper edge [s].

    ``4 pi/j sqrt(L/g)``, with j the first zero of J_0 (D. Bernoulli 1738).  length: L [m].
    """
    return float(4 * np.pi / BESSEL_ZERO * np.sqrt(positive("length", length) / GRAVITY))


def hanging_mode(share: ArrayLike) -> NDArray[np.float64]:
    """That mode, ``J_0(j sqrt(s/L))``, 1 at the free edge.  share: ``s/L``, distance from the free edge over the length."""
    from scipy.special import j0  # imported here because it would slow down a warm start

    return np.asarray(j0(BESSEL_ZERO * np.sqrt(np.asarray(share, dtype=np.float64))))


def swing_decay(material: Material, length: float, air_density: float = AIR_DENSITY) -> float:
    """The constant K with which quadratic air damps that mode: ``da/dt = -K a^2``, that is ``1/a = 1/a_0 + K t`` [1/(m s)].

    The loss of energy, averaged over a swing, gives ``K = 4/(3 pi) rho C_D/(2 m) w integral |phi|^3/integral phi^2``, with the
    amplitude a of the free edge, the mass per area m and the angular frequency w.

    Args:
        length: from the held edge to the free one [m].
        air_density: rho [kg/m^3].
    """
    share = (np.arange(2000) + 0.5) / 2000
    mode = np.abs(hanging_mode(share))
    frequency = 2 * np.pi / hanging_period(length)
    drag = not_negative("air_density", air_density) * material.drag_coefficient / (2 * material.density)
    return float(4 / (3 * np.pi) * drag * frequency * np.mean(mode**3) / np.mean(mode**2))


def free_swing(
    material: Material,
    amplitude: float,
    length: float = 0.42,
    width: float = 0.30,
    rows: int = 22,
    seconds: float = 10.0,
    air_density: float = AIR_DENSITY,
    bending: str = "quadratic",
    dtype: str = "float32",
) -> Swing:
    """Hang a sheet from its upper edge, deflect it in its first mode, and let it swing.

    Args:
        amplitude: of the free edge at the start [m]; the closed forms are for a small share of the length.
        length, width: of the sheet [m].
        rows: of particles along the length.

    Raises:
        ValueError: an amplitude of half the length and more, or what ``Simulation`` refuses.
    """
    if positive("amplitude", amplitude) >= positive("length", length) / 2:
        raise ValueError(f"amplitude={amplitude!r}: must be less than half the length, {length / 2:g} m")
    cols = max(2, round(width / length * (count("rows", rows) - 1)) + 1)
    mesh = grid(rows, cols, width, length)
    row = np.arange(mesh.num_particles) // cols
    share = 1 - np.arange(rows) / (rows - 1)
    mode = hanging_mode(share)
    # the sheet is as long as it was: a cell that leans is less high
    out = amplitude * mode
    down = np.concatenate([[0], np.cumsum(np.sqrt((length / (rows - 1)) ** 2 - np.diff(out) ** 2))])
    start = np.stack([mesh.rest_positions[:, 0], out[row], -down[row]], axis=1)
    simulation = Simulation(
        mesh,
        material,
        anchors=np.flatnonzero(row == 0).tolist(),
        time_step=FRAME,
        air_density=air_density,
        bending=bending,
        dtype=dtype,
    )
    simulation.reset(positions=start)
    # amplitude of the mode: the part of the deflection along it, weighed by mass
    weight = mesh.area * mode[row]
    weight /= weight @ mode[row]
    times = FRAME * np.arange(round(positive("seconds", seconds) / FRAME) + 1, dtype=np.float64)
    found = np.empty(len(times))
    for step in range(len(times)):
        if step:
            simulation.step()
        found[step] = weight @ simulation.positions[0, :, 1].astype(np.float64)
    return Swing(times, found, np.diff(_crossings(times, found)[::2]), _turning_points(times, found))


def fling_hands(time: ArrayLike) -> NDArray[np.float64]:
    """Where the fling has its two hands [m], (..., 2, 3); before it begins and after its end they rest.  time: [s], (...)."""
    t = finite("time", time)
    place = np.zeros((*t.shape, 2, 3))
    place[..., :, 0] = HANDS
    place[..., 2] = HELD_HEIGHT
    before, begun = ((0.0, 0.0, 0.0), (HELD_HEIGHT, 0.0, 0.0)), 0.0
    for duration, *after in PIECES:
        within = np.clip(t - begun, 0, duration)
        for axis in (0, 1):
            value = np.polynomial.polynomial.polyval(within, _quintic(duration, before[axis], after[axis]))
            place[..., 1 + axis] = np.where((t >= begun)[..., None], value[..., None], place[..., 1 + axis])
        before, begun = (after[0], after[1]), begun + duration
    return place


def fling(
    material: Material,
    rows: int = 22,
    bending: str = "quadratic",
    friction: float = 0.5,
    air_density: float = AIR_DENSITY,
    gravity: float = GRAVITY,
    seconds: float = DURATION,
) -> Fling:
    """Fling a cloth of 0.5 m x 0.7 m that hangs by two corners onto a table, as the robots of the benchmark did.

    Contact with the table is of the whole sheet, self-collision strict.  The cloth hangs still at first.

    Args:
        rows: of particles along 0.7 m.
        seconds: simulated time from the start of the fling [s].
    """
    width, length = CLOTH
    cols = round((count("rows", rows) - 1) * width / length) + 1
    mesh = grid(rows, cols, width, length)
    x, y, _ = mesh.rest_positions.T
    start = np.stack([x - x.min() + HANDS[0] - (width - np.ptp(HANDS)) / 2, 0 * x, HELD_HEIGHT - (y.max() - y)], axis=1)
    simulation = Simulation(
        mesh,
        material,
        anchors=[int(np.lexsort((x, -y))[0]), int(np.lexsort((-x, -y))[0])],
        time_step=FRAME,
        gravity=(0.0, 0.0, -gravity),
        air_density=air_density,
        colliders=[Plane(point=(0.0, 0.0, TABLE), friction=friction)],
        self_collision={"mode": "strict", "friction": friction},
        bending=bending,
    )
    # slight waves, or the cloth could not leave its plane when the hands close
    start[:, 1] += 1e-3 * np.sin(2 * np.pi * start[:, 0] / width) * (HELD_HEIGHT - start[:, 2])
    simulation.reset(positions=start)
    first, last = start[simulation.anchors], fling_hands(0.0)
    simulation.set_parameters(air_drag=CALM_DRAG * material.density)
    for step in range(1, round(CALM / FRAME) + 1):
        share = min(1.0, step * FRAME / CLOSING)
        simulation.move_anchors(first + share * (last - first))
        simulation.step()
    simulation.set_parameters(air_drag=material.air_drag)
    times = FRAME * np.arange(1, round(positive("seconds", seconds) / FRAME) + 1, dtype=np.float64)
    frames = np.empty((len(times), mesh.num_particles, 3), dtype=np.float32)
    for step, time in enumerate(times):
        progress.show("fling", step, len(times))
        simulation.move_anchors(fling_hands(time))
        simulation.step()
        frames[step] = simulation.positions[0]
    progress.clear()
    lowest = frames[:, :, 2].min(axis=1).astype(np.float64)
    low = np.flatnonzero(lowest <= TABLE + TOUCH)
    return Fling(float(times[low[0]]) if len(low) else float("nan"), times, lowest, frames)


def _quintic(duration: float, before: ArrayLike, after: ArrayLike) -> NDArray[np.float64]:
    """Coefficients of the polynomial with place, speed and acceleration given at 0 and at ``duration``, lowest first, (6,)."""
    power = np.arange(6)
    rows = []
    for t in (0.0, duration):
        for order in range(3):
            factor = np.prod([power - k for k in range(order)], axis=0) if order else np.ones(6)
            rows.append(factor * t ** np.maximum(power - order, 0))
    return np.linalg.solve(np.array(rows, dtype=np.float64), np.concatenate([before, after]))


def _crossings(times: NDArray, values: NDArray) -> NDArray[np.float64]:
    """When the values pass through zero, between their times [s]."""
    at = np.flatnonzero(values[:-1] * values[1:] < 0)
    return times[at] + values[at] / (values[at] - values[at + 1]) * (times[at + 1] - times[at])


def _turning_points(times: NDArray, values: NDArray) -> NDArray[np.float64]:
    """Times and heights of the extrema on either side of zero, each the vertex of a parabola through three values, (points, 2)."""
    size = np.abs(values)
    at = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])) + 1
    left, mid, right = size[at - 1], size[at], size[at + 1]
    shift = (left - right) / (2 * (left - 2 * mid + right))
    return np.stack([times[at] + shift * (times[1] - times[0]), mid - (left - right) * shift / 4], axis=1)
