"""Self-collision: nothing passes through itself, by a count that knows nothing of it."""

from collections import namedtuple

import numpy as np
import pytest
from exact_intersections import intersecting_pairs
from folded import SIDE, sheet, three_layers

import clothgym
from clothgym import contact_memory
from clothgym.collisions import Solid, Solids
from clothgym.collisions.self.broad_phase import Reach, enclose, far_leaves
from clothgym.collisions.self.gap_constraints import enforce_gaps
from clothgym.collisions.self.impulses import FASTEST, _correct
from clothgym.collisions.self.query import query
from clothgym.collisions.self.query_scratch import LEAF_PAIRS, Found, scratch_for_queries
from clothgym.collisions.self.topology import pairs_of
from clothgym.collisions.solids.attachment_contact import probe_of
from clothgym.contact_memory import C_SIZE, G_SIZE, REPORT_SIZE
from clothgym.layout import Layout
from clothgym.starts import MANEUVERS


def count_intersections(triangles, x):
    return len(intersecting_pairs(triangles, x))


# --- the query, against brute force -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("mesh", [sheet(13), clothgym.disc(0.5, 5), clothgym.grid(2, 2, 1.0, 1.0), clothgym.grid(3, 6, 1.0, 1.0)])
@pytest.mark.parametrize("far", [0.0, 0.03, 2.0])
def test_the_tree_finds_all_pairs_of_leaves_once(mesh, far):
    """Of all that share no vertex, those whose boxes and balls are within reach; worked out here one by one."""
    random, pairs = np.random.default_rng(0), pairs_of(mesh).tree
    x = mesh.rest_positions @ random.normal(size=(3, 3)) * 0.3 + 0.02 * random.normal(size=(mesh.num_particles, 3))
    extra = 0.01 * random.random(mesh.num_particles)
    leaves = len(pairs.corners)
    boxes, balls, hulls = np.empty((6, leaves)), np.empty((4, leaves)), np.empty((6, len(pairs.nodes)))
    enclose(x, pairs.corners, pairs.nodes, extra, np.empty(leaves), boxes, balls, hulls)
    # in batches, the last of which ends with the tree
    out, rows, node = np.empty((LEAF_PAIRS * leaves, 2), np.int32), [], 0
    while node < len(pairs.nodes):
        number, node = far_leaves(pairs, far, balls, boxes, hulls, node, out)
        rows += [tuple(pair) for pair in out[:number].tolist()]
    wide = extra[pairs.corners].max(axis=1)
    low, high = x[pairs.corners].min(axis=1) - wide[:, None], x[pairs.corners].max(axis=1) + wide[:, None]
    center = x[pairs.corners].mean(axis=1)
    radius = np.linalg.norm(x[pairs.corners] - center[:, None], axis=2).max(axis=1) + wide
    expected = {
        (a, b) for a in range(leaves) for b in range(a + 1, leaves)
        if not set(pairs.corners[a]) & set(pairs.corners[b])
        and np.all(low[a] <= high[b] + far) and np.all(low[b] <= high[a] + far)
        and np.linalg.norm(center[a] - center[b]) <= radius[a] + radius[b] + far
    }  # fmt: skip
    assert len(rows) == len(expected) and set(rows) == expected
    if far == 2.0:
        assert len(rows) == sum(not set(a) & set(b) for k, a in enumerate(pairs.corners) for b in pairs.corners[:k])


def pairs_by_sampling(mesh, x, points=25):
    """Every vertex and triangle, and every two edges, that share no vertex: the vertices of both, and their smallest distance, of
    points on a fine grid, so a little too large."""
    triangles = mesh.triangles
    edges = np.unique(np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1), axis=0)
    share = np.linspace(0, 1, points)
    on_edges = x[edges[:, :1]] * (1 - share[:, None]) + x[edges[:, 1:]] * share[:, None]
    u, v = (grid.ravel() for grid in np.meshgrid(share, share))
    inside = u + v <= 1 + 1e-9
    weights = np.stack([1 - u - v, u, v], axis=1)[inside]
    on_triangles = np.einsum("pc,tcd->tpd", weights, x[triangles])
    for e in range(len(edges)):
        for f in range(e + 1, len(edges)):
            if not set(edges[e]) & set(edges[f]):
                yield edges[e], edges[f], np.sqrt(((on_edges[e][:, None] - on_edges[f]) ** 2).sum(axis=-1).min())
    for p in range(len(x)):
        for t in range(len(triangles)):
            if p not in triangles[t]:
                yield np.array([p]), triangles[t], np.sqrt(((on_triangles[t] - x[p]) ** 2).sum(axis=-1).min())


