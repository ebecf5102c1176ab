"""Attachments: patches that move as one, grippers that take hold and let go, slip, and what the cloth pulls with."""

import numpy as np
import pytest

from clothgym import INTEGRATORS, Gripper, Material, Plane, Simulation, State, grid

NAMES = list(INTEGRATORS)
CONSISTENT = [name for name in NAMES if INTEGRATORS[name].order is not None]  # pbd's springs do not pull with the fabric's force
MESH = grid(5, 5, 0.2, 0.2)
STEP = 1 / 30
REST = MESH.rest_positions
G = 9.81
# damps a hanging sheet in a second or two
DAMPED = Material.preset("penava_cotton", air_drag=1.5)


def simulation(**kwargs):
    return Simulation(MESH, **({"time_step": STEP, "threads": 1} | kwargs))


def gripper(particle, **kwargs):
    """A gripper that begins at a particle's place at rest; neighbors are 0.05 m apart."""
    return Gripper(position=tuple(REST[particle]), **kwargs)


def weight(s):
    """m g [N], of each environment."""
    return G * (1 / s.get_state().free_inverse_mass.astype(float)).sum(axis=1)


# --- anchors as patches ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_patch_moves_as_one_and_no_faster_than_its_limit(name):
    patch = [0, 1, 5, 6]
    s = simulation(integrator=name, anchors=[patch, 24], anchor_speed=0.6, dtype="float64")
    way = np.array([0.6, 0.0, 0.8])
    targets = s.attachment_positions + 0.5 * way
    s.move_anchors(targets)
    for step in range(1, 6):
        s.step()
        moved = s.positions[0] - REST
        assert moved[patch] == pytest.approx(np.tile(way * 0.6 * STEP * step, (4, 1)), abs=1e-12)
        assert moved[24] == pytest.approx(way * 0.6 * STEP * step, abs=1e-12)
        assert s.attachment_positions[0] == pytest.approx(s.positions[0, [0, 24]], abs=1e-12)
    s.step(30)
    assert s.attachment_positions == pytest.approx(targets, abs=1e-12)
    assert s.positions[0, patch] - s.positions[0, 0] == pytest.approx(REST[patch] - REST[0], abs=1e-12)


def test_a_patch_is_released_and_attached_as_one():
    s = simulation(num_envs=2, anchors=[[20, 21, 22], [24, 23]])
    assert s.anchors.tolist() == [20, 24] and s.attached.all()
    s.release(envs=[1], anchors=[0])
    assert s.attached.tolist() == [[True, True], [False, True]]
    held = (s.get_state().holder >= 0).sum(axis=1)
    assert held.tolist() == [5, 2]
    s.step(4)
    assert np.all(s.positions[1, [20, 21], 2] < -1e-3)
    assert np.array_equal(s.positions[0, [20, 21, 22, 23, 24]], REST[20:25].astype(np.float32))
    assert np.array_equal(s.positions[1, [23, 24]], REST[[23, 24]].astype(np.float32))
    s.attach(envs=[1], anchors=[0])
    taken = s.positions[1]
    assert s.attachment_positions[1, 0] == pytest.approx(taken[20], abs=0)
    assert s.get_state().holder[1].tolist() == s.get_state().holder[0].tolist()
    s.step(4)
    assert np.array_equal(s.positions[1, 20:25], taken[20:25])


# --- grippers: fingers ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("closing_time", [0.1, 0.25])
def test_fingers_take_their_time_to_close_and_to_open(closing_time):
    s = simulation(grippers=[gripper(12, closing_time=closing_time)])
    assert s.grippers.openings.tolist() == [[1.0]] and s.grippers.held.tolist() == [[0]]
    here = s.grippers.positions
    for goal, sign in ((0, 1), (1, -1)):
        s.grippers.move(here, goal)
        for step in range(1, 12):
            s.step()
            traveled = min(1, step * STEP / closing_time)
            assert s.grippers.openings[0, 0] == pytest.approx((1 - traveled) if sign > 0 else traveled, abs=1e-5)


