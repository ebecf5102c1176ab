"""Forces on a grid whose particles lie side by side, against plain loops over springs, and against the kernels of lanes."""

from dataclasses import replace

import numpy as np
import pytest

from clothgym import Material, Simulation, disc, grid
from clothgym.bending import BENDING, add_hinge_forces, add_hinge_products, add_quadratic_forces, add_quadratic_products
from clothgym.elements import (
    KINDS,
    Elastic,
    element_arrays,
    grid_of,
    grid_surface_of,
    is_regular,
    scratch_for_forces,
    surface_arrays,
)
from clothgym.forces import TINY, add_lane_air_forces, add_lane_forces, add_lane_products, set_lane_forces
from clothgym.grid_forces import (
    add_grid_air_forces,
    add_grid_forces,
    add_grid_hinge_forces,
    add_grid_hinge_products,
    add_grid_products,
    set_grid_forces,
)
from clothgym.integrators.base import Work, advance_velocities, kick_and_drift, scratch_for_work

SHAPES = [(2, 2), (2, 3), (5, 2), (4, 7), (9, 9)]
STIFFNESS = np.array([210, 190, 0, 90, 3, 2, 0.0])
SIZE = 1.1


def thrown(mesh, dtype, seed=0):
    """Positions and velocities far from rest, (3, particles, 1), and nothing to add forces to."""
    rng = np.random.default_rng(seed)
    x = mesh.rest_positions + rng.normal(scale=0.3 * min(mesh.spacing), size=mesh.rest_positions.shape)
    v = rng.normal(size=x.shape)
    return (*(np.ascontiguousarray(a.T[..., None].astype(dtype)) for a in (x, v)), np.zeros((3, mesh.num_particles, 1), dtype))


def properties(dtype, rigidity=1e-3):
    return Elastic(STIFFNESS.astype(dtype)[:, None], np.full(1, rigidity, dtype), np.full(1, 2e-3, dtype), np.full(1, SIZE, dtype))


@pytest.mark.parametrize("shape", SHAPES)
def test_a_particle_gets_the_bits_of_a_plain_loop_over_the_springs(shape):
    """By kind, then by particle; compared as integers, since -0.0 equals 0.0."""
    mesh, real = grid(*shape, 0.3, 0.5), np.float32
    x, v, f = thrown(mesh, real)
    elements = grid_of(mesh, np.dtype(real), "springs")
    add_grid_forces(x, v, f, elements, properties(real), scratch_for_forces(x, elements.offset))
    expected = np.zeros((3, mesh.num_particles), real)
    tau, one, columns = real(2e-3), real(1), shape[1]
    weights = dict(zip(map(tuple, np.sort(mesh.springs.particles, axis=1).tolist()), mesh.springs.weight))
    lengths = dict(zip(map(tuple, np.sort(mesh.springs.particles, axis=1).tolist()), mesh.springs.rest_length))
    for kind, down, right in KINDS:
        ends = [(i, i + down * columns + right) for i in range(mesh.num_particles)]
        ends = [pair for pair in ends if pair in weights and pair[1] % columns - pair[0] % columns == right]
        length = real(lengths[ends[-1]]) if ends else one
        for i, j in ends:
            d, u = x[:, j, 0] - x[:, i, 0], v[:, j, 0] - v[:, i, 0]
            q = one / np.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2] + real(TINY))
            g = (one - length * real(SIZE) * q) + tau * (u[0] * d[0] + u[1] * d[1] + u[2] * d[2]) * q * q
            force = real(weights[i, j]) * real(STIFFNESS[kind]) * g * d
            expected[:, i] += force
            expected[:, j] -= force
    assert np.array_equal((f[:, :, 0] + real(0)).view(np.uint32), (expected + real(0)).view(np.uint32))


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("bending", ["springs", "quadratic", "hinge"])
def test_forces_and_products_are_those_of_lanes(shape, bending):
    mesh, real = grid(*shape, 0.3, 0.5), np.float64
    x, v, f = thrown(mesh, real)
    elastic, bend = properties(real), np.full(1, 1e-3)
    along, across = elastic.stiffness * 2, elastic.stiffness
    elements = grid_of(mesh, np.dtype(real), bending)
    scratch = scratch_for_forces(x, elements.offset)
    y = np.zeros_like(f)
    add_grid_forces(x, v, f, elements, elastic, scratch)
    add_grid_products(x, v, y, elements, elastic.size, along, across, bend, scratch)
    if bending == "hinge":
        add_grid_hinge_forces(x, v, f, elements, elastic, scratch)
        add_grid_hinge_products(x, v, y, elements, bend, scratch)
    single = element_arrays(mesh, np.dtype(real), bending != "springs", any_order=True)
    row, f2, y2 = scratch_for_forces(x, np.zeros(0, np.int64)), np.zeros_like(f), np.zeros_like(f)
    add_lane_forces(x, v, f2, single, elastic, row)
    add_lane_products(x, v, y2, single, elastic.size, along, across, bend, row)
    if bending == "hinge":
        add_hinge_forces(x, v, f2, single, elastic, row)
        add_hinge_products(x, v, y2, single, bend, row)
    elif bending == "quadratic":
        add_quadratic_forces(x, v, f2, single, elastic, row)
        add_quadratic_products(x, v, y2, single, bend, row)
    assert np.abs(f2).max() > 1 and np.allclose(f, f2, rtol=0, atol=1e-9 * np.abs(f2).max())
    assert np.abs(y2).max() > 1 and np.allclose(y, y2, rtol=0, atol=1e-9 * np.abs(y2).max())