def queried(mesh, x, reach, extra=0.0, held=False, most=4000):
    """Scratch of a query, and the members and planes of the gap constraints that it found, with room for ``most``."""
    pairs = pairs_of(mesh)
    scratch = scratch_for_queries(pairs, np.empty((900, 3)))
    scratch.p[:], scratch.ahead[:], scratch.extra[:], scratch.held[:] = x, x, extra, held
    members, planes = np.empty((most, G_SIZE), np.int32), np.empty((most, 4))
    found = Found(np.empty((900, 4), np.int32), np.empty((900, C_SIZE)), members, planes, scratch.counts, np.zeros(REPORT_SIZE))
    query(pairs, reach, scratch, found)
    return scratch, members[: scratch.counts[1]], planes[: scratch.counts[1]]


def looked_around(mesh, x, extra, most):
    """Bounds and limits of a query with a reach of 6 cm."""
    scratch, members, _ = queried(mesh, x, Reach(0.06, 0.06, 0.03, 0.03, 0.01, 0.0, 0.0, 0.0), extra, most=most)
    return scratch.bounds, scratch.limits, members


def crumpled_strip(seed):
    """Folded in three, with far and near pairs that come close."""
    mesh = clothgym.grid(4, 10, SIDE, 0.2)
    x = three_layers(mesh, 0.025)
    return mesh, x + np.random.default_rng(seed).normal(scale=0.004, size=x.shape)


@pytest.mark.parametrize("seed", range(2))
def test_a_bound_is_no_larger_than_its_share_of_the_true_distance(seed):
    mesh, x = crumpled_strip(seed)
    truth = np.full(len(x), np.inf)
    for one, other, gap in pairs_by_sampling(mesh, x):
        members = [*one, *other]
        truth[members] = np.minimum(truth[members], gap)
    bounds, limits, _ = looked_around(mesh, x, np.zeros(len(x)), 0)
    near = truth < 0.03
    assert near.sum() >= 6  # the case is worth something
    assert np.all(bounds <= 0.45 * truth)
    # and not much smaller than it could be
    assert np.median(bounds[near] / (0.45 * truth[near])) > 0.55
    assert np.array_equal(bounds, limits)  # nothing is constrained


@pytest.mark.parametrize("most", [0, 4000])
def test_limits_of_what_looks_farther_keep_apart_what_is_not_constrained(most):
    """Some vertices are fast and may go farther: what they may go in all is less than the distance, but for gap constraints."""
    mesh, x = crumpled_strip(0)
    random = np.random.default_rng(1)
    extra = np.where(random.random(len(x)) < 0.3, random.uniform(0, 0.06, len(x)), 0.0)
    bounds, limits, constrained = looked_around(mesh, x, extra, most)
    assert len(constrained) < max(most, 1)  # there was room
    known = {frozenset(row[3 : 3 + row[1]].tolist()) for row in constrained}
    checked = 0
    for one, other, gap in pairs_by_sampling(mesh, x, 13):
        members = frozenset([*one.tolist(), *other.tolist()])
        if not any(members <= pair for pair in known):
            assert limits[one].max() + limits[other].max() <= 0.9 * gap
            checked += gap < 0.12
        assert bounds[one].max() + bounds[other].max() <= 0.9 * gap
    assert checked > 100
    assert most == 0 or limits.max() > 0.05  # those that are fast gain by it


def test_a_gap_constraint_keeps_more_where_something_is_held():
    """The distance to keep, or with a held vertex the larger one for those, or the gap of now if that is smaller: for pairs and for
    leaves alike, each gap worked out here along the constraint's normal."""
    mesh, x = crumpled_strip(0)
    stop, standoff = 0.012, 0.02
    held = np.random.default_rng(2).random(len(x)) < 0.15
    _, members, planes = queried(mesh, x, Reach(0.06, 0.06, 0.03, 0.03, 0.01, stop, standoff, 0.0), held=held)
    seen = set()
    for row, (*normal, kept) in zip(members, planes):
        own, number = row[:2]
        along = x[row[3 : 3 + number]] @ normal
        gap, most = along[:own].min() - along[own:].max(), standoff if held[row[3 : 3 + number]].any() else stop
        assert kept == pytest.approx(min(gap, most), abs=1e-12)
        seen.add((number, most, gap < most))
    assert {(4, stop, False), (4, standoff, False), (4, standoff, True), (8, stop, False), (8, standoff, False)} <= seen


