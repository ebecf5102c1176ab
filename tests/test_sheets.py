"""Sheets of another resolution or side, targets of chosen shapes, and rumpled starts at any resolution, in the tasks of all ids."""

import gymnasium as gym
import hang_towel  # registers an id
import numpy as np
import pytest

from clothgym import Simulation, grid
from clothgym.envs.rumpled import resampled, rumpled_sheets

DRAPING = ("ClothDrape-v0", "ClothDrapeGripper-v0")


def single(env_id, **kwargs):
    return gym.make(env_id if ":" in env_id else f"clothgym:{env_id}", **kwargs).unwrapped


# the median fabric weighs 197 g/m2, the knit 178
@pytest.mark.parametrize(
    ("env_id", "rows", "side", "density"), [("ClothReach-v0", 7, 0.4, 0.197), ("ClothStrain-v0", 9, 0.2, 0.178)]
)
def test_a_sheet_has_the_resolution_and_side_that_were_asked_for(env_id, rows, side, density):
    env = single(env_id, rows=rows, side=side, obs_mode="particles")
    env.reset(seed=1)
    task = env.task
    assert task.physics.mesh.num_particles == rows**2 and task.simulation.positions.shape == (1, rows**2, 3)
    assert np.sum(1 / task.simulation.get_state().free_inverse_mass) == pytest.approx(density * side**2, rel=2e-3)
    # observed points are in sides: so are the rest lengths between them
    points = task.observation[0, : 3 * rows**2].reshape(rows, rows, 3)
    assert np.linalg.norm(points[0, 1:] - points[0, :-1], axis=1).mean() == pytest.approx(1 / (rows - 1), rel=0.05)
    observation, *_ = env.step(task.expert_actions()[0])
    assert env.observation_space.contains(observation)


@pytest.mark.parametrize("rows", [13, 25])
def test_clips_are_as_wide_at_every_resolution_and_bear_the_sheet_s_weight(rows):
    env = single("ClothStrain-v0", rows=rows, wind={})
    env.reset(seed=0)
    for clip in env.task.physics.held:
        x = env.task.physics.mesh.rest_positions[list(clip)]
        assert np.ptp(x[:, 0]) == pytest.approx(0.05) and np.ptp(x[:, 1]) == pytest.approx(0.025)
    # a knit of 178 g/m2; the clipped cloth itself, 4 to 5 % of the sheet, hangs on no yarn
    *_, info = env.step(np.zeros(6))
    weight = 0.178 * 0.3**2 * 9.81
    assert 0.93 * weight < info["tension_left"] + info["tension_right"] < 1.02 * weight


def test_the_reach_task_pinches_as_much_of_the_corner_at_every_resolution():
    for rows, side in ((9, 0.6), (17, 0.6), (9, 0.3)):
        env = single("ClothReach-v0", rows=rows, side=side)
        (pinch,) = env.task.physics.held
        x = env.task.physics.mesh.rest_positions[list(pinch)]
        assert pinch[0] == env.task.physics.mesh.corners[2]
        assert np.ptp(x, axis=0)[:2] == pytest.approx([side / 8, side / 8])
        # it hangs from there by nearly its diagonal, less the pinched corner's share
        env.reset(seed=0)
        x = env.task.simulation.positions[0]
        assert 1.2 * side < x[pinch[0], 2] - x[env.task.physics.mesh.corners[1], 2] < np.sqrt(2) * side * 1.02


def test_its_own_resolution_and_side_change_no_bit():
    plain, same = single("ClothReach-v0"), single("ClothReach-v0", rows=9, side=0.6)
    for env in (plain, same):
        env.reset(seed=3)
    assert same.task.simulation.substeps == plain.task.simulation.substeps == 50
    for _ in range(5):
        ours, others = (env.step(env.action_space.low)[0] for env in (plain, same))
        assert ours.tobytes() == others.tobytes()


