"""Two standard tests of textile laboratories: Cusick's drape test and the cantilever.

Both run until the sheet is at rest.  Linear drag damps the motion (``SETTLING_DRAG``); the shape at rest does not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.checks import count, finite, positive, shown
from clothgym.integrators import Integrator
from clothgym.material import Material
from clothgym.mesh import ClothMesh, grid
from clothgym.simulation import GRAVITY, Simulation
from clothgym.triangles import disc, triples

SPECIMEN_RADIUS, SUPPORT_RADIUS = 0.15, 0.09  # specimen and support of the drape test [m], BS 5058 and ISO 9073-9
SETTLING_DRAG = 20.0  # rate of the linear drag [1/s]: about critical for a skirt or a strip of a few centimeters
REST_SPEED = 1e-3  # a sheet is at rest when no particle is faster [m/s]
LOADING = 1.0  # time in which gravity grows from zero, as the specimen is lowered onto the instrument's disc [s]
ASYMMETRY, MOST_WAVES = 1e-4, 12  # initial waves, without which a specimen would not fold: height [m], largest number around it
MOST_RINGS = 100  # the support's edge is on one of so many rings, or next to it
LINES = 4000  # scan lines across a shadow
FOLD_DEPTH = 0.05  # height of a fold of the skirt above both adjacent valleys, as a share of the overhang
COLUMNS, ROWS = 20, 3  # free particles along a strip, and particles across it

Option = str | Mapping[str, Any] | Integrator


class Drape(NamedTuple):
    """Results of a drape test, one for each environment.

    coefficient: drape coefficient, from 0 (limp) to 1 (flat), (num_envs,).  folds: their number, see ``fold_count``, (num_envs,).
    speed: of the fastest particle at the end [m/s], (num_envs,).  seconds: simulated time [s].  positions: [m], (num_envs,
    particles, 3).  mesh: the specimen.
    """

    coefficient: NDArray[np.float64]
    folds: NDArray[np.int64]
    speed: NDArray[np.float64]
    seconds: float
    positions: NDArray
    mesh: ClothMesh


class Cantilever(NamedTuple):
    """Results of a cantilever test.

    droop: angle of the chord from clamp to tip below the horizontal [deg].  elastica: the same for the heavy elastica [deg].
    weight: of the strip relative to its rigidity, ``G = rho g L^3/B``.  speed: of the fastest particle at the end [m/s].
    positions: [m], (particles, 3).
    """

    droop: float
    elastica: float
    weight: float
    speed: float
    positions: NDArray


def bending_length(material: Material) -> float:
    """Peirce's ``c = (B/(rho g))^(1/3)`` [m]: a strip twice as long droops by 41.5 degrees."""
    return float((_checked(material).bend_rigidity / (material.density * GRAVITY)) ** (1 / 3))


def cusick_drape(
    material: Material,
    rings: int = 15,
    num_envs: int = 1,
    seed: int = 0,
    bending: str = "hinge",
    integrator: Option = "semi_implicit_euler",
    dtype: str = "float32",
    seconds: float = 6.0,
    specimen: float = SPECIMEN_RADIUS,
    support: float = SUPPORT_RADIUS,
) -> Drape:
    """Hang a round specimen over a disc, of 15 cm and 9 cm radius unless others are given, and measure its shadow.

    The instrument clamps the specimen between two discs; here the particles above the disc are anchored.  Each environment
    starts from its own heights, drawn with ``seed``, ``seed + 1``, ..., and may settle into different folds.

    Args:
        material: the fabric; its own ``air_drag`` is replaced.
        rings: of the specimen's mesh, so many that a ring lies on the edge of the support: a multiple of 5 for the usual radii.
        seconds: longest simulated time [s]; ``Drape.speed`` shows whether the sheet was at rest.
        specimen, support: their radii [m].

    Raises:
        ValueError: no ring on the edge of the support, a support as large as the specimen, or what ``Simulation`` refuses.
    """
    if positive("support", support) >= positive("specimen", specimen):
        raise ValueError(f"support={support!r}: must be smaller than the specimen's radius, {specimen!r} m")
    share = Fraction(support / specimen).limit_denominator(MOST_RINGS)
    if count("rings", rings) % share.denominator:
        raise ValueError(f"rings={rings!r}: must be a multiple of {share.denominator}, so that a ring lies on the support's edge")
    mesh = disc(specimen, rings)
    edge = rings * share.numerator // share.denominator
    held = 1 + 3 * edge * (edge + 1)  # particles of the rings up to the edge come first
    simulation = Simulation(
        mesh,
        _with_drag(material),
        num_envs,
        integrator,
        air_density=0.0,
        anchors=[range(held)],
        bending=bending,
        dtype=dtype,
    )
    simulation.reset(positions=np.stack([_uneven(mesh.rest_positions, seed + env, specimen, support) for env in range(num_envs)]))
    loading = round(LOADING / simulation.time_step)
    for step in range(loading):
        simulation.set_parameters(gravity=(0.0, 0.0, -GRAVITY * (step + 1) / loading))
        simulation.step()
    passed = LOADING + _settle(simulation, seconds)
    # all areas are those of the mesh, whose rings are polygons, so a flat sheet has exactly 1
    inside = np.all(mesh.triangles < held, axis=1)
    supported = projected_area(mesh.rest_positions, mesh.triangles[inside])
    shadows = np.array([projected_area(one, mesh.triangles) for one in simulation.positions])
    coefficient = (shadows - supported) / (float(mesh.area.sum()) - supported)
    rim = simulation.positions[:, -6 * rings :].astype(np.float64)  # particles of the last ring come last, in their order
    folds = np.array([fold_count(one, FOLD_DEPTH * (specimen - support)) for one in rim])
    return Drape(coefficient, folds, _fastest(simulation), passed, simulation.positions, mesh)