# --- nothing passes through itself ------------------------------------------------------------------------------------------

SHORT = {"z-fold": 60, "heap": 150, "wring": 400, "drag at 3 m/s": 200}


def bad_frames(name, mode, mesh, thickness=None, frames=None, every=1, seeds=(0,)):
    setting = {"mode": mode} if thickness is None else {"mode": mode, "thickness": thickness}
    made = MANEUVERS[name](mesh, seeds=seeds, self_collision=setting, **({} if thickness is None else {"thickness": thickness}))
    bad = 0
    for frame in range(frames or SHORT[name]):
        made.step()
        if frame % every == 0:
            bad += int(made.simulation.intersections()[0] > 0)
    # the library's count is compared with the tests' own in test_intersections; here once more
    assert count_intersections(mesh.triangles, made.simulation.positions[0]) == made.simulation.intersections()[0]
    return bad, made.simulation


@pytest.mark.parametrize("name", SHORT)
def test_strict_never_intersects(name):
    bad, simulation = bad_frames(name, "strict", sheet())
    assert bad == 0
    assert simulation.self_contacts.dropped[0] == 0 and not simulation.diverged[0]


def test_strict_never_intersects_on_a_disc():
    bad, _ = bad_frames("heap", "strict", clothgym.disc(0.3, 6), frames=120)
    assert bad == 0


def test_a_thin_sheet_that_is_wrung_intersects_without_the_bound():
    """If this did not fail, the tests above would prove nothing."""
    bad, _ = bad_frames("wring", "fast", sheet(), thickness=0.004)
    assert bad > 5


def test_a_thin_sheet_that_is_wrung_does_not_intersect_with_it():
    bad, simulation = bad_frames("wring", "strict", sheet(), thickness=0.004)
    assert bad == 0


def test_a_jam_without_room_for_constraints_does_not_creep(monkeypatch):
    """What may not move at all stays to the bit: if it crept by rounding, it would come through in time."""
    monkeypatch.setitem(contact_memory.MOST_PER_VERTEX, "constraints", 0)
    mesh = sheet(9)
    option = {"mode": "strict", "thickness": 0.012}
    wring = MANEUVERS["impossible wring"](mesh, seeds=[0, 1], thickness=0.012, time_step=1 / 60, self_collision=option)
    gap = np.inf
    for _ in range(240):
        wring.step()
        gap = min(gap, wring.simulation.self_contacts.gap.min())
    assert wring.simulation.self_contacts.clamped.min() > 100
    assert wring.simulation.self_contacts.dropped.min() > 100
    # pairs move while their distance is above 1e-5 m, and what rounding takes from that is less than a hundredth
    assert 0.99e-5 < gap < 1.01e-5
    assert not wring.simulation.intersections().any()


def test_a_jam_does_not_carry_attachments_away():
    """Cloth that may not move stays between the anchors that pull at it, which cannot go on: none of it gets out of their reach."""
    option = {"mode": "strict", "thickness": 0.012}
    wring = MANEUVERS["impossible wring"](sheet(9), seeds=[1, 2], thickness=0.012, time_step=1 / 60, self_collision=option)
    for _ in range(200):
        wring.step()
        assert (
            np.abs(wring.simulation.positions).max() < 0.8
        )  # the attachments' way is within 0.75 m; 20 m where a jam carried them
    assert wring.simulation.self_contacts.clamped.min() > 100
    assert not wring.simulation.intersections().any()


def test_a_jam_has_the_same_bits_alone_and_from_a_restored_state():
    def wrung(seeds):
        option = {"mode": "strict", "thickness": 0.012}
        wring = MANEUVERS["impossible wring"](sheet(9), seeds=seeds, thickness=0.012, time_step=1 / 60, self_collision=option)
        for _ in range(80):
            wring.step()
        return wring.simulation

    both, alone = wrung([1, 2]), wrung([2])
    np.testing.assert_array_equal(both.positions[1], alone.positions[0])
    state, clamped = both.get_state(), 0
    both.step(10)
    ended = both.positions
    both.set_state(state)
    for _ in range(10):
        both.step()
        clamped += both.self_contacts.clamped.min()
    np.testing.assert_array_equal(both.positions, ended)
    assert clamped > 100