@pytest.mark.parametrize("shape", SHAPES)
def test_the_air_presses_as_it_does_on_lanes(shape):
    mesh, real = grid(*shape, 0.3, 0.5), np.float64
    x, v, f = thrown(mesh, real)
    resistance, wind = np.array([[0.7], [0.05], [0.2]]), np.array([[1.0], [-2.0], [0.5]])
    offset, f2 = grid_of(mesh, np.dtype(real), "springs").offset, np.zeros_like(f)
    add_grid_air_forces(x, v, f, grid_surface_of(mesh, np.dtype(real)), resistance, wind, 0.0, scratch_for_forces(x, offset))
    add_lane_air_forces(x, v, f2, surface_arrays(mesh, np.dtype(real)), resistance, wind, 0.0, scratch_for_forces(x, offset[:0]))
    assert np.abs(f2).max() > 1e-3 and np.allclose(f, f2, rtol=0, atol=1e-12)


def test_forces_leave_no_trace_in_their_scratch():
    """What stands before a kind's first spring and after its last must stay zero: the sum reads it."""
    mesh = grid(4, 5, 0.3, 0.3)
    x, v, f = thrown(mesh, np.float32)
    elements = grid_of(mesh, np.dtype(np.float32), "springs")
    scratch = scratch_for_forces(x, elements.offset)
    add_grid_forces(x, v, f, elements, properties(np.float32), scratch)
    again = np.zeros_like(f)
    add_grid_forces(x, v, again, elements, properties(np.float32), scratch)
    before = scratch.kinds.shape[2] - mesh.num_particles
    assert not scratch.kinds[:, :, :before].any()
    assert all(not scratch.kinds[:, a, before + mesh.num_particles - o :].any() for a, o in enumerate(elements.offset))
    assert np.array_equal(f.view(np.uint32), again.view(np.uint32))


def test_springs_of_no_length_leave_their_neighbors_alone():
    """Row ends that coincide are joined by springs without weight: no NaN may come of them."""
    mesh = grid(3, 4, 0.3, 0.3)
    x, v, f = thrown(mesh, np.float32)
    x[:, 4], x[:, 8] = x[:, 3], x[:, 7]
    elements = grid_of(mesh, np.dtype(np.float32), "springs")
    add_grid_forces(x, v, f, elements, properties(np.float32), scratch_for_forces(x, elements.offset))
    assert np.isfinite(f).all()