def test_fingers_stop_where_they_are_told():
    s = simulation(grippers=[gripper(12, closing_time=0.1)])
    s.grippers.move(s.grippers.positions, 0.5)
    s.step(10)
    assert s.grippers.openings[0, 0] == 0.5 and s.grippers.held[0, 0] == 0


@pytest.mark.parametrize("name", NAMES)
def test_what_is_in_reach_when_the_fingers_have_closed_is_held_and_nothing_else(name):
    """Without weight, so that the sheet waits; the tip is moved while the fingers close: its last place counts."""
    s = simulation(
        integrator=name, num_envs=3, gravity=(0, 0, 0), grippers=[Gripper(position=(0.0, 0.0, 0.1), reach=0.056, closing_time=0.1)]
    )
    places = np.stack([REST[12], REST[12] + (0.025, 0.0, 0.01), REST[12] + (0, 0, 0.06)])[:, None]
    s.grippers.place(places + (0.05, 0, 0))
    s.grippers.move(places, 0.0)
    s.step(2)
    assert not s.grippers.held.any() and np.all(s.get_state().holder == -1)
    x = s.positions
    s.step(3)
    for env in range(3):
        near = np.linalg.norm(REST - places[env], axis=1) <= 0.056
        assert np.array_equal(s.get_state().holder[env] == 0, near)
        assert s.grippers.held[env, 0] == near.sum()
    assert s.grippers.held[:, 0].tolist() == [5, 2, 0]
    assert s.positions == pytest.approx(x, abs=1e-6)


def test_what_another_holds_is_not_taken():
    s = simulation(
        anchors=[12], gravity=(0, 0, 0), grippers=[gripper(11, reach=0.051), gripper(13, reach=0.051), gripper(13, reach=0.11)]
    )
    tips = s.grippers.positions
    s.grippers.move(tips, [0, 1, 1])
    s.step(5)
    assert np.flatnonzero(s.get_state().holder[0] == 1).tolist() == [6, 10, 11, 16]
    s.grippers.move(tips, [0, 0, 1])
    s.step(5)
    assert np.flatnonzero(s.get_state().holder[0] == 2).tolist() == [8, 13, 14, 18]
    s.grippers.move(tips, [0, 0, 0])
    s.step(5)
    assert s.get_state().holder[0, 12] == 0 and s.attached.all()
    assert np.flatnonzero(s.get_state().holder[0] == 3).tolist() == [3, 7, 9, 17, 19, 23]
    # an anchor that lets go and takes hold again takes what is free only
    s.release()
    s.grippers.move(tips, [1, 0, 0])
    s.step()
    s.attach()
    assert s.get_state().holder[0, 12] == 0 and s.grippers.held.tolist() == [[0, 4, 6]]


def test_what_is_held_by_a_gripper_cannot_be_attached():
    s = simulation(anchors=[12], gravity=(0, 0, 0), grippers=[gripper(12)])
    s.release()
    s.grippers.move(s.grippers.positions, 0)
    s.step(5)
    s.attach()
    assert not s.attached.any() and s.get_state().holder[0, 12] == 1


@pytest.mark.parametrize("name", NAMES)
def test_held_particles_keep_their_places_in_the_attachment_at_its_speed_limit(name):
    s = simulation(integrator=name, gravity=(0, 0, 0), grippers=[gripper(12, reach=0.051, speed=0.5)], dtype="float64")
    s.grippers.move(s.grippers.positions, 0)
    s.step(4)
    s.set_parameters(gravity=(0, 0, -G))
    held = np.flatnonzero(s.get_state().holder[0] == 0)
    assert held.tolist() == [7, 11, 12, 13, 17]
    offsets = s.positions[0, held] - s.grippers.positions[0]
    goal = s.grippers.positions + (0.3, 0.4, 0.0)
    s.grippers.move(goal, 0)
    for _ in range(12):
        before = s.grippers.positions
        s.step()
        assert np.linalg.norm(s.grippers.positions - before) == pytest.approx(0.5 * STEP, rel=1e-9)
        assert s.positions[0, held] - s.grippers.positions[0] == pytest.approx(offsets, abs=1e-12)
    s.step(30)
    assert s.grippers.positions == pytest.approx(goal, abs=1e-12)
    assert s.positions[0, held] - s.grippers.positions[0] == pytest.approx(offsets, abs=1e-12)