def fold_count(rim: ArrayLike, depth: float) -> int:
    """Number of folds, or nodes, of a skirt around the z axis: places of its rim that are farther from the axis than the valleys.

    Args:
        rim: points along the closed rim, in order [m], (points, 3).
        depth: a fold is at least so much farther from the axis than the deeper valleys on either side [m].

    Raises:
        ValueError: fewer than three points, or values that are not finite.
    """
    from scipy.signal import find_peaks  # imported here because it would slow down a warm start

    x = finite("rim", rim)
    if x.ndim != 2 or x.shape[1] != 3 or len(x) < 3:
        raise ValueError(f"rim has shape {x.shape}: must be (points, 3), of three points or more")
    # once around, from the deepest valley back to it
    radius = np.hypot(x[:, 0], x[:, 1])
    around = np.roll(radius, -int(np.argmin(radius)))
    return len(find_peaks(np.append(around, around[0]), prominence=positive("depth", depth))[0])


def projected_area(positions: ArrayLike, triangles: ArrayLike) -> float:
    """Area of the triangles' shadow on the ground [m^2], with overlaps counted once.

    On each of ``LINES`` lines the length of the shadow is exactly that of the union of intervals.  The midpoint rule sums the
    lengths.  positions: [m], (particles, 3).
    """
    x = finite("positions", positions)
    if x.ndim != 2 or x.shape[1] != 3:
        raise ValueError(f"positions have shape {x.shape}: must be (particles, 3)")
    corners = x[triples(x, triangles)][:, :, :2]
    low, high = corners[:, :, 1].min(), corners[:, :, 1].max()
    spacing = (high - low) / LINES
    if spacing == 0:
        return 0.0
    heights = (corners[:, :, 1] - low) / spacing - 0.5  # line k is at height k
    first, last = np.ceil(heights.min(axis=1)).astype(int), np.floor(heights.max(axis=1)).astype(int)
    crossed = np.maximum(last - first + 1, 0)
    triangle = np.repeat(np.arange(len(corners)), crossed)
    line = np.arange(len(triangle)) - np.repeat(np.cumsum(crossed) - crossed, crossed) + first[triangle]
    left, right = np.full(len(triangle), np.inf), np.full(len(triangle), -np.inf)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        from_line, rise = line - heights[triangle, a], heights[triangle, b] - heights[triangle, a]
        meets = (from_line * (line - heights[triangle, b]) <= 0) & (rise != 0)
        share = np.divide(from_line, rise, out=np.zeros_like(rise), where=meets)
        x = corners[triangle, a, 0] + share * (corners[triangle, b, 0] - corners[triangle, a, 0])
        left, right = np.where(meets, np.minimum(left, x), left), np.where(meets, np.maximum(right, x), right)
    # lines are laid end to end, so that one running maximum covers them all
    width = np.ptp(corners[:, :, 0]) + 1.0
    left, right = left + line * width, right + line * width
    order = np.argsort(left)
    left, right = left[order], right[order]
    covered = np.concatenate([[-np.inf], np.maximum.accumulate(right)[:-1]])
    return float(np.sum(np.maximum(right - np.maximum(left, covered), 0)) * spacing)


