"""The sheet that is spread out: its certificate against closed forms, and against the distances of sampled points."""

import numpy as np
import pytest

from clothgym import Simulation, disc, grid
from clothgym.collisions.self.spread import least_stretch, to_rest
from clothgym.triangles import triangle_mesh


def certificate(mesh, p):
    inverses = to_rest(mesh)
    room = np.empty((6, len(mesh.triangles))), np.empty(len(mesh.triangles))
    return least_stretch(np.ascontiguousarray(p, np.float64), mesh.triangles, inverses, *room)


def turned(p, rng):
    """Positions after a random rotation."""
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return p @ (q * np.sign(np.linalg.det(q)))


def on_a_cylinder(mesh, angle):
    """A sheet whose columns lie on a circular arc of this angle, at equal chords."""
    rest = mesh.rest_positions.astype(float)
    (_, columns), width = mesh.grid_shape, mesh.spacing[0]
    turn = angle * (np.arange(columns - 1) / (columns - 2) - 0.5)  # directions of the chords
    x, z = (np.concatenate([[0.0], np.cumsum(width * f(turn))]) for f in (np.cos, np.sin))
    column = np.arange(len(rest)) % columns
    return np.stack([x[column], rest[:, 1], z[column]], axis=1)


@pytest.mark.parametrize("mesh", [grid(5, 9, 0.4, 0.3), disc(0.2, 4)])
def test_of_a_sheet_that_is_moved_and_stretched_it_is_the_least_stretch(mesh):
    rng = np.random.default_rng(0)
    for stretch in ((1.0, 1.0), (1.2, 0.7)):
        p = turned(mesh.rest_positions * (*stretch, 1.0), rng) + rng.normal(size=3)
        assert certificate(mesh, p) == pytest.approx(min(stretch), abs=1e-9)


@pytest.mark.parametrize("angle", [0.3, 1.5, 3.0, 3.3])
def test_on_a_cylinder_it_is_the_cosine_of_half_the_angle(angle):
    mesh = grid(6, 21, 0.5, 0.6)
    p = turned(on_a_cylinder(mesh, angle), np.random.default_rng(1))
    assert certificate(mesh, p) == pytest.approx(max(np.cos(angle / 2), 0), abs=1e-9)


def test_the_bound_holds_for_points_of_all_triangles():
    mesh, rng = grid(9, 9, 0.5, 0.5), np.random.default_rng(2)
    rest, seen = mesh.rest_positions.astype(float), []
    weights = rng.dirichlet([1, 1, 1], size=(20, len(mesh.triangles)))
    for size in np.linspace(0, 0.05, 60):
        # a wave and noise
        p = rest + size * np.sin(rest[:, :1] * rng.normal(0, 20, 3)) + rng.normal(0, 0.2 * size, rest.shape)
        bound = certificate(mesh, p)
        seen.append(bound)
        for each in weights:
            at_rest, now = (np.einsum("tc,tcx->tx", each, q[mesh.triangles]) for q in (rest, p))
            i, j = rng.integers(len(each), size=(2, 4000))
            apart, before = (np.linalg.norm(q[i] - q[j], axis=1) for q in (now, at_rest))
            assert np.all(apart >= bound * before - 1e-12)
    # the promise was not empty, and not made of everything
    assert seen[0] == pytest.approx(1) and 0.3 < np.median(seen) < 0.95 and min(seen) == 0


def test_of_a_folded_a_mirrored_and_a_diverged_sheet_nothing_is_promised():
    mesh = grid(9, 9, 0.5, 0.5)
    folded = mesh.rest_positions.astype(float)
    folded[:, 2] = np.where(folded[:, 0] > 0, 0.01, 0)
    folded[:, 0] = -abs(folded[:, 0])
    lost = mesh.rest_positions.astype(float)
    lost[40, 1] = np.nan
    one_flipped = mesh.rest_positions.astype(float)
    one_flipped[40] = one_flipped[42]
    for p in (folded, lost, one_flipped, np.full((81, 3), np.inf), np.zeros((81, 3))):
        assert certificate(mesh, p) == 0


def test_only_flat_and_convex_sheets_have_one():
    mesh = grid(5, 5, 0.4, 0.4)
    centers = mesh.rest_positions[mesh.triangles].mean(axis=1)
    used, triangles = np.unique(mesh.triangles[(centers[:, 0] < 0) | (centers[:, 1] < 0)], return_inverse=True)
    cut = triangle_mesh(mesh.rest_positions[used], triangles.reshape(-1, 3))
    bent = mesh.rest_positions + (0, 0, 1) * mesh.rest_positions[:, :1] ** 2
    curved = triangle_mesh(bent, mesh.triangles)
    assert len(to_rest(mesh)) == len(mesh.triangles) and len(to_rest(cut)) == len(to_rest(curved)) == 0
    assert certificate(cut, cut.rest_positions) == 0


def test_a_spread_sheet_is_left_alone_and_a_folded_one_is_not():
    simulation = Simulation(grid(17, 17, 0.6, 0.6), self_collision="strict")
    simulation.step()
    assert simulation.self_contacts.rows[0] == 0 and simulation.self_contacts.gap[0] == np.inf
    # the same sheet, rolled to a pipe that is almost closed
    rolled = on_a_cylinder(simulation.mesh, 2 * np.pi * 0.99 * 15 / 16)
    assert 0.004 < np.linalg.norm(rolled[16] - rolled[0]) < 0.008
    simulation.reset(positions=rolled)
    simulation.step()
    assert simulation.self_contacts.rows[0] > 0
