"""Maneuvers that crumple sheets, and starts made by them."""

import numpy as np
import pytest
from exact_intersections import intersecting_pairs

from clothgym import disc, grid, starts
from clothgym.geometry.intersections import count_intersections
from clothgym.starts import MANEUVERS, STARTS

GRID, DISC = grid(13, 13, 0.8, 0.8), disc(0.4, 6)


def run(maneuver, seconds=np.inf):
    """Step until then; the counts of each frame, (frames, num_envs)."""
    counts = []
    while not maneuver.over and maneuver.time < seconds:
        maneuver.step()
        counts.append(count_intersections(maneuver.mesh.triangles, maneuver.simulation.positions))
    return np.array(counts)


@pytest.mark.parametrize("mesh", [GRID, grid(25, 25, 1, 1), DISC], ids=["coarse", "fine", "disc"])
@pytest.mark.parametrize("name", [*MANEUVERS, "rumpled"])
def test_a_maneuver_starts_without_intersections_above_the_floor(name, mesh):
    maneuver = (MANEUVERS | STARTS)[name](mesh, seeds=range(3))
    assert count_intersections(mesh.triangles, maneuver.start).tolist() == [0, 0, 0]
    assert maneuver.start[:, :, 2].min() > 0
    # a start may shorten threads, where a disc's are creased, but not stretch them
    assert maneuver.simulation.strain().max() < 0.01
    assert len({sheet.tobytes() for sheet in maneuver.start}) == 3


@pytest.mark.parametrize("name", MANEUVERS)
def test_without_self_collision_a_maneuver_intersects(name):
    maneuver = MANEUVERS[name](GRID, seeds=range(4))
    counts = run(maneuver, 4.5)
    assert np.mean(counts > 0) > 0.2
    assert not maneuver.simulation.diverged.any()


def test_a_seed_is_the_same_sheet_in_any_batch():
    together, alone = (MANEUVERS["drag at 1 m/s"](GRID, seeds=seeds) for seeds in ([3, 4, 5], [4]))
    for _ in range(30):
        together.step()
        alone.step()
    assert np.array_equal(together.simulation.positions[1], alone.simulation.positions[0])


@pytest.mark.parametrize("layers", [2, 6])
def test_leaves_of_the_z_fold_keep_their_distance(layers):
    # columns beside a crease face each other across it
    maneuver = MANEUVERS["z-fold"](grid(25, 25, 1, 1), seeds=[0], thickness=0.008, leaves=layers)
    columns = maneuver.start[0].reshape(25, 25, 3)
    apart = np.linalg.norm(columns[:, 2:] - columns[:, :-2], axis=2).min()
    assert 0.0115 < apart < 0.013  # 1.5 thicknesses, less the unevenness of a seed


@pytest.mark.parametrize(("times", "extents"), [(1, (1.0, 0.5)), (2, (0.5, 0.5)), (3, (0.5, 0.25))])
def test_a_folded_sheet_has_half_the_size(times, extents):
    name = ("fold", "fold twice", "fold three times")[times - 1]
    maneuver = MANEUVERS[name](grid(13, 13, 1.0, 1.0), seeds=[0, 1])
    while not maneuver.over:
        maneuver.step()
    found = np.ptp(maneuver.simulation.positions[:, :, :2], axis=1)
    assert np.all(np.abs(found - extents) < 0.15)
    assert not maneuver.simulation.attached.any()


def test_a_wring_turns_one_end_against_the_other():
    maneuver = MANEUVERS["wring"](GRID, seeds=[0], turns=0.25, turning=1.0)
    before = maneuver.held.copy()
    run(maneuver, 1.0)
    after = maneuver.simulation.positions[0, maneuver.simulation.anchors]
    left, right = np.split(np.arange(len(after)), 2)
    for end, angle in ((left, -np.pi / 4), (right, np.pi / 4)):
        across = [np.ptp(x[end][:, 1:][[0, -1]], axis=0) for x in (before[0], after)]
        assert np.allclose(np.abs(np.arctan2(across[1][1], across[1][0])), abs(angle), atol=0.08)
    # the ends have come nearer by the share that is the default
    assert np.isclose(np.ptp(after[:, 0]) / np.ptp(before[0, :, 0]), 0.85, atol=0.01)


def test_a_corner_is_dragged_at_its_speed():
    maneuver = MANEUVERS["drag at 3 m/s"](GRID, seeds=[7])
    corner, places = maneuver.simulation.anchors[0], []
    for _ in range(60):
        maneuver.step()
        places.append(maneuver.simulation.positions[0, corner])
    ways = np.linalg.norm(np.diff(places, axis=0), axis=1) * 60
    assert ways.max() < 3.001
    # it loses way only where it turns within a frame
    assert np.median(ways) == pytest.approx(3, rel=1e-3)


@pytest.mark.parametrize("kind", STARTS)
def test_starts_rest_on_the_floor_and_do_not_intersect(kind):
    mesh = grid(10, 10, 0.8, 0.8)
    x = starts.make(mesh, kind=kind, count=2, seed=5)
    assert x.shape == (2, mesh.num_particles, 3)
    assert not np.array_equal(x[0], x[1])
    for sheet in x:
        assert intersecting_pairs(mesh.triangles, sheet) == set()
    assert 0 <= x[:, :, 2].min() < 0.01
    assert x[:, :, 2].max() > 0.008  # not flat


def test_a_start_does_not_depend_on_the_others():
    mesh = grid(9, 9, 0.8, 0.8)
    np.testing.assert_array_equal(starts.make(mesh, kind="folded", count=3, seed=5)[1:2], starts.make(mesh, kind="folded", seed=6))


def test_starts_that_intersect_are_refused():
    with pytest.raises(RuntimeError, match="folded sheet of seed 3 intersects itself .* times, at triangles"):
        starts.make(GRID, kind="folded", seed=3, self_collision=False)


def test_invalid_starts_are_refused():
    with pytest.raises(ValueError, match="crumpled"):
        starts.make(GRID, kind="ironed")
    with pytest.raises(ValueError, match="3 times at most"):
        MANEUVERS["fold"](GRID, times=4)
    with pytest.raises(ValueError, match="count=0: must be an integer of at least 1"):
        starts.make(GRID, count=0)
    with pytest.raises(ValueError, match="mesh=None: must be a ClothMesh"):
        starts.make(None)
    with pytest.raises(ValueError, match="thickness=True: must be a finite number"):
        starts.make(grid(5, 5, 1.0, 1.0), self_collision={"thickness": True})
    with pytest.raises(ValueError, match="seed=-1"):
        starts.make(GRID, seed=-1)
    with pytest.raises(ValueError, match="seeds=.-1.: must be integers"):
        MANEUVERS["heap"](GRID, seeds=[-1])
    with pytest.raises(ValueError, match="colliders: set by the maneuver itself"):
        starts.make(GRID, colliders=[])
