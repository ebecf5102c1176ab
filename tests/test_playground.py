"""The playground's stages: scenes, comparisons, environments and recordings, without a page."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from stages import advanced, page

from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.playground import server
from clothgym.playground.colors import RAMP, linear, ramp
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.recording import strains, tensions, yarns
from clothgym.playground.scenes import SCENES, scene_named, turned_on_a_lathe
from clothgym.playground.sheets import Stability, why_it_burst
from clothgym.playground.stage import SceneStage
from clothgym.playground.world import Settings
from clothgym.registration import ENVIRONMENTS


def lengths(mesh, x):
    """Of all springs [m], by a loop that shares nothing with what is tested."""
    return np.array([np.sqrt(((x[i] - x[j]) ** 2).sum()) for i, j in mesh.springs.particles])


# --- scenes and settings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_begins_whole_and_goes_on(name):
    stage = advanced(SceneStage(name), 5)
    first, last = stage.recording.frames[0], stage.frame
    assert np.abs(first.positions[0] - scene_named(name).start).max() < 1e-6
    assert np.isfinite(last.positions).all() and not stage.notes
    assert last.time == pytest.approx(10 / 60)
    assert stage.sheets[0].simulation.penetration()[0] < 0.003
    if name != "patch":
        assert np.abs(last.positions - first.positions).max() > 1e-3


def test_without_gravity_and_air_the_patch_stays_flat_and_with_gravity_it_droops_from_pins_that_do_not_move():
    stage = SceneStage("patch", Settings(gravity=0.0, fabric="knit", air_drag=0.75))
    pins = list(stage.scene.anchors)
    still = advanced(stage, 30).frame
    assert np.abs(still.positions[0] - stage.scene.start).max() < 1e-6
    stage.change(gravity=9.81)
    drooped = advanced(stage, 60).frame
    assert drooped.positions[0, 0, 2] < 0.5 * stage.scene.start[0, 2]
    assert np.array_equal(drooped.positions[0, pins], stage.recording.frames[0].positions[0, pins])


def test_readings_are_those_of_the_positions():
    stage = SceneStage("patch", Settings(fabric="knit", air_drag=0.75))
    frame = advanced(stage, 40).frame
    mesh, s = stage.scene.mesh, stage.sheets[0].simulation
    x, v = s.positions[0].astype(float), s.velocities[0].astype(float)
    stretch = lengths(mesh, x) - mesh.springs.rest_length
    structural = mesh.springs.kind <= 2
    assert frame.readings["strain"][0] == pytest.approx((stretch / mesh.springs.rest_length)[structural].max(), rel=1e-4)
    mass = stage.settings.material.density * mesh.area
    constant = frame.stiffness[0][mesh.springs.kind] * mesh.springs.weight
    elastic = 0.5 * constant @ stretch**2
    total = 0.5 * mass @ (v**2).sum(axis=1) + elastic + 9.81 * mass @ x[:, 2]
    assert frame.readings["energy"][0] == pytest.approx(total, rel=1e-3)
    # at rest the two pins carry the sheet, and what stretches it is its weight
    advanced(stage, 120)
    pull = s.pulls()[0].sum(axis=0)
    assert pull[2] == pytest.approx(-9.81 * mass.sum(), rel=0.02)


def test_colors_by_strain_are_loudest_where_the_test_finds_the_most_strained_springs():
    stage = advanced(SceneStage("patch", Settings(fabric="knit", air_drag=0.75)), 60)
    mesh, x = stage.scene.mesh, stage.frame.positions[0]
    springs = yarns(mesh)
    mine = (lengths(mesh, x.astype(float)) / mesh.springs.rest_length - 1)[springs]
    assert np.allclose(strains(mesh, x, springs), mine, atol=1e-9)
    forces = tensions(mesh, x, springs, stage.frame.stiffness[0])
    k = stage.sheets[0].simulation.get_state().stiffness[0]
    s = mesh.springs
    assert np.allclose(forces, (k[s.kind] * s.weight)[springs] * mine * s.rest_length[springs], rtol=1e-5)
    visitor, client = page()
    visitor.stage, visitor.moment, visitor.playing = stage, 60, False
    visitor._see()
    visitor.tick()
    shown, full = client.scene.handles["/threads0"], visitor.show.scale.strained
    assert mine.max() <= full < 2 * mine.max()  # the scale fits what is shown
    most = np.argsort(mine)[-4:]
    assert np.linalg.norm(shown.points[most] - x[mesh.springs.particles[springs[most]]], axis=2).max() < 0.0031
    assert np.array_equal(shown.colors[most], np.repeat(linear(ramp(mine[most] / full))[:, None], 2, axis=1))
    # threads at rest are not drawn: they have no length
    idle = mine < 0.2 * full
    assert idle.any() and np.array_equal(shown.points[idle, 0], shown.points[idle, 1])
    # the sheet hangs from two pins, and is stretched most where they hold it
    i, j = mesh.springs.particles[springs[np.argmax(mine)]]
    assert x[[i, j], 2].mean() > x[:, 2].min() + 0.7 * np.ptp(x[:, 2])
    side = "left" if x[[i, j], 0].mean() < 0 else "right"
    assert f"| {side} edge, near the top |" in visitor.controls["readings"].content
    assert f"{100 * mine.max():.2f} %" in visitor.controls["glance"].content


def test_the_colors_of_pushed_idle_and_loaded_springs_are_the_scales():
    assert np.array_equal(ramp(np.array([-2.0, 0.0, 1.0, 7.0])), RAMP[[0, 1, -1, -1]].astype(np.uint8))


def test_a_fabric_brings_its_figures_and_a_slider_is_a_figure():
    settings = Settings(fabric="cotton").changed(fabric="denim")
    assert settings.stretch_stiffness == 1615.7 and settings.material.density == 0.4
    assert settings.changed(bend_rigidity=1e-6).material.bend_rigidity == 1e-6
    assert settings.changed(gravity=1.0).stretch_stiffness == 1615.7


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gravity": -1.0}, "gravity=-1.0"),
        ({"stretch_stiffness": float("nan")}, "stretch_stiffness=nan"),
        ({"bend_rigidity": 2e-3}, "lower the rigidity to"),
        ({"integrator": "xpdb"}, "did you mean 'xpbd'"),
        ({"substeps": 0}, "substeps=0"),
        ({"strain_limit": 12.0}, "10 % is 0.1"),
        ({"fabric": "linen"}, "no material preset 'linen'"),
        ({"gravty": 1.0}, "did you mean 'gravity'"),
    ],
)
def test_a_wrong_setting_is_a_sentence_and_changes_nothing(changes, words):
    stage = advanced(SceneStage("patch"), 2)
    before, state = stage.settings, stage.sheets[0].simulation.get_state()
    with pytest.raises(ValueError, match=words):
        stage.change(**changes)
    after = stage.sheets[0].simulation.get_state()
    assert stage.settings == before and np.array_equal(after.stiffness, state.stiffness)
    stage.advance()


def test_what_changes_while_it_runs_changes_the_same_simulation_and_a_method_goes_on_from_where_it_is():
    stage = advanced(SceneStage("patch", Settings(fabric="knit", friction=0.3)), 10)
    simulation = stage.sheets[0].simulation
    stage.change(stretch_stiffness=60.0, gravity=5.0, substeps=30, friction=0.7)
    assert stage.sheets[0].simulation is simulation and simulation.substeps == 30
    x, v = simulation.positions, simulation.velocities
    stage.change(integrator="xpbd")
    other = stage.sheets[0].simulation
    assert other.integrator.name == "xpbd" and np.array_equal(other.positions, x) and np.array_equal(other.velocities, v)
    assert other.attached.all() and other.parameters[0, 1] == 60.0
    assert other.get_state().gravity[0, 2] == np.float32(-5.0)


def test_friction_reaches_the_solids_where_they_are():
    stage = advanced(SceneStage("cape"), 6)
    places = stage.sheets[0].simulation.collider_positions
    stage.change(friction=0.9)
    s = stage.sheets[0].simulation
    assert np.array_equal(s.collider_positions, places)
    assert np.all(s.get_state().colliders[0, :, R_FRICTION] == np.float32(0.9))


def test_a_strain_limit_shows_the_sheet_before_and_after():
    stage = SceneStage("patch", Settings(fabric="knit", air_drag=0.75))
    advanced(stage, 60)
    assert stage.frame.readings["strain"][0] > 0.2
    stage.change(strain_limit=0.1)
    advanced(stage, 30)
    assert stage.frame.readings["strain"][0] < 0.11
    assert stage.frame.readings["strain before limiting"][0] > stage.frame.readings["strain"][0]


def test_the_sheet_without_the_limit_hangs_beside_the_limited_one():
    visitor, client = page()
    assert not visitor.controls["unlimited"].visible
    for label, value in (("wind m/s", 0.0), ("gusts m/s", 0.0), ("gravity m/s²", 9.81), ("strain limit %", 10.0)):
        client.gui.handles[label].turn(value)
    visitor.tick()
    assert visitor.controls["unlimited"].visible and len(visitor.stage.sheets) == 1
    visitor.controls["unlimited"].turn(True)
    for _ in range(40):
        visitor.tick()
    mesh, frame = visitor.stage.scene.mesh, visitor.stage.frame
    own = mesh.springs.kind < 2
    limited, free = ((lengths(mesh, x.astype(float)) / mesh.springs.rest_length - 1)[own].max() for x in frame.positions)
    assert limited < 0.11 and free > 0.2
    assert client.scene.handles["/sheet0/front0"].color != client.scene.handles["/sheet1/front0"].color
    plain = SceneStage("patch", visitor.stage.settings.changed(strain_limit=None))
    assert np.abs(advanced(plain, 40).frame.positions[0] + visitor.stage.offsets[1] - frame.positions[1]).max() < 1e-6
    client.gui.handles["strain limit %"].turn(0.0)
    visitor.tick()
    assert len(visitor.stage.sheets) == 1 and not visitor.controls["unlimited"].visible


def test_seeds_give_the_same_bits_and_different_ones_do_not():
    stage = SceneStage("flag")
    runs = []
    for seed in (1, 2, 1):
        stage.reset(seed)
        runs.append(advanced(stage, 8).frame.positions)
    assert np.array_equal(runs[0], runs[2]) and not np.array_equal(runs[0], runs[1])
    held = np.ravel(stage.scene.anchors[0])
    assert np.array_equal(runs[0][0, held], stage.scene.start[held].astype(np.float32))


def test_attachments_hold_let_go_and_go_where_they_are_dragged():
    stage = advanced(SceneStage("sphere"), 3)
    assert not any(attachment.holds for attachment in stage.attachments())
    stage.drag(2, (-0.4, 0.4, 0.9))
    advanced(stage, 20)
    particle = stage.scene.anchors[2]
    assert np.allclose(stage.frame.positions[0, particle], (-0.4, 0.4, 0.9), atol=1e-5) and stage.attachments()[2].holds
    stage.drag(2, None)
    stage.hold(2, False)
    advanced(stage, 20)
    assert stage.frame.positions[0, particle, 2] < 0.8
    with pytest.raises(ValueError, match="the attachments of this scene are 0 to 3"):
        stage.drag(4, (0, 0, 0))


def test_a_lathe_turns_a_closed_cylinder_of_the_right_volume():
    vertices, triangles = turned_on_a_lathe(np.array([(0, 0), (0.1, 0), (0.1, 0.3), (0, 0.3)]), segments=60)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(0.5 * 60 * np.sin(2 * np.pi / 60) * 0.01 * 0.3)


# --- comparison ---------------------------------------------------------------------------------------------------------


def test_the_explicit_method_bursts_beyond_its_bound_and_the_sentence_says_why():
    stage = SceneStage("patch", Settings(fabric="knit", gravity=9.81, substeps=20), compared=("explicit_euler", "xpbd"))
    advanced(stage, 30)
    burst, kept = stage.sheets
    assert burst.burst and not kept.burst
    bound = burst.simulation.largest_substep()[0]
    assert bound < 1 / 60 / 20
    assert f"{1e3 / 60 / 20:.3g} ms is beyond its bound of {1e3 * bound:.3g} ms" in stage.notes["burst"]
    assert np.isfinite(stage.frame.positions).all() and np.abs(stage.frame.positions).max() < 10
    apart = stage.offsets[1, 0] - stage.offsets[0, 0]
    assert apart > stage.scene.mesh.size[0]
    stage.reset()
    assert not burst.burst and "burst" not in stage.notes


def test_stiffness_takes_an_explicit_method_over_its_bound():
    stage = SceneStage("patch", Settings(fabric="knit", gravity=9.81, substeps=10, air_drag=0.75))
    assert advanced(stage, 20).stabilities()[0].share < 1
    stage.change(stretch_stiffness=1500.0, shear_stiffness=600.0)
    assert stage.stabilities()[0].share > 1
    advanced(stage, 20)
    assert "beyond its bound" in stage.notes["burst"]


@pytest.mark.parametrize("compared", [(), ("semi_implicit_euler", "xpbd")])
@pytest.mark.parametrize("change", [{"integrator": "implicit_euler"}, {"strain_limit": 0.1}, {"substeps": 200}])
def test_a_sheet_that_has_burst_takes_other_settings_and_is_whole_after_a_reset(change, compared):
    stage = SceneStage("patch", Settings(fabric="knit", gravity=9.81, substeps=4, air_drag=0.75), compared=compared)
    advanced(stage, 4)
    assert "burst" in stage.notes
    shreds = stage.frame.positions[0]
    stage.change(**change)
    assert np.array_equal(stage.advance().positions[0], shreds) and "burst" in stage.notes
    stage.change(substeps=200)
    stage.reset()
    assert "burst" not in stage.notes and np.abs(stage.frame.positions[0] - stage.scene.start - stage.offsets[0]).max() < 1e-6
    advanced(stage, 10)
    assert "burst" not in stage.notes


def test_what_to_do_is_said_once_for_all_sheets_that_burst():
    stage = SceneStage("patch", Settings(fabric="knit", gravity=9.81, substeps=4), compared=("semi_implicit_euler", "verlet"))
    advanced(stage, 20)
    assert all(sheet.burst for sheet in stage.sheets)
    assert stage.notes["burst"].count(" burst") == 2 and stage.notes["burst"].count("and reset") == 1


def test_the_sentence_on_a_burst_without_a_bound_or_within_it():
    assert "has no bound here, it never damps" in why_it_burst("x", Stability(1e-3, 0.0, "it never damps", 1 / 60))
    assert "within the bound of 2 ms" in why_it_burst("x", Stability(1e-3, 2e-3, "", 1 / 60))


def test_beyond_its_bound_an_explicit_method_is_unstable_and_another_one_coarse():
    stage = SceneStage("patch", Settings(substeps=2), compared=("rk4", "xpbd", "implicit_euler", "projective_dynamics"))
    assert all(one.share > 1 for one in stage.stabilities())
    assert [one.verdict for one in stage.stabilities()] == ["unstable", *["stable, coarse"] * 3]
    stage.change(substeps=2000)
    assert [one.verdict for one in stage.stabilities()] == ["stable", *["accurate"] * 3]


@pytest.mark.parametrize("names", [("xpbd",), ("xpbd", "pbd", "rk4", "verlet", "explicit_euler")])
def test_two_to_four_are_compared(names):
    with pytest.raises(ValueError, match="choose two to 4"):
        SceneStage("patch", compared=names)


# --- environments and recordings ----------------------------------------------------------------------------------------


def test_an_environment_is_played_by_its_expert_and_its_frames_are_the_environments():
    stage = EpisodeStage("clothgym:ClothReach-v0", seed=7)
    env = gym.make("clothgym:ClothReach-v0").unwrapped
    env.reset(seed=7)
    total, done = 0.0, False
    while not done:
        _, reward, done, _, info = env.step(env.expert_action())
        total += reward
        frame = stage.advance()
        assert np.array_equal(frame.positions, env.task.simulation.positions)
        assert frame.terms == pytest.approx({name: info[f"reward/{name}"] for name in frame.terms})
    assert stage.over and f"return {total:.2f}" in stage.notes["evaluation"]
    assert stage.advance() is stage.frame
    assert stage.env.task.simulation.material == stage.settings.material


@pytest.mark.parametrize("env_id", ENVIRONMENTS)
def test_a_dragged_attachment_goes_to_the_visitor(env_id):
    stage = EpisodeStage(env_id, policy="noop")
    place = stage.attachments()[0].position + (0.0, 0.0, 0.1)
    stage.drag(0, place)
    advanced(stage, 12)
    assert np.allclose(stage.attachments()[0].position, place, atol=0.02)


def test_settings_reach_an_episode_and_stay_through_a_reset():
    stage = advanced(EpisodeStage("ClothReach-v0", policy="noop"), 3)
    stage.change(gravity=1.0, stretch_stiffness=100.0)
    for _ in range(2):
        state = stage.simulation.get_state()
        assert state.gravity[0, 2] == np.float32(-1.0) and state.parameters[0, 1] == 100.0
        stage.reset()
    x = advanced(stage, 3).simulation.positions
    stage.change(integrator="verlet")
    assert stage.simulation.integrator.name == "verlet" and np.array_equal(stage.simulation.positions, x)
    assert stage.stabilities()[0].share <= 1
    stage.change(self_collision="fast")
    assert "started again" in stage.notes["restart"] and stage.frame.time == 0


def test_wind_begins_an_episode_anew_and_blows_in_it():
    stage = advanced(EpisodeStage("ClothReach-v0", policy="noop"), 3)
    stage.change(wind=3.0)
    assert "started again" in stage.notes["restart"] and stage.frame.time == 0
    advanced(stage, 1)
    assert np.linalg.norm(stage.simulation.get_state().wind[0]) == pytest.approx(3.0)


def test_an_environments_own_wind_is_on_the_sliders_and_can_be_stilled():
    stage = EpisodeStage("ClothStrain-v0", policy="noop")
    assert (stage.settings.wind, stage.settings.gust) == (1.0, 0.3) and "draws its wind" in stage.notes["air"]
    stage.change(bending="hinge")
    assert stage.env.task.wind.gust == 0.3 and tuple(stage.env.task.wind.speed) == (0.0, 1.0)
    stage.change(wind=0.0, gust=0.0)
    advanced(stage, 1)
    assert not stage.simulation.get_state().wind.any() and "air" not in stage.notes


def test_a_learned_policy_acts_in_the_environment_that_it_was_trained_in():
    still = server.Learnt(lambda env, x: np.zeros((1, *env.action_space.shape), np.float32), {"wind": {"speed": [2.0, 2.0]}})
    stage = EpisodeStage("ClothReach-v0", {"run": still}, "run")
    advanced(stage, 1)
    assert np.linalg.norm(stage.simulation.get_state().wind[0]) == pytest.approx(2.0)
    assert stage.settings.wind == 2.0 and "As run was trained, with wind=" in stage.notes["run"]
    stage.change(integrator="verlet")
    assert tuple(stage.env.task.wind.speed) == (2.0, 2.0)
    later = EpisodeStage("ClothReach-v0", {"run": still})
    assert later.env.task.wind is None
    later.choose("run")
    assert tuple(later.env.task.wind.speed) == (2.0, 2.0)


def test_runs_of_the_same_name_are_told_apart(monkeypatch, tmp_path):
    runs = pytest.importorskip("clothgym.adapters.runs")
    monkeypatch.setattr(runs, "read_config", lambda folder: {"env": "ClothReach-v0", "env_kwargs": {"seen": str(folder)}})
    monkeypatch.setattr(runs, "learned", lambda folder, env_id: None)
    folders = [str(tmp_path / "a" / "run"), str(tmp_path / "b" / "run")]
    start, policies = server.policies_of(folders, "")
    assert start == "ClothReach-v0"
    seen = {name: policy.env_kwargs["seen"] for name, policy in policies[start].items()}
    assert seen == {"run": folders[0], folders[1]: folders[1]}


def test_a_policy_that_raises_and_a_recording_without_readings_are_told_on_the_page(capsys):
    def fail(env, observation):
        raise RuntimeError("no weights")

    visitor, client = page("ClothReach-v0", policies={"ClothReach-v0": {"broken": fail}})
    visitor.tick()
    visitor.tick()
    assert not visitor.playing and len(client.notifications) == 1
    assert "RuntimeError, no weights" in client.notifications[0] and "no weights" in capsys.readouterr().err
    visitor.controls["policy"].turn("noop")
    visitor.controls["time"].turn("play / pause")
    visitor.tick()
    assert len(visitor.stage.recording.frames) == 2
    recording = advanced(SceneStage("patch"), 2).recording
    recording.frames[:] = [replace(frame, readings={}) for frame in recording.frames]
    visitor, client = page(server.REPLAY, recording=recording)
    visitor.tick()
    visitor.tick()
    assert len(client.notifications) == 1 and "KeyError" in client.notifications[0]


def test_names_that_are_none_are_told_with_the_nearest():
    with pytest.raises(ValueError, match="no environment 'ClothReech-v0'; did you mean 'ClothReach-v0'"):
        EpisodeStage("ClothReech-v0")
    with pytest.raises(ValueError, match="no policy 'exprt'; did you mean 'expert'"):
        EpisodeStage("ClothReach-v0", policy="exprt")
    with pytest.raises(ValueError, match="no scene 'pach'; did you mean 'patch'"):
        SceneStage("pach")