def test_anchors_that_stand_still_again_are_caught_up_with():
    """A sheet that is swung so hard that its corners are thrown together: no pair freezes that has room to come apart."""
    mesh = clothgym.grid(13, 13, 0.5, 0.5)
    hang = mesh.rest_positions[:, [0, 2, 1]] * (1, 1, -1) + (0, 0, 1.5)
    top = [int(p) for p in np.lexsort((mesh.rest_positions[:, 0], mesh.rest_positions[:, 1]))[[0, 12]]]
    simulation = clothgym.Simulation(mesh, anchors=top, self_collision="strict")
    simulation.reset(positions=hang)
    for frame in range(80):
        phase = (frame + 1) / 60 % 0.8 / 0.8
        if frame < 40:
            targets = hang[top] + (0, 4 * min(phase, 1 - phase), 0)
        simulation.move_anchors(targets)
        simulation.step()
    np.testing.assert_allclose(simulation.positions[0, top], targets, atol=1e-3)
    assert simulation.self_contacts.clamped[0] == 0 and simulation.strain().max() < 0.1


# --- what it leaves alone ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("option", ["strict", {"mode": "strict", "thickness": 0.002}])
def test_a_free_swing_is_the_same_to_the_bit(option):
    """It is much faster than a thin sheet's bounds are wide; they are about the motion that all share."""
    runs = []
    for mode in (False, option):
        simulation = clothgym.Simulation(clothgym.grid(13, 13, 1, 1), num_envs=3, anchors=[0, 12], self_collision=mode)
        simulation.step(40)
        runs.append(simulation.positions)
    assert np.abs(runs[0][..., 2]).max() > 0.3  # it did swing
    np.testing.assert_array_equal(*runs)


def test_a_thrown_sheet_keeps_its_speed():
    mesh = sheet(9)
    option = {"mode": "strict", "thickness": 0.002}
    simulation = clothgym.Simulation(mesh, gravity=(0, 0, 0), air_density=0.0, self_collision=option)
    simulation.set_parameters(air_drag=0.0)
    ripple = 0.005 * np.sin(20 * mesh.rest_positions[:, :1]) * (0, 0, 1)
    simulation.reset(positions=mesh.rest_positions + ripple, velocities=np.full((1, 81, 3), (8.0, 0.0, 3.0)))
    simulation.step(30)
    np.testing.assert_allclose(simulation.velocities[0].mean(axis=0), (8, 0, 3), atol=0.01)
    np.testing.assert_allclose(simulation.positions[0].mean(axis=0) - ripple.mean(axis=0), (4, 0, 1.5), atol=0.01)


def test_what_is_clamped_in_flight_keeps_the_speed_of_the_flight():
    """A thin folded sheet that spins at 20 rad/s, whose vertices leave their limits; thrown as well, it does the same."""
    mesh, ended = sheet(9), {}
    x = three_layers(mesh, 0.03)
    x -= x.mean(axis=0)
    option = {"mode": "strict", "thickness": 0.0005}
    for flight in ((0.0, 0.0, 0.0), (8.0, 0.0, 3.0)):
        simulation = clothgym.Simulation(mesh, gravity=(0, 0, 0), air_density=0.0, self_collision=option)
        simulation.set_parameters(air_drag=0.0)
        simulation.reset(positions=x, velocities=np.cross((0, 0, 20), x) + flight)
        mass, clamped = 1 / simulation.get_state().free_inverse_mass[0], 0
        before = mass @ simulation.velocities[0]
        for _ in range(3):
            simulation.step()
            clamped += simulation.self_contacts.clamped[0]
        assert clamped > 100
        assert mass @ simulation.velocities[0] == pytest.approx(before, abs=1e-4 * float(mass.sum()))
        ended[flight] = simulation.positions[0] - 0.05 * np.array(flight), simulation.velocities[0] - flight
    still, thrown = ended.values()
    assert thrown[0] == pytest.approx(still[0], abs=1e-5)
    assert thrown[1] == pytest.approx(still[1], abs=1e-3)