@pytest.mark.parametrize(
    ("kwargs", "what"),
    [
        ({"rows": 4}, "rows=4"),
        ({"rows": 50}, "rows=50"),
        ({"rows": 17.5}, "rows=17.5"),
        ({"rows": True}, "rows=True"),
        ({"side": 0.0}, "side=0.0"),
        ({"side": float("nan")}, "side=nan"),
        ({"side": 2.0}, "side=2.0: must be from 0.1 to 1.0 m"),
    ],
)
def test_no_such_sheet_is_refused(kwargs, what):
    with pytest.raises(ValueError, match=what.replace(".", r"\.")):
        single("ClothDrape-v0", **kwargs)


def test_a_task_whose_anchors_belong_to_one_mesh_says_so():
    with pytest.raises(ValueError, match="rows=17, side=None: this task has one mesh; .* function of the mesh"):
        single("hang_towel:HangTowel-v0", rows=17)
    assert single("hang_towel:HangTowel-v0", rows=hang_towel.TOWEL.shape[0]).task.physics.mesh is hang_towel.TOWEL


# --- targets ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("env_id", DRAPING)
def test_targets_are_of_the_shapes_that_were_asked_for(env_id):
    for shapes, wanted in (("box", {"box"}), (("sphere", "post"), {"sphere", "post"})):
        env = gym.make_vec(f"clothgym:{env_id}", num_envs=24, shapes=shapes).unwrapped
        env.reset(seed=0)
        assert {target.shape for target in env.task.targets} == wanted
    # an episode may still ask for another
    env.reset(seed=0, options={"target": {"shape": "box"}})
    assert {target.shape for target in env.task.targets} == {"box"}


@pytest.mark.parametrize("shapes", [(), "chair", ("box", "chair"), 3])
def test_shapes_that_no_target_has_are_refused(shapes):
    with pytest.raises(ValueError, match="shapes=.*sphere, box, post"):
        single("ClothDrape-v0", shapes=shapes)


# --- rumpled starts -----------------------------------------------------------------------------------------------------------


def test_particles_of_another_resolution_lie_on_the_triangles():
    own, other = grid(5, 5, 1.0, 1.0), grid(9, 9, 1.0, 1.0)
    rng = np.random.default_rng(0)
    x = own.rest_positions + rng.normal(scale=0.1, size=(3, 25, 3))
    fine = resampled(x, own, other).reshape(3, 9, 9, 3)
    # every second particle is one of the old ones, and those between two of them lie in the middle of a border
    coarse = x.reshape(3, 5, 5, 3)
    assert np.allclose(fine[:, ::2, ::2], coarse)
    assert np.allclose(fine[:, ::2, 1::2], (coarse[:, :, 1:] + coarse[:, :, :-1]) / 2)
    assert np.allclose(fine[:, 1::2, ::2], (coarse[:, 1:] + coarse[:, :-1]) / 2)
    # the middle of a cell lies on its diagonal, the edge that two triangles share
    middles = fine[:, 1::2, 1::2].reshape(3, -1, 3)
    cells = np.arange(25).reshape(5, 5)[:-1, :-1].ravel()
    for k, first in enumerate(cells):
        corners = {first, first + 1, first + 5, first + 6}
        both = [set(t) for t in own.triangles.tolist() if set(t) <= corners]
        i, j = both[0] & both[1]
        assert np.allclose(middles[:, k], (x[:, i] + x[:, j]) / 2)


@pytest.mark.parametrize(("rows", "side"), [(13, 0.6), (25, 0.6), (17, 0.3)])
def test_rumpled_sheets_of_any_resolution_begin_without_intersections(rows, side):
    sheets = rumpled_sheets(rows, rows, side)
    assert len(sheets) >= 16 and sheets.shape[1:] == (rows**2, 3)
    assert sheets[:, :, 2].min(axis=1) == pytest.approx(0.002, abs=1e-4)
    simulation = Simulation(grid(rows, rows, side, side), num_envs=len(sheets))
    simulation.reset(positions=sheets)
    assert not simulation.intersections().any()


def test_a_flat_start_may_have_any_resolution():
    env = single("ClothDrapeGripper-v0", rows=9)
    env.reset(seed=0, options={"rumpled": False})
    x = env.task.simulation.positions[0]
    assert np.ptp(x[:, 2]) < 1e-3