def test_every_attachment_has_its_own_speed_limit():
    s = simulation(anchors=[0], anchor_speed=1.5, grippers=[Gripper(speed=0.25), Gripper(speed=0.75)])
    before = s.attachment_positions
    s.move_anchors(before[:, :1] + (0, 9, 0))
    s.grippers.move(before[:, 1:] + (0, 9, 0), 1)
    s.step(3)
    moved = s.attachment_positions - before
    assert moved[0, :, 1] == pytest.approx([1.5 * 3 * STEP, 0.25 * 3 * STEP, 0.75 * 3 * STEP], rel=1e-5)
    assert not moved[0, :, [0, 2]].any()


def test_cloth_is_let_go_when_the_fingers_begin_to_open():
    s = simulation(gravity=(0, 0, 0), grippers=[gripper(12, closing_time=0.2)])
    s.grippers.move(s.grippers.positions, 0)
    s.step(7)
    s.set_parameters(gravity=(0, 0, -G))
    assert s.grippers.held[0, 0] == 1
    s.step(10)
    assert s.positions[0, 12, 2] == 0 and s.positions[0, 0, 2] < -0.01
    s.grippers.move(s.grippers.positions, 1)
    s.step()
    assert s.grippers.held[0, 0] == 0 and s.grippers.openings[0, 0] == pytest.approx(STEP / 0.2, rel=1e-5)
    assert s.positions[0, 12, 2] < -1e-3
    s.reset()
    assert s.grippers.openings.tolist() == [[1.0]] and s.grippers.positions[0, 0] == pytest.approx(REST[12], abs=1e-7)
    assert np.all(s.get_state().holder == -1)


def test_placing_a_gripper_leaves_what_it_holds():
    s = simulation(num_envs=2, gravity=(0, 0, 0), grippers=[gripper(12)])
    s.grippers.move(s.grippers.positions, 0)
    s.step(4)
    s.grippers.place([[[0.5, 0.5, 0.5]]], envs=[1])
    assert s.grippers.positions[:, 0].tolist() == [[0, 0, 0], [0.5, 0.5, 0.5]]
    s.step(2)
    assert s.positions[:, 12] == pytest.approx(np.zeros((2, 3)), abs=1e-6)
    assert s.grippers.held.tolist() == [[1], [1]]


# --- pulls and slip -------------------------------------------------------------------------------------------------------


def hang_from_a_gripper(s, steps=300):
    """Let the sheet hang calmly from its anchor, corner 24, then hand it over to a gripper whose fingers close at once."""
    s.step(steps)
    s.grippers.place(s.attachment_positions[:, :1])
    s.grippers.move(s.attachment_positions[:, :1], 0)
    s.release()
    s.step()


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("anchors", [[24], [20, 24], [[20, 21], [24, 23]]])
def test_a_sheet_at_rest_pulls_with_its_weight(anchors, dtype):
    s = simulation(anchors=anchors, material=DAMPED, dtype=dtype)
    s.step(400)
    total = s.pulls()[0].sum(axis=0)
    assert total == pytest.approx([0, 0, -weight(s)[0]], abs=0.01 * weight(s)[0])
    if len(anchors) == 2:
        one, other = s.pulls()[0]
        # both carry half, and the sheet draws them together
        assert one[2] == pytest.approx(other[2], rel=0.01)
        assert one[0] > 0.05 * weight(s)[0] and one[0] == pytest.approx(-other[0], rel=0.02)


@pytest.mark.parametrize("name", CONSISTENT)
def test_a_gripper_feels_the_weight_that_it_took_over(name):
    s = simulation(integrator=name, anchors=[24], grippers=[gripper(24, closing_time=0.03)], material=DAMPED, dtype="float64")
    s.step(300)
    anchored = s.pulls()[0, 0]
    hang_from_a_gripper(s, 1)
    s.step(30)
    assert s.grippers.held.tolist() == [[1]] and not s.attached.any()
    pulls = s.pulls()
    assert pulls.shape == (1, 2, 3) and not pulls[0, 0].any()
    assert pulls[0, 1] == pytest.approx(anchored, rel=1e-4, abs=1e-5)
    assert pulls[0, 1, 2] == pytest.approx(-weight(s)[0], rel=0.01)