def test_momentum_is_conserved_in_contact():
    """Two halves of a folded sheet meet in free flight."""
    mesh = sheet(9)
    simulation = clothgym.Simulation(mesh, gravity=(0, 0, 0), air_density=0.0, self_collision={"mode": "fast", "friction": 0.5})
    simulation.set_parameters(air_drag=0.0)
    x = three_layers(mesh, 0.03)
    v = np.zeros_like(x)
    v[:, 2] = np.where(x[:, 2] > 0.055, -0.5, 0.1)
    v[:, 0] = np.where(x[:, 2] > 0.055, 0.3, 0.0)
    simulation.reset(positions=x, velocities=v)
    mass = 1 / simulation.get_state().free_inverse_mass[0]
    before = mass @ v
    touching = 0
    for _ in range(12):
        simulation.step()
        touching = max(touching, simulation.self_contacts.touching[0])
    assert touching > 5
    np.testing.assert_allclose(mass @ simulation.velocities[0], before, atol=1e-6)


# --- at rest ----------------------------------------------------------------------------------------------------------------


def test_three_layers_on_a_table_rest_at_their_thickness():
    mesh = sheet(17)
    simulation = clothgym.Simulation(mesh, colliders=[clothgym.Plane(friction=0.5)], self_collision="strict")
    thickness = 0.28 * SIDE / 16 / np.sqrt(2)
    simulation.set_parameters(air_drag=1.0)  # this fabric does not tolerance its folds itself
    simulation.reset(positions=three_layers(mesh, 1.6 * thickness))
    simulation.step(180)
    x, v = simulation.positions[0], simulation.velocities[0]
    assert np.sqrt((v**2).sum(axis=1).mean()) < 2e-4  # 1e-3 where contacts push apart all that is too close at once
    flat = np.abs(x[:, 0] - x[:, 0].mean()) < 0.05  # away from the folds
    layers = [x[flat & (np.round((x[:, 2] - 0.001) / thickness) == k), 2].mean() for k in range(3)]
    np.testing.assert_allclose(np.diff(layers), thickness, rtol=0.2)


def test_a_large_heap_comes_to_rest():
    """It trembles at 60 to 110 mm/s where contacts push apart what cannot give way."""
    heap = MANEUVERS["heap"](clothgym.grid(25, 25, 1, 1), seeds=range(4), self_collision={"mode": "strict", "thickness": 0.008})
    while not heap.over:
        heap.step()
    heap.simulation.step(240)
    speed = np.sqrt((heap.simulation.velocities**2).sum(axis=2).mean(axis=1))
    assert np.median(speed) < 0.03


@pytest.mark.parametrize(("friction", "slides"), [(0.2, True), (0.6, False)])
def test_friction_between_layers(friction, slides):
    """The upper half of a folded sheet under gravity aslant: it slides on the lower half, which is held, where tan(angle) is above
    the coefficient."""
    mesh = clothgym.grid(17, 9, 0.3, 0.6)
    simulation = clothgym.Simulation(
        mesh,
        colliders=[clothgym.Plane(friction=0.5)],
        anchors=[int(p) for p in np.flatnonzero(mesh.rest_positions[:, 1] < -0.01)],
        self_collision={"mode": "strict", "friction": friction, "thickness": 0.006},
    )
    x = mesh.rest_positions.copy()
    s = x[:, 1] + 0.3
    gap, half = 0.008, 0.294
    arc = np.pi * gap / 2
    upper = s > half + arc
    turn = np.clip((s - half) / (gap / 2), 0, np.pi)
    x[:, 1] = np.where(upper, 2 * half + arc - s, np.where(s > half, half + gap / 2 * np.sin(turn), s))
    x[:, 2] = np.where(s > half, gap / 2 * (1 - np.cos(turn)), 0) + 0.002
    simulation.reset(positions=x)
    # along the fold, where the fabric's own stiffness resists the sliding least
    tilt = np.arctan(0.4)
    simulation.set_parameters(gravity=9.81 * np.array([np.sin(tilt), 0, -np.cos(tilt)]))
    start = simulation.positions[0]
    simulation.step(20)
    loose = (mesh.rest_positions[:, 1] > 0.05) & (mesh.rest_positions[:, 1] < 0.2)
    moved = (simulation.positions[0] - start)[loose, 0].mean()
    assert (moved > 1e-2) == slides


# --- attachments ------------------------------------------------------------------------------------------------------------