def cantilever(
    material: Material,
    overhang: float = 0.04,
    columns: int = COLUMNS,
    bending: str = "hinge",
    integrator: Option = "semi_implicit_euler",
    dtype: str = "float32",
    seconds: float = 6.0,
) -> Cantilever:
    """Clamp a strip at one end, and measure how far the other end droops (Peirce 1930, ASTM D1388).

    The last two columns of held particles are the clamp.  Its hinges bend over half a cell on either side.  The clamp's edge is
    therefore half a cell behind the last held column.

    Args:
        material: the fabric; its own ``air_drag`` is replaced.
        overhang: length L of the strip beyond the clamp [m].
        columns: of free particles.

    Raises:
        ValueError: a length that is not positive, or what ``Simulation`` refuses.
    """
    cell = positive("overhang", overhang) / (count("columns", columns) + 0.5)
    mesh = grid(ROWS, columns + 2, (columns + 1) * cell, (ROWS - 1) * cell)
    column = np.arange(mesh.num_particles) % (columns + 2)
    simulation = Simulation(
        mesh,
        _with_drag(material),
        integrator=integrator,
        air_density=0.0,
        anchors=[np.flatnonzero(column < 2).tolist()],
        bending=bending,
        dtype=dtype,
    )
    _settle(simulation, seconds)
    x = simulation.positions[0].astype(np.float64)
    tip = x[column == columns + 1].mean(axis=0) - x[column == 1].mean(axis=0)
    droop = np.degrees(np.arctan2(-tip[2], tip[0] + cell / 2))
    weight = (overhang / bending_length(material)) ** 3
    return Cantilever(float(droop), elastica_droop(weight), weight, float(_fastest(simulation)[0]), simulation.positions[0])


def elastica_droop(weight: float) -> float:
    """Chord angle of a heavy inextensible strip, clamped level [deg].

    It solves ``theta'' = -G (1 - s) cos(theta)`` on 0 <= s <= 1, with theta = 0 at the clamp and theta' = 0 at the tip.
    weight: ``G = rho g L^3/B``.
    """
    from scipy.integrate import solve_bvp  # imported here because it would double the time of a warm start

    s = np.linspace(0, 1, 200) ** 2  # a heavy strip bends near the clamp
    bent = np.pi / 2 * (1 - np.exp(-s * positive("weight", weight) ** (1 / 3) / 2))
    solution = solve_bvp(
        lambda s, y: np.stack([y[1], -weight * (1 - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])]),
        lambda clamp, tip: np.array([clamp[0], tip[1], clamp[2], clamp[3]]),
        s,
        np.stack([bent, np.gradient(bent, s), s, s]),
        tol=1e-8,
        max_nodes=100_000,
    )
    return float(np.degrees(np.arctan2(solution.y[3, -1], solution.y[2, -1])))


def _uneven(x: NDArray, seed: int, specimen: float, support: float) -> NDArray[np.float64]:
    """A flat specimen with slight waves in its overhanging rim [m], (particles, 3).  The waves do not depend on the mesh."""
    random = np.random.default_rng(seed)
    waves = np.arange(2, MOST_WAVES + 1)
    height, phase = random.normal(scale=ASYMMETRY, size=len(waves)), random.uniform(0, 2 * np.pi, len(waves))
    radius, angle = np.hypot(x[:, 0], x[:, 1]), np.arctan2(x[:, 1], x[:, 0])
    out = np.maximum(radius - support, 0) / (specimen - support)
    raised = x.copy()
    raised[:, 2] += out * (height * np.cos(waves * angle[:, None] + phase)).sum(axis=1)
    return raised


def _checked(material: Any) -> Material:
    if not isinstance(material, Material):
        raise ValueError(f"material={shown(material)}: must be a Material, for instance Material.preset('cotton')")
    return material


def _with_drag(material: Material) -> Material:
    """The material with the drag under which sheets settle."""
    return replace(_checked(material), air_drag=SETTLING_DRAG * material.density)


def _fastest(simulation: Simulation) -> NDArray[np.float64]:
    """Speed of the fastest particle [m/s], (num_envs,)."""
    return np.linalg.norm(simulation.velocities.astype(np.float64), axis=2).max(axis=1)


def _settle(simulation: Simulation, seconds: float) -> float:
    """Step until all sheets are at rest, for ``seconds`` at most.  Returns the simulated time [s]."""
    tenth = max(1, round(0.1 / simulation.time_step))
    # at least half a second, because a sheet that starts flat is slow at first, too
    passed = 0.0
    while passed < positive("seconds", seconds) and (passed < 0.5 or _fastest(simulation).max() > REST_SPEED):
        simulation.step(tenth)
        passed += tenth * simulation.time_step
    return passed