def test_an_open_gripper_and_an_anchor_that_let_go_feel_nothing():
    s = simulation(anchors=[20, 24], grippers=[gripper(0)])
    s.release(anchors=[0], envs=[0])
    s.step(5)
    pulls = s.pulls()[0]
    assert not pulls[0].any() and not pulls[2].any() and pulls[1, 2] < 0


def test_the_wind_s_force_on_held_particles_is_part_of_the_pull():
    """All held, at rest: weight and air alone, rho/2 C_D A U^2 upwards."""
    s = simulation(anchors=[list(range(25))], wind=(0, 0, 2.0), dtype="float64")
    assert s.pulls()[0, 0] == pytest.approx([0, 0, 0.6 * 1.2 * 0.04 * 4 - weight(s)[0]], rel=1e-6, abs=1e-9)


@pytest.mark.parametrize(("share", "stays"), [(0.9, False), (1.1, True)])
@pytest.mark.parametrize("name", CONSISTENT)
def test_cloth_slips_out_of_a_gripper_that_is_too_weak_for_its_weight(name, share, stays):
    total = DAMPED.density * 0.04 * G
    s = simulation(
        integrator=name,
        num_envs=2,
        material=DAMPED,
        anchors=[24],
        grippers=[gripper(24, closing_time=0.03, slip_force=share * total)],
    )
    hang_from_a_gripper(s)
    s.step(30)
    fallen = s.grippers.positions[:, 0, 2] - s.positions[:, 24, 2]
    assert np.all(s.grippers.openings == 0)
    if stays:
        assert s.grippers.held.tolist() == [[1], [1]] and fallen == pytest.approx([0, 0], abs=1e-5)
        # twice the weight is too much for it
        s.set_parameters([1], gravity=(0, 0, -2 * G))
        s.step(30)
        assert s.grippers.held.tolist() == [[1], [0]]
    else:
        assert s.grippers.held.tolist() == [[0], [0]] and np.all(fallen > 0.5)


def test_an_anchor_and_a_gripper_without_a_slip_force_never_slip():
    s = simulation(anchors=[0], grippers=[gripper(24, closing_time=0.03), gripper(20, closing_time=0.03, slip_force=1e-6)])
    s.grippers.move(s.grippers.positions, 0)
    s.step()
    assert s.grippers.held.tolist() == [[1, 0]]
    s.set_parameters(gravity=(0, 0, -300.0))
    s.step(10)
    assert s.grippers.held.tolist() == [[1, 0]] and s.attached.all()
    assert np.linalg.norm(s.pulls()[0, :2], axis=1).min() > 1


@pytest.mark.parametrize("name", NAMES)
def test_a_lane_among_seventeen_does_what_it_does_alone(name):
    """Positions, holds, openings and pulls, while every lane's gripper goes its own way."""
    rng = np.random.default_rng(0)
    targets = np.concatenate([REST[[20, 24]][None].repeat(17, 0), REST[[6, 2]][None].repeat(17, 0)], axis=1)
    targets[:, 2:] += rng.normal(scale=0.03, size=(17, 2, 3))
    lift, openings = rng.uniform(0, 0.2, (17, 1, 1)), rng.choice([0.0, 0.3, 1.0], (3, 17, 2))
    attachments = {
        "anchors": [[20, 15], 24],
        "grippers": [gripper(6, reach=0.08, closing_time=0.07), gripper(2, reach=0.06, slip_force=0.02)],
    }

    def run(lanes):
        s = simulation(integrator=name, num_envs=len(lanes), substeps=450 if name == "explicit_euler" else 160, **attachments)
        seen = []
        for phase in range(3):
            if phase == 1 and 3 in lanes:
                s.release(envs=[lanes.index(3)], anchors=[0])
            s.move_anchors(targets[lanes, :2] + lift[lanes] * phase)
            s.grippers.move(targets[lanes, 2:] + lift[lanes] * phase, openings[phase, lanes])
            for _ in range(5):
                s.step()
                state = s.get_state()
                seen.append((s.positions, s.velocities, state.holder, s.grippers.openings, s.grippers.held, s.pulls()))
        return seen

    together = run(list(range(17)))
    assert any(len(np.unique(step[4][:, 0])) > 2 for step in together)
    for lane in (0, 3, 16):
        for one, all_ in zip(run([lane]), together):
            for mine, theirs in zip(one, all_):
                assert np.array_equal(mine[0], theirs[lane])