def test_an_anchor_that_would_pull_cloth_through_cloth_stops_and_lags():
    """A corner is drawn over the sheet, most of which is held fast, and down on to it, as if to come out below."""
    mesh = sheet(13)
    away = np.abs(mesh.rest_positions[:, :2] - mesh.rest_positions[0, :2]).max(axis=1)
    fixed = [int(p) for p in np.flatnonzero(away > 0.3)]
    simulation = clothgym.Simulation(mesh, anchors=[0, *fixed], anchor_speed=2.0, self_collision="strict", gravity=(0, 0, 0))
    targets = simulation.attachment_positions
    lags = []
    for place in [(0.0, 0.0, 0.15), (0.12, 0.12, 0.1), (0.12, 0.12, -0.1)]:
        targets[0, 0] = place
        for _ in range(30):
            simulation.move_anchors(targets)
            simulation.step()
            lags.append(simulation.self_contacts.lag[0])
            assert simulation.intersections()[0] == 0
    assert max(lags[:60]) < 1e-6 < max(lags[60:])
    stopped = simulation.positions[0, 0]
    assert 0 < stopped[2] < 2 * 0.28 * SIDE / 12 / np.sqrt(2)
    # and it goes where it can
    targets[0, 0] = (0.12, 0.12, 0.1)
    for _ in range(30):
        simulation.move_anchors(targets)
        simulation.step()
    np.testing.assert_allclose(simulation.positions[0, 0], targets[0, 0], atol=1e-3)


@pytest.mark.parametrize(("speed", "across"), [(0.5, 0.12), (2.0, 0.2)])
def test_an_anchor_does_not_press_cloth_into_the_floor(speed, across):
    """A corner is laid on the sheet and pressed against it: the sheet goes no deeper than the corner moves in a substep, but 2.7
    and 13 mm without what deflects the jam.  The second environment has all of this, and its floor, 10 cm higher."""
    mesh, floors = sheet(13), np.array([[0, 0, 0.0], [0, 0, 0.1]])
    simulation = clothgym.Simulation(
        mesh, num_envs=2, anchors=[0], anchor_speed=speed, self_collision="strict", colliders=[clothgym.Plane(tuple(floors[0]))]
    )
    simulation.set_collider(0, [clothgym.Plane(tuple(floor)) for floor in floors])
    start = mesh.rest_positions - mesh.rest_positions.min(axis=0) + [0, 0, 0.005]
    simulation.reset(positions=start + floors[:, None])
    deepest, lags = 0.0, []
    for place in [(0.0, 0.0, 0.15), (across, across, 0.1), (across, across, -0.05), (across + 0.1, across, -0.05)]:
        for _ in range(30):
            simulation.move_anchors((floors + place)[:, None])
            simulation.step()
            deepest = max(deepest, (floors[:, 2] - simulation.positions[..., 2].min(axis=1)).max())
            lags.append(simulation.self_contacts.lag)
    assert deepest < speed * simulation.time_step / simulation.substeps and not simulation.intersections().any()
    assert np.max(lags[:60]) < 1e-6 < 1e-3 < np.min(np.max(lags[60:], axis=0))


def test_a_contact_takes_no_more_speed_in_a_substep_than_there_is():
    """What a jam keeps from substep to substep would grow for ever: a vertex hits a triangle at 1000 m/s."""
    real = np.float32
    x, v = np.zeros((3, 4), real), np.zeros((3, 4), real)
    x[:2, 1:], x[2, 0], v[2, 0] = [[1, -1, -1], [0, 1, -1]], 0.001, -1000.0
    coefficients, impulses = np.array([[1, -1 / 3, -1 / 3, -1 / 3, 0, 0, 1, 0.008]], real), np.zeros((1, 3), real)
    mobility, chosen = np.full(4, 2.0, real), np.zeros(1, np.int32)
    h = real(1e-3)
    _correct(x, v, mobility, np.arange(4, dtype=np.int32)[None], coefficients, impulses, chosen, 1, h, real(0), real(0), h, 1)
    np.testing.assert_allclose(impulses[0], [0, 0, FASTEST / (2 * (1 + 3 / 9))], rtol=1e-6)
    np.testing.assert_allclose(v.sum(axis=1), [0, 0, -1000], rtol=1e-6)


Jam = namedtuple("Jam", "old lag report members planes constraints behind")
JammedSheet = namedtuple("JammedSheet", "memory solid")
Scratch = namedtuple("Scratch", "halvings zone wish before_zone zone_before mean squares probe")
H = 0.5  # substep [s]


