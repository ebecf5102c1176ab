"""Floor 4: guards: bounds on the substep, properties that an integrator cannot have, and the detection of divergence."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import apart, kernel, merged
from clothgym.bending import BENDING, Bending, model_of
from clothgym.checks import known, warn
from clothgym.elements import BendArrays, Elements, SpringArrays
from clothgym.forces import Oscillators, energy_rows
from clothgym.integrators import Integrator
from clothgym.mesh import SHEAR, ClothMesh
from clothgym.parameters import PROPERTIES
from clothgym.state import Fabric
from clothgym.warning import warn_caller

BURST = 10.0  # strain above which a sheet has blown up, even if it is not flagged as diverged
MOST_SUBSTEPS = 100_000  # of a control step
ODD = 10.0  # times the substeps of the rest of the sheet: a part that needs more is named
FAR, COARSE = 100.0, 5e-4  # from here on positions are looked at [m]; rounding beyond this share of an edge is told
FASTEST = 1e4  # [m/s]: a corner torn away by meters in one step can whip beyond 1 km/s, and comes back


@apart
def mark_diverged(x, v, diverged):
    """Set the flags, (lanes,), of lanes with a position that is not finite or a speed component above ``FASTEST``.

    x [m], v [m/s]: (3, particles, lanes).
    """
    # one sheet: its arrays are flat
    limit = x.dtype.type(FASTEST)
    if diverged.shape[0] == 1:
        diverged[0] |= not (_all_within(merged(merged(v)), limit) and _all_within(merged(merged(x)), x.dtype.type(np.inf)))
        return
    # lane by lane
    for c in range(3):
        for p in range(x.shape[1]):
            for l in range(x.shape[2]):
                fine = abs(v[c, p, l]) < limit and abs(x[c, p, l]) < np.inf
                diverged[l] |= not fine


@kernel
def _all_within(values, limit):
    """Whether ``|value| < limit`` for all values, which is false for NaN."""
    beyond = 0
    for e in range(values.shape[0]):
        beyond |= not abs(values[e]) < limit
    return beyond == 0


def bending_of(name: str, mesh: ClothMesh) -> Bending:
    """The bending model of that name; "auto": springs for a sheet that is flat at rest, and hinges for others, with a warning.

    Raises:
        ValueError: no such name, or a model that does not fit this mesh.
    """
    known("bending model", name, ("auto", *BENDING))
    if name != "auto" or mesh.flat:
        return model_of("springs" if name == "auto" else name, mesh)
    warn(f"{not_flat(mesh)}: bending='hinge' is chosen; name a model to choose another")
    return BENDING["hinge"]


def not_flat(mesh: ClothMesh) -> str:
    """That a sheet is not flat at rest, as a clause of a sentence."""
    return f"this sheet is not flat at rest (angles up to {np.abs(mesh.hinges.rest_angle).max():.3g} rad)"


def warn_if_far(x: NDArray, mesh: ClothMesh, dtype: np.dtype) -> None:
    """Warn of positions [m], (..., 3), that are so far from the origin that rounding them stretches the sheet."""
    farthest = float(np.abs(x).max(initial=0))
    if farthest < FAR:
        return
    rounding, edge = float(np.spacing(dtype.type(farthest))), float(np.median(mesh.springs.rest_length))
    if rounding > COARSE * edge:
        warn(
            f"positions: {farthest:.4g} m from the origin {dtype.name} rounds them to {rounding:.2g} m, {rounding / edge:.2g} of "
            "an edge: start nearer to the origin, or take dtype='float64'"
        )


def odd_part(integrator: Integrator, o: Oscillators, time_step: float) -> tuple[int, str] | None:
    """The substeps that would do without the part of the sheet that needs the smallest ones, and a clause that names this part.

    None if no part needs more than ``ODD`` times the substeps of the rest.
    """
    # the square of each particle's frequency were all others held: an entry of the diagonal of M^-1 K
    local = np.zeros(len(o.positions))
    for particles, vectors in energy_rows(o):
        np.add.at(local, particles, np.sum(vectors**2, axis=2))
    local *= o.inverse_mass
    odd = local > ODD**2 * np.median(local)
    if not odd.any():
        return None
    # the rest
    springs = SpringArrays(*(array[~odd[o.elements.springs.particles].any(axis=1)] for array in o.elements.springs))
    bends = BendArrays(*(array[~odd[o.elements.bends.particles].any(axis=1)] for array in o.elements.bends))
    largest, _ = integrator.largest_substep(o._replace(elements=Elements(springs, bends)))
    if largest <= 0 or not len(springs.weight):
        return None
    # the shortest edge of the oddest particle
    worst, own = int(np.argmax(local)), o.elements.springs
    edges = np.flatnonzero(own.kind <= SHEAR)
    there = edges[(own.particles[edges] == worst).any(axis=1)]
    shortest, median = there[np.argmin(own.rest_length[there])], float(np.median(own.rest_length[edges]))
    (a, b), length = own.particles[shortest].tolist(), float(own.rest_length[shortest])
    place = ", ".join(f"{c:.4g}" for c in o.positions[worst])
    what = f"edge {a}-{b} of the mesh, {length:.3g} m long (the median is {median:.3g} m)"
    if length > median / ODD**0.5:
        what = f"the thin triangles at particle {worst}"
    return integrator.automatic_substeps(
        time_step, largest
    ), f"{what}, near ({place}): join its ends (merge_tolerance= of load_mesh), or mesh the sheet anew"


def oscillators(
    mesh: ClothMesh, elements: Elements, bending: Bending, fabric: Fabric, free_w: NDArray, block: int, lane: int
) -> Oscillators:
    """The properties that determine the substep of the environment in that block and lane.

    elements: in float64.  free_w: inverse masses without attachments [1/kg], (blocks, particles, lanes).

    Raises:
        ValueError: masses that are too large or too small for the type of these numbers.
    """
    size = float(fabric.size[block, lane])
    wrong = ~((free_w[block, :, lane] > 0) & (free_w[block, :, lane] < np.inf))
    if wrong.any():
        worst = int(np.argmax(wrong))
        raise ValueError(
            f"particle {worst} stands for {size**2 * mesh.area[worst]:.3g} m^2: its mass, or one over it, is beyond "
            f"{free_w.dtype.name}: change the size of the sheet, or its density"
        )
    return Oscillators(
        positions=size * mesh.rest_positions,
        elements=elements,
        stiffness=fabric.stiffness[block, :, lane].astype(np.float64),
        rigidity=float(fabric.rigidity[block, lane]) / (1 if bending.isotropic else size * size),
        isotropic=bending.isotropic,
        damping_time=float(fabric.damping_time[block, lane]),
        inverse_mass=free_w[block, :, lane].astype(np.float64),
    )


def automatic_substeps(integrator: Integrator, oscillators: Oscillators, time_step: float) -> int:
    """Number of substeps in a control step [s], from the integrator's bound.

    Raises:
        ValueError: there is no bound: no substep is small enough; or it takes more than MOST_SUBSTEPS.
    """
    largest, why = integrator.largest_substep(oscillators)
    if largest <= 0:
        raise ValueError(
            f"substeps='auto': {integrator.name} has no bound here, {why}; give a number of substeps, a fabric with damping_time, "
            "or another integrator, semi_implicit_euler for instance"
        )
    substeps = integrator.automatic_substeps(time_step, largest)
    odd = odd_part(integrator, oscillators, time_step) if substeps > ODD else None
    if odd is not None and substeps > ODD * odd[0]:
        needs = f"substeps='auto': {integrator.name} needs {substeps} substeps in a control step"
        asked = f"{needs}, where {odd[0]} would do without {odd[1]}"
        if substeps > MOST_SUBSTEPS:
            raise ValueError(f"{asked}; the most are {MOST_SUBSTEPS}")
        warn(asked)
    if substeps > MOST_SUBSTEPS:
        raise ValueError(
            f"substeps='auto': {integrator.name} needs {substeps:.3g} substeps in a control step, {why}; the most are "
            f"{MOST_SUBSTEPS}: use a shorter time_step, a softer or heavier fabric, a coarser mesh, or another integrator"
        )
    return substeps


def warn_if_beyond(integrator: Integrator, each: Iterable[Oscillators], time_step: float, substeps: int) -> None:
    """Warn of the first environment for which the substeps are too few, with the number that is enough."""
    h = time_step / substeps
    for one in each:
        # the sharp bound needs an eigenvalue: compute it only where the quick bound is exceeded
        if h <= integrator.surely_allowed(one):
            continue
        largest, why = integrator.largest_substep(one)
        if h > largest:
            remedy = "Use another integrator, or a fabric with damping_time."
            if largest > 0:
                remedy = f"Use substeps={integrator.automatic_substeps(time_step, largest)} or substeps='auto'."
            warn_caller(
                f"{substeps} substeps of {h:.3g} s are too few for {integrator.name}: its bound here is {largest:.3g} s, {why}. "
                f"{remedy}",
            )
            return


def refuse_properties(integrator: Integrator, mesh: ClothMesh, before: NDArray, after: NDArray) -> None:
    """Refuse material properties that an integrator or a mesh cannot have; before, after: (num_envs, properties).

    Raises:
        ValueError: a property that they do not use has changed, or one that enters a shared matrix differs between environments.
    """
    # a triangle mesh has no shear stiffness of its own
    shear = PROPERTIES.index("shear_stiffness")
    if mesh.shape is None and not np.array_equal(after[:, shear], before[:, shear]):
        raise ValueError(
            "shear_stiffness has no effect on a triangle mesh: its edges have one stiffness, and its shear modulus follows from "
            "stretch_stiffness and Poisson's ratio 1/3; change stretch_stiffness, or use a grid"
        )
    # properties that the integrator ignores or shares
    for column, name in enumerate(PROPERTIES):
        if name in integrator.ignored and not np.array_equal(after[:, column], before[:, column]):
            raise ValueError(refusal(integrator, name))
        if name in integrator.shared and np.ptp(after[:, column]) > 0:
            raise ValueError(refusal(integrator, name))


def refuse_sizes(integrator: Integrator, size: NDArray) -> None:
    """Refuse sizes that a matrix which all environments share cannot have, (num_envs,), with a ValueError."""
    if integrator.prepare is not None and np.any(size != 1):
        raise ValueError(
            f"{integrator.name} factorizes one matrix, of the mesh as it is, and takes no size but 1: make a mesh of that size"
        )


def refusal(integrator: Integrator, name: str) -> str:
    """The sentence with which an integrator refuses a material property."""
    if name in integrator.ignored:
        return f"{integrator.name} does not use {name}: its options ({', '.join(integrator.options)}) set its stiffness"
    return (
        f"{integrator.name} factorizes one matrix for all environments: {name} cannot differ between them; set it for all, or use "
        "another integrator"
    )


def report_divergence(new: NDArray, steps: NDArray, integrator: Integrator, substeps: int, stop: bool) -> None:
    """Warn of environments that have just diverged.

    new: mask, (num_envs,).  steps: control steps since each environment's reset, (num_envs,).

    Raises:
        FloatingPointError: if ``stop``, instead of the warning.
    """
    envs = np.flatnonzero(new)
    if not len(envs):
        return
    which = f"environment {envs[0]}" if len(envs) == 1 else f"environments {', '.join(map(str, envs[:8]))}"
    more = f" and {len(envs) - 8} more" if len(envs) > 8 else ""
    message = (
        f"{which}{more} diverged in control step {steps[envs[0]]}: {integrator.name} with {substeps} substeps left a position that "
        f"is not finite or a speed above {FASTEST:g} m/s. Use more substeps ('auto' follows the bound), slower attachments or "
        "a softer fabric; reset() restarts them. The other environments are not affected."
    )
    if stop:
        raise FloatingPointError(message)
    warn_caller(message, RuntimeWarning)