def test_a_saved_state_with_grippers_goes_on_bit_for_bit(tmp_path):
    def make():
        return simulation(
            num_envs=3, anchors=[[20, 21], 24], grippers=[gripper(6, slip_force=50.0), gripper(2, closing_time=0.3)], threads=2
        )

    s, other = make(), make()
    goal = s.grippers.positions + (0.02, 0.03, 0.2)
    s.set_parameters(gravity=(0, 0, 0))
    s.grippers.move(s.grippers.positions, 0)
    s.step(4)
    s.set_parameters(gravity=(0, 0, -G))
    s.grippers.move(goal, 0)
    s.release(envs=[2], anchors=[1])
    s.step(2)
    assert 0 < s.grippers.openings[0, 1] < 1 and s.grippers.held[:, 0].all()
    s.get_state().save(tmp_path / "state.npz")
    other.set_state(State.load(tmp_path / "state.npz"))
    assert np.array_equal(other.grippers.held, s.grippers.held) and np.array_equal(other.attached, s.attached)
    for _ in range(8):
        s.step()
        other.step()
        for name in ("positions", "velocities", "holder", "attachment_positions", "openings"):
            assert np.array_equal(getattr(s.get_state(), name), getattr(other.get_state(), name)), name
    assert np.array_equal(s.pulls(), other.pulls())
    # the orders to the attachments are part of it: the fingers went on closing, the tips on their way
    assert np.all(other.grippers.openings == 0) and other.grippers.positions[0, 0, 2] > 0.15
    with pytest.raises(ValueError, match="4 attachments .anchors, then grippers., this simulation 3"):
        simulation(num_envs=3, anchors=[[20, 21], 24], grippers=[gripper(6)]).set_state(s.get_state())


# --- errors ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"speed": 0.0}, "Gripper speed=0.0"),
        ({"reach": -0.1}, "Gripper reach=-0.1"),
        ({"span": np.nan}, "Gripper span=nan"),
        ({"closing_time": 0}, "Gripper closing_time=0"),
        ({"slip_force": 0.0}, "Gripper slip_force=0.0"),
        ({"slip_force": "strong"}, "Gripper slip_force='strong'"),
        ({"position": (0, 0)}, "Gripper position"),
        ({"position": (0, 0, np.inf)}, "Gripper position"),
        ({"position": "above"}, "Gripper position"),
    ],
)
def test_bad_grippers_are_named(kwargs, name):
    with pytest.raises(ValueError, match=name):
        Gripper(**kwargs)