def enforced(x, moves, w, pairs=((0, 1, 1.0),), limit=np.inf, solids=()):
    """What becomes of the moves of vertices, of their velocities, which are moves / H, and of the lag, (vertices, 3) each.

    pairs: the upper and the lower vertex of each gap constraint along z, and the share of their distance that it keeps.
    """
    real, n = np.float32, len(x)
    old = np.array(x, real).T[:, :, None].copy()
    now, v = old + np.array(moves, real).T[:, :, None], np.array(moves, real).T[:, :, None] / real(H)
    members = np.zeros((1, 1, len(pairs), G_SIZE), np.int32)
    members[0, 0, :, :5] = [[1, 2, 0, upper, lower] for upper, lower, _ in pairs]
    heights = old[2, :, 0].astype(float)
    planes = np.array([[[[0, 0, 1, share * (heights[upper] - heights[lower])] for upper, lower, share in pairs]]])
    count = np.full((1, 1), len(pairs), np.int32)
    memory = Jam(
        old[None], np.zeros((1, 3, n, 1), real), np.zeros((1, 1, REPORT_SIZE)), members, planes, count, np.zeros((1, 1), real)
    )
    rows, whole = (np.empty((6, n), real) for _ in range(2)), (np.empty(n, np.int64) for _ in range(3))
    scratch = Scratch(next(whole), next(whole), *rows, next(whole), np.empty(6), np.full(n, limit**2, real), probe_of(old))
    outside, active = np.ones(n, np.bool_), np.arange(len(pairs), dtype=np.int32)
    colliders = Solids(Layout(1, 1, 1, "lanes"), solids, H, np.dtype(real))
    sheet = JammedSheet(memory, Solid(colliders.shapes, colliders.described()[None, :, :, None].astype(real)))
    enforce_gaps(now, v, np.array(w, real)[:, None], sheet, 0, 0, outside, active, len(pairs), scratch, real(H), True)
    return (now - old)[..., 0].T, v[..., 0].T, memory.lag[0, ..., 0].T


@pytest.mark.parametrize("height", [0.001, 1e-5])
def test_what_a_jam_holds_keeps_its_momentum(height):
    """A vertex of 1 kg comes down on one of 3 kg, which rises; both sink together, unless rounding may close their gap."""
    x, moves = [(0, 0, 0.5 + height), (0, 0, 0.5), (0, 0, 0.6)], [(2e-4, 0, -8e-4), (0, 4e-4, 0), (0, 0, -3e-4)]
    moved, v, lag = enforced(x, moves, [1, 1 / 3, 1])
    together = np.array([0.5e-4, 3e-4, -2e-4]) if height > 1e-4 else np.zeros(3)
    np.testing.assert_allclose(moved, [together, together, moves[2]], atol=1e-7)
    np.testing.assert_allclose(v * H, [together, together, moves[2]], atol=1e-8)
    assert not lag.any()


def test_a_jam_of_free_vertices_is_not_pressed_into_the_floor():
    """A vertex of 1 kg comes down on one of 1 kg, which lies on the floor: both slide by half of its way along the floor."""
    x, moves = [(0, 0, 0.501), (0, 0, 0.5), (0, 0, 0.6)], [(4e-4, 0, -8e-4), (0, 2e-4, 2e-4), (0, 0, 0)]
    moved, v, _ = enforced(x, moves, [1, 1, 1], solids=[clothgym.Plane((0, 0, 0.5))])
    np.testing.assert_allclose(moved[:2], [(2e-4, 1e-4, 0)] * 2, atol=1e-7)
    np.testing.assert_allclose(v[:2] * H, [(2e-4, 1e-4, 0)] * 2, atol=1e-7)
    # with a wall ahead they stay
    corner = [clothgym.Plane((0, 0, 0.5)), clothgym.Plane((0, 0, 0.5), (-2, -1, 0))]
    np.testing.assert_allclose(enforced(x, moves, [1, 1, 1], solids=corner)[0][:2], 0, atol=1e-7)


def test_what_cannot_be_certified_stays_to_the_bit():
    """A gap constraint that keeps more than there is, as of parts that almost touch: rounding could close their gap."""
    moved, v, _ = enforced([(0, 0, 0.500001), (0, 0, 0.5)], [(2e-4, 0, -8e-4), (0, 4e-4, 0)], [1, 1], pairs=[(0, 1, np.inf)])
    assert not moved.any() and not v.any()