@pytest.mark.parametrize("lanes", [1, 3])
def test_held_particles_keep_their_velocity(lanes):
    v, w = np.ones((3, 5, lanes), np.float32), np.repeat(np.array([1, 0, 1, 0, 1], np.float32)[:, None], lanes, 1)
    f, gravity = np.full((3, 5, lanes), 2, np.float32), np.full((3, lanes), 4, np.float32)
    work = Work(*scratch_for_work(v, np.zeros(0, np.int64), (1, 0, 0)), np.zeros((2, 3, 5, lanes), np.float32))
    x, also = np.zeros_like(v), v.copy()
    advance_velocities(v, w, f, gravity, np.full(lanes, 1, np.float32), np.float32(0.5), work)
    assert np.allclose(v[:, [0, 2, 4]], (1 + 0.5 * (2 + 4)) / 1.5) and np.array_equal(v[:, [1, 3]], np.ones((3, 2, lanes)))
    work.remainders[:] = 0
    kick_and_drift(x, also, w, f, gravity, np.full(lanes, 1, np.float32), np.float32(0.5), work, np.float32(1), np.float32(2))
    assert np.array_equal(also, v) and np.array_equal(x, 2 * v)


@pytest.mark.parametrize("bending", ["springs", "quadratic"])
def test_forces_start_from_given_values(bending):
    """The bits of adding to it: on a grid by kinds, and on one lane and several, spring by spring."""
    mesh = grid(5, 6, 0.3, 0.4)
    x, v, _ = thrown(mesh, np.float32)
    start = np.random.default_rng(1).normal(size=x.shape).astype(np.float32)
    elements = grid_of(mesh, np.dtype(np.float32), bending)
    added, set_to = start.copy(), np.full_like(start, np.nan)
    add_grid_forces(x, v, added, elements, properties(np.float32), scratch_for_forces(x, elements.offset))
    set_grid_forces(x, v, start, set_to, elements, properties(np.float32), scratch_for_forces(x, elements.offset))
    assert np.array_equal(added.view(np.uint32), set_to.view(np.uint32))
    single = element_arrays(mesh, np.dtype(np.float32), False, True)
    for lanes in (1, 4):
        elastic = Elastic(*(np.repeat(part, lanes, -1) for part in properties(np.float32)))
        x_l, v_l, start_l = (np.repeat(a, lanes, 2) for a in (x, v, start))
        added, set_to = start_l.copy(), np.full_like(start_l, np.nan)
        add_lane_forces(x_l, v_l, added, single, elastic, scratch_for_forces(x_l, np.zeros(0, np.int64)))
        set_lane_forces(x_l, v_l, start_l, set_to, single, elastic, scratch_for_forces(x_l, np.zeros(0, np.int64)))
        assert np.array_equal(added, set_to)


def test_only_regular_grids_go_by_kinds():
    mesh = grid(5, 5, 0.4, 0.4)
    longer = mesh.springs._replace(rest_length=mesh.springs.rest_length * np.where(np.arange(len(mesh.springs.kind)) == 3, 1.1, 1))
    assert is_regular(mesh) and not is_regular(disc(0.2, 3)) and not is_regular(replace(mesh, springs=longer))
    meshes = mesh, replace(mesh, springs=longer)
    assert [Simulation(m).layout.kind for m in meshes] == ["grid", "sheet"]


@pytest.mark.parametrize("bending", BENDING)
def test_forces_by_kind_match_forces_by_spring(bending):
    """A spring that is 1e-5 longer than the others of its kind makes a grid irregular, and changes next to nothing."""
    mesh, found = grid(6, 7, 0.3, 0.3), []
    lengths = mesh.springs.rest_length * np.where(np.arange(len(mesh.springs.kind)) == 3, 1 + 1e-5, 1)
    for sheet in (mesh, replace(mesh, springs=mesh.springs._replace(rest_length=lengths))):
        cloth = Simulation(
            sheet,
            Material.preset("penava_cotton"),
            anchors=mesh.corners[:2],
            wind=(1, 2, 0),
            bending=bending,
            dtype="float64",
            threads=1,
        )
        cloth.step(20)
        found.append(cloth.positions[0])
    assert np.ptp(found[0][:, 2]) > 1e-3 and np.abs(found[0] - found[1]).max() < 1e-4