@pytest.mark.parametrize(
    ("kwargs", "name"),
    [
        ({"grippers": Gripper()}, "sequence of Gripper"),
        ({"grippers": [(0, 0, 0)]}, "sequence of Gripper"),
        ({"anchors": [[0, 1], [1, 2]]}, "twice"),
        ({"anchors": [[0, 1], []]}, "anchor has none"),
        ({"anchors": [[0, 25]]}, "0 to 24"),
        ({"anchors": [[0, 0.5]]}, "anchors"),
    ],
)
def test_bad_attachments_are_named(kwargs, name):
    with pytest.raises(ValueError, match=name):
        simulation(**kwargs)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda g: g.move(np.zeros((2, 2, 3)), 0), "targets has shape"),
        (lambda g: g.move(np.zeros((2, 1, 2)), 0), "targets has shape"),
        (lambda g: g.move(np.full((2, 1, 3), np.nan), 0), "targets"),
        (lambda g: g.move(np.zeros((2, 1, 3)), 1.01), "openings hold 1.01"),
        (lambda g: g.move(np.zeros((2, 1, 3)), [[0.5], [-0.5]]), "openings hold -0.5"),
        (lambda g: g.move(np.zeros((2, 1, 3)), np.nan), "openings"),
        (lambda g: g.move(np.zeros((2, 1, 3)), np.zeros((3, 1))), "openings has shape"),
        (lambda g: g.place(np.zeros((2, 3, 3))), "positions has shape"),
        (lambda g: g.place(np.full(3, np.inf)), "positions"),
        (lambda g: g.place(np.zeros(3), envs=[2]), "environments are 0 to 1"),
    ],
)
def test_bad_orders_are_named_and_change_nothing(call, name):
    s = simulation(num_envs=2, grippers=[gripper(12)])
    before = s.get_state()
    with pytest.raises(ValueError, match=name):
        call(s.grippers)
    after = s.get_state()
    for field in ("attachment_positions", "attachment_targets", "openings", "wanted_openings"):
        assert np.array_equal(getattr(before, field), getattr(after, field))


def test_what_fingers_take_in_a_step_is_kept_out_of_the_floor_in_that_step():
    """They close in one step, in which the tip is told to go down by 3 cm, and what they take lies 1 cm below it."""
    quick = Gripper(position=(*REST[12, :2], 0.02), reach=0.02, closing_time=1e-3, speed=10)
    s = simulation(grippers=[quick], colliders=[Plane(thickness=0.01)])
    s.reset(positions=REST + (0, 0, 0.01))
    s.grippers.move([[[*REST[12, :2], -0.01]]], [[0]])
    s.step()
    assert np.flatnonzero(s.grippers.holder[0] == 0).tolist() == [12]
    assert s.positions[0, 12, 2] == pytest.approx(0, abs=1e-5)
    # and is still: what it pushes against the floor does not creep
    s.step(10)
    assert s.positions[0, 12, 2] == pytest.approx(0, abs=1e-5)


def test_what_lags_is_kept_out_of_the_floor_where_it_will_have_caught_up():
    """It is 2 cm above the floor and lags by 1.5 cm, so its gripper may go down by the rest."""
    s = simulation(
        grippers=[Gripper(position=(*REST[12, :2], 0.03), reach=0.02, closing_time=1e-3)], colliders=[Plane()],
        self_collision="strict", gravity=(0, 0, 0),
    )  # fmt: skip
    s.reset(positions=REST + (0, 0, 0.02))
    s.grippers.move([[[*REST[12, :2], 0.03]]], [[0]])
    s.step()
    state = s.get_state()
    state.self_contact["lag"][0, 12, 2] = -0.015
    s.set_state(state)
    for _ in range(3):
        s.grippers.move([[[*REST[12, :2], 0.012]]], [[0]])
        s.step()
    assert s.positions[0, 12, 2] == pytest.approx(0, abs=1e-5)
    assert s.grippers.positions[0, 0, 2] == pytest.approx(0.025, abs=1e-5)


@pytest.mark.parametrize("reach", [0.01, 0.2])
@pytest.mark.parametrize("slope", [0.3, 0.6])
def test_a_gripper_that_is_told_into_a_sharp_corner_stays_out_of_both_walls(slope, reach):
    """Two planes that meet at less than a right angle; it holds one particle, or all of them."""
    walls = [Plane(normal=(side, 0, slope), thickness=0.0) for side in (1, -1)]
    s = simulation(grippers=[Gripper(position=(0, 0, 1), reach=reach, closing_time=1e-3)], colliders=walls)
    s.reset(positions=REST - REST[12] + (0, 0, 1))
    for _ in range(60):
        s.grippers.move([[[0, 0, -1]]], [[0]])
        s.step()
        held = np.concatenate([s.positions[0, s.grippers.holder[0] == 0], s.grippers.positions[0]])
        heights = (slope * held[:, 2] - np.abs(held[:, 0])) / np.hypot(1, slope)
        assert heights.min() > -1e-4
    assert heights.min() < 0.03