def test_a_jam_takes_along_what_it_runs_into():
    """A jam of 2 kg comes down on a vertex of 1 kg at rest: all three sink by the third part of the sum of their moves."""
    x, moves = [(0, 0, 0.502), (0, 0, 0.501), (0, 0, 0.5)], [(0, 0, -1.2e-3), (0, 0, 0), (0, 0, 0)]
    moved, v, _ = enforced(x, moves, [1, 1, 1], pairs=[(0, 1, 1.0), (1, 2, 0.9)])
    np.testing.assert_allclose(moved[:, 2], -4e-4, atol=1e-7)
    np.testing.assert_allclose(v[:, 2] * H, -4e-4, atol=1e-8)
    # attached, it stays, and so does all else; the jam of two others, which it took in, moves by itself
    x, moves = [*x, (0, 0, 0.4995), (0, 0, 0.499)], [*moves, (0, 0, -2e-4), (0, 0, 0)]
    moved, _, lag = enforced(x, moves, [0, 0, 0, 1, 1], pairs=[(0, 1, 1.0), (1, 2, 0.9), (3, 4, 1.0)])
    np.testing.assert_allclose(moved[:, 2], [0, 0, 0, -1e-4, -1e-4], atol=1e-7)
    np.testing.assert_allclose(lag[:, 2], [-1.2e-3, 0, 0, 0, 0], atol=1e-7)


def test_a_jam_moves_no_farther_than_its_limits_and_as_what_is_attached():
    x, moves = [(0, 0, 0.501), (0, 0, 0.5), (0, 0, 0.6)], [(0, 0, -8e-4), (0, 0, 0), (0, 0, 0)]
    moved, v, _ = enforced(x, moves, [1, 1, 1], limit=1e-4)
    np.testing.assert_allclose(moved[:2, 2], -1e-4, atol=1e-7)
    np.testing.assert_allclose(v[:2, 2] * H, -1e-4, atol=1e-8)
    # an attached vertex takes the other one along, as far as it gets, and does not lag
    for limit, way in ((np.inf, -8e-4), (1e-4, -1e-4)):
        moved, v, lag = enforced(x, moves, [0, 1, 1], limit=limit)
        np.testing.assert_allclose(moved[:2, 2], way, atol=1e-7)
        assert v[1, 2] * H == pytest.approx(way, abs=1e-7)
        np.testing.assert_allclose(lag[0], (0, 0, -8e-4 - way), atol=1e-7)
    # a floor under the other one deflects both, and the attached one lags; below a roof that comes down to it they stay
    floor, down = clothgym.Plane((0, 0, 0.5)), [(3e-4, 0, -8e-4), (0, 0, 2e-4), (0, 0, 0)]
    moved, v, lag = enforced(x, down, [0, 1, 1], solids=[floor])
    np.testing.assert_allclose(moved[:2], [(3e-4, 0, 0)] * 2, atol=1e-7)
    np.testing.assert_allclose(v[1] * H, (3e-4, 0, 0), atol=1e-7)
    np.testing.assert_allclose(lag[0], (0, 0, -8e-4), atol=1e-7)
    moved, _, lag = enforced(x, down, [0, 1, 1], solids=[floor, clothgym.Plane((0, 0, 0.5), (-1, 0, -0.5))])
    assert not moved[:2].any()
    np.testing.assert_allclose(lag[0], down[0], atol=1e-7)
    # at the edge of a plate, out of which it is pushed farther than its limit, they stay
    plate = clothgym.Box((0, 0, 0.5), (1.0, 1.0, 0.0005), thickness=0.0)
    assert not enforced([(2, 0, 0.5015), (0, 0, 0.5006), x[2]], moves, [0, 1, 1], limit=7e-4, solids=[plate])[0][:2].any()
    # a slope under the other one does not press the attached one into a wall
    slope, wall = clothgym.Plane((-0.1, 0, 0.5), (1, 0, 1)), clothgym.Plane((0, 0, 0), (-1, 0, 0))
    assert not enforced([x[0], (-0.1, 0, 0.5), x[2]], moves, [0, 1, 1], solids=[slope, wall])[0][:2].any()
    # however slowly they move
    below, place = 0.0, x
    for _ in range(20):
        moved = enforced(place, [(0, 0, -9e-6), (0, 0, 0), (0, 0, 0)], [0, 1, 1], solids=[floor])[0]
        below, place = below + moved[1, 2], np.asarray(place) + moved
    assert below == pytest.approx(-1e-5, abs=1e-6)
    # two that do not move alike stay, and lag
    moved, _, lag = enforced(x, moves, [0, 0, 1])
    assert not moved[:2].any()
    np.testing.assert_allclose(lag, moves, atol=1e-7)
