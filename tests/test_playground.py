"""The playground without a browser: stages, what a visitor's hand does, and the page in a viewer that shows nothing."""

import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from stages import NullClient, advanced, page, ticked

from clothgym import policies
from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.playground import hands, link
from clothgym.playground.controls import CLICKS, PRESETS
from clothgym.playground.episode import OFFSETS, EpisodeStage, Learnt
from clothgym.playground.exporting import SAVED, save_demonstration
from clothgym.playground.gallery import REPLAY, Gallery, committed_policies, policies_of
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording
from clothgym.playground.scenes import SCENES, Settings, begin, scene_named, turned_on_a_lathe
from clothgym.playground.server import Visit
from clothgym.playground.show import RAMP, linear, ramp, round_up
from clothgym.playground.stage import SceneStage

MIDDLE = 144  # of the patch's 17 x 17 particles
STILL = Settings(gravity=0.0, fabric="knit", air_drag=0.75)
HANGING = Settings(fabric="knit", air_drag=0.75)


def lengths(mesh, x):
    """Of all springs [m], by a loop that shares nothing with what is tested."""
    return np.array([np.sqrt(((x[i] - x[j]) ** 2).sum()) for i, j in mesh.springs.particles])


# --- scenes and settings ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SCENES)
def test_every_scene_begins_whole_and_goes_on(name):
    stage = advanced(SceneStage(name), 5)
    first, last = stage.recording.frames[0], stage.frame
    assert np.abs(first.positions[0] - scene_named(name).start).max() < 1e-6
    assert np.isfinite(last.positions).all() and not stage.notes and last.time == pytest.approx(10 / 60)
    assert stage.simulation.penetration()[0] < 0.003
    assert name == "patch" or np.abs(last.positions - first.positions).max() > 1e-3


def test_readings_are_those_of_the_positions_and_threads_light_up_where_the_sheet_is_strained():
    visitor, client = page()
    visitor.stage = stage = advanced(SceneStage("patch", HANGING), 60)
    visitor.playing, visitor.moment = False, 60
    visitor._see()
    visitor.tick()
    frame, mesh, s = stage.frame, stage.scene.mesh, stage.simulation
    x, v = s.positions[0].astype(float), s.velocities[0].astype(float)
    stretch = lengths(mesh, x) - mesh.springs.rest_length
    mass, state = stage.settings.material.density * mesh.area, s.get_state()
    elastic = 0.5 * (state.stiffness[0][mesh.springs.kind] * mesh.springs.weight) @ stretch**2
    total = 0.5 * mass @ (v**2).sum(axis=1) + elastic + 9.81 * mass @ x[:, 2]
    assert frame.readings["energy"][0] == pytest.approx(total, rel=1e-3)
    yarns = np.flatnonzero(mesh.springs.kind < 2)
    mine = (stretch / mesh.springs.rest_length)[yarns]
    assert frame.readings["strain"][0] == pytest.approx(mine.max(), rel=1e-4)
    assert f"{100 * mine.max():.2f} %" in visitor.controls["glance"].content
    # the scale fits what is shown; threads at rest are not drawn: they have no length
    shown, full = client.scene.handles["/threads0"], visitor.show.strained
    most, idle = np.argsort(mine)[-4:], mine < 0.2 * full
    assert mine.max() <= full < 2 * mine.max()
    assert np.linalg.norm(shown.points[most] - x[mesh.springs.particles[yarns[most]]], axis=2).max() < 0.0031
    assert np.array_equal(shown.colors[most], np.repeat(linear(ramp(mine[most] / full))[:, None], 2, axis=1))
    assert idle.any() and np.array_equal(shown.points[idle, 0], shown.points[idle, 1])
    # the drawn surface goes through the particles
    nodes = np.concatenate([node.vertices for name, node in client.scene.handles.items() if name.startswith("/sheet0/front")])
    assert max(np.abs(nodes - particle).max(axis=1).min() for particle in x[::7]) < 1e-6
    # at rest the two pins carry the sheet
    advanced(stage, 120)
    assert s.pulls()[0].sum(axis=0)[2] == pytest.approx(-9.81 * mass.sum(), rel=0.02)


def test_the_colors_of_pushed_idle_and_loaded_springs_are_the_scales_which_ends_at_round_numbers():
    assert np.array_equal(ramp(np.array([-2.0, 0.0, 1.0, 7.0])), RAMP[[0, 1, -1, -1]].astype(np.uint8))
    assert [round_up(value) for value in (0.39, 0.051, 0.02, 0.0)] == pytest.approx([0.4, 0.06, 0.02, 0.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"gravity": -1.0}, "gravity=-1.0"),
        ({"bend_rigidity": 2e-3}, "lower the rigidity to"),
        ({"integrator": "xpdb"}, "did you mean 'xpbd'"),
        ({"substeps": 0}, "substeps=0"),
        ({"fabric": "linen"}, "no material preset 'linen'"),
        ({"gravty": 1.0}, "did you mean 'gravity'"),
    ],
)
def test_a_wrong_setting_is_a_sentence_and_changes_nothing(changes, words):
    stage = advanced(SceneStage("patch"), 2)
    before, state = stage.settings, stage.simulation.get_state()
    with pytest.raises(ValueError, match=words):
        stage.change(**changes)
    assert stage.settings == before and np.array_equal(stage.simulation.get_state().stiffness, state.stiffness)


def test_changed_settings_continue_from_the_present_state():
    stage = advanced(SceneStage("patch", Settings(fabric="knit", friction=0.3)), 10)
    x, v, same = stage.simulation.positions, stage.simulation.velocities, stage.simulation
    stage.change(wind=3.0)
    assert stage.simulation is same
    stage.change(stretch_stiffness=60.0, gravity=5.0, substeps=30, friction=0.7)
    assert stage.simulation.substeps == 30
    stage.change(integrator="xpbd")
    other = stage.simulation
    assert other.integrator.name == "xpbd" and np.array_equal(other.positions, x) and np.array_equal(other.velocities, v)
    assert other.attached.all() and other.parameters[0, 1] == 60.0 and other.get_state().gravity[0, 2] == np.float32(-5.0)
    # another fabric brings its figures
    stage.change(fabric="denim")
    assert stage.simulation.parameters[0, :2] == pytest.approx([0.4, 1615.7])


def test_friction_reaches_the_solids_where_they_are_and_a_strain_limit_holds():
    stage = advanced(SceneStage("cape"), 6)
    places = stage.simulation.collider_positions
    stage.change(friction=0.9)
    assert np.array_equal(stage.simulation.collider_positions, places)
    assert np.all(stage.simulation.get_state().colliders[0, :, R_FRICTION] == np.float32(0.9))
    stage = advanced(SceneStage("patch", HANGING), 60)
    assert stage.frame.readings["strain"][0] > 0.2
    stage.change(strain_limit=0.1)
    assert advanced(stage, 30).frame.readings["strain"][0] < 0.11


def test_a_seed_gives_the_same_bits_and_moves_only_free_particles():
    stage = SceneStage("flag")
    runs = []
    for seed in (1, 2, 1):
        stage.reset(seed)
        runs.append(advanced(stage, 8).frame.positions)
    assert np.array_equal(runs[0], runs[2]) and not np.array_equal(runs[0], runs[1])
    scene = scene_named("patch")
    s = scene.simulation(integrator="verlet", substeps=12)
    assert s.integrator.name == "verlet" and s.substeps == 12
    begin(s, scene, seed=5)
    moved = np.abs(s.positions[0] - scene.start.astype(np.float32)).max(axis=1) > 0
    assert not moved[list(scene.anchors)].any() and moved.sum() == scene.mesh.num_particles - 2


def test_a_lathe_turns_a_closed_cylinder_of_the_right_volume():
    vertices, triangles = turned_on_a_lathe(np.array([(0, 0), (0.1, 0), (0.1, 0.3), (0, 0.3)]), segments=60)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6
    assert volume == pytest.approx(0.5 * 60 * np.sin(2 * np.pi / 60) * 0.01 * 0.3)


@pytest.mark.parametrize("change", [{"integrator": "implicit_euler"}, {"strain_limit": 0.1}, {"substeps": 200}])
def test_a_diverged_sheet_shows_an_explanation_until_a_reset(change):
    stage = SceneStage("patch", Settings(fabric="knit", substeps=4, air_drag=0.75))
    bound = stage.simulation.largest_substep()[0]
    advanced(stage, 4)
    assert f"{1e3 / 60 / 4:.3g} ms is beyond its bound of {1e3 * bound:.3g} ms" in stage.notes["burst"]
    shreds = stage.frame.positions
    assert np.isfinite(shreds).all() and np.abs(shreds).max() < 10 and np.isnan(stage.frame.readings["strain"]).all()
    stage.change(**change)
    assert np.array_equal(stage.advance().positions, shreds) and "burst" in stage.notes
    stage.change(substeps=200)
    stage.reset()
    assert np.abs(stage.frame.positions[0] - stage.scene.start).max() < 1e-6
    assert "burst" not in advanced(stage, 10).notes


def test_beyond_its_bound_an_explicit_method_is_unstable_and_another_one_coarse():
    stage = SceneStage("patch", Settings(substeps=2))
    for method, verdicts in (("rk4", ["unstable", "stable"]), ("implicit_euler", ["stable, coarse", "accurate"])):
        for substeps, verdict in zip((2, 2000), verdicts):
            stage.change(integrator=method, substeps=substeps)
            assert stage.stability().verdict == verdict


# --- the visitor's hand ---------------------------------------------------------------------------------------------------


def test_grabbed_cloth_follows_the_pointer_across_methods_and_flies_on_after_release():
    stage = advanced(SceneStage("patch", STILL), 2)
    place, up = stage.frame.positions[0, MIDDLE].astype(float), np.array([0.0, 0.0, 0.25])
    stage.grab(place + (0.004, -0.003, 0.0))  # nearest to the middle
    stage.pull(place + up)
    advanced(stage, 20)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place + up, atol=2e-3)
    # its neighbors are drawn up with it, and the pins hold
    assert stage.frame.positions[0, MIDDLE + 2, 2] > place[2] + 0.1
    pins = list(stage.scene.anchors)
    assert np.array_equal(stage.frame.positions[0, pins], stage.scene.start[pins].astype(np.float32))
    stage.change(integrator="xpbd")
    stage.pull(place + 0.8 * up)
    advanced(stage, 20)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place + 0.8 * up, atol=2e-3)
    # a sheet without pins, which nothing pulls back
    stage.simulation.release()
    advanced(stage, 30)
    thrown = stage.frame.positions[0, MIDDLE].astype(float)
    for way in np.arange(1, 6) * 0.04:
        stage.pull(thrown + (0.0, 0.0, way))
        advanced(stage, 1)
    before = stage.frame.positions[0, MIDDLE, 2]
    stage.let_go()
    advanced(stage, 2)
    assert stage.frame.positions[0, MIDDLE, 2] > before + 0.02
    assert not stage.hand.held.any() and not len(stage.held())


def test_a_pin_of_the_scene_is_dragged_along_and_taken_out_by_a_click():
    stage = advanced(SceneStage("patch", STILL), 2)
    corner = stage.scene.anchors[0]
    place, down = stage.scene.start[corner], np.array([0.0, 0.0, -1.0])
    stage.grab(place)
    stage.pull(place + (0.0, 0.0, 0.1))
    stage.let_go()
    advanced(stage, 20)
    assert np.allclose(stage.frame.positions[0, corner], place + (0.0, 0.0, 0.1), atol=1e-5)
    x = stage.frame.positions[0].astype(float)
    stage.pin(0.8 * x[corner] + 0.1 * x[corner + 1] + 0.1 * x[corner - 17] - down, down)
    assert stage.simulation.attached[0].tolist() == [False, True]


def test_a_click_pins_the_sheet_where_it_is_and_another_frees_it():
    stage = advanced(SceneStage("patch", STILL), 2)
    place, down = stage.frame.positions[0, MIDDLE].astype(float), np.array([0.0, 0.0, -1.0])
    stage.pin(place - down, down)
    advanced(stage, 1)
    stage.change(gravity=9.81)
    advanced(stage, 30)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place, atol=1e-5)
    assert np.allclose(stage.held()[2:], place, atol=1e-5) and f"pins={MIDDLE}" in link.write(stage)
    stage.pin(place - down, down)
    advanced(stage, 10)
    assert stage.frame.positions[0, MIDDLE, 2] < place[2] - 0.05


def test_a_ray_meets_the_nearest_of_the_triangles_in_its_way():
    x = np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 2), (0, 1, 2)], float)
    triangles = np.array([(0, 1, 2), (3, 4, 5)])
    assert np.allclose(hands.hit(x, triangles, np.array([0.2, 0.2, 5.0]), np.array([0.01, 0.02, -1.0])), (0.23, 0.26, 2.0))
    assert hands.hit(x, triangles, np.array([0.9, 0.9, 5.0]), np.array([0.0, 0.0, -1.0])) is None


def test_a_breath_pushes_the_cloth_along_it_and_only_where_it_goes():
    stage = advanced(SceneStage("patch", STILL), 2)
    place = stage.frame.positions[0, MIDDLE].astype(float)
    stage.blow(place - (0, 0, 1), (0.0, 0.0, 1.0))
    advanced(stage, 1)
    assert 0.1 < stage.simulation.velocities[0, MIDDLE, 2] < hands.BREATH_SPEED  # cloth is not faster than the air
    advanced(stage, 3)
    risen = stage.frame.positions[0, :, 2] - stage.scene.start[:, 2]
    assert risen[MIDDLE] > 0.03 and risen[MIDDLE] == pytest.approx(risen.max(), rel=0.2)
    assert abs(risen[0]) < 0.2 * risen[MIDDLE]


# --- episodes -------------------------------------------------------------------------------------------------------------


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
    assert stage.over and stage.advance() is stage.frame
    assert f"a success, performance {info['normalized_performance']:.2f}, return {total:.2f}" in stage.notes["evaluation"]


@pytest.mark.parametrize("env_id", ["ClothReach-v0", "ClothDrapeGripper-v0"])
def test_a_dragged_attachment_goes_to_the_visitor(env_id):
    stage = EpisodeStage(env_id, policy="noop")
    place = stage.places[0].copy()
    stage.grab(place)
    stage.pull(place + (0.0, 0.0, 0.1))
    advanced(stage, 12)
    assert np.allclose(stage.places[0], place + (0.0, 0.0, 0.1), atol=0.02)


def test_a_learned_policy_acts_in_the_environment_that_it_was_trained_in():
    still = Learnt(lambda env, x: np.zeros((1, *env.action_space.shape), np.float32), {"wind": {"speed": [2.0, 2.0]}})
    stage = EpisodeStage("ClothReach-v0", {"run": still})
    assert stage.env.task.wind is None
    stage.choose("run")
    advanced(stage, 1)
    assert np.linalg.norm(stage.simulation.get_state().wind[0]) == pytest.approx(2.0)
    assert "As run was trained, with wind=" in stage.notes["run"]


def test_runs_of_the_same_name_are_told_apart(monkeypatch, tmp_path):
    runs = pytest.importorskip("clothgym.adapters.runs")
    monkeypatch.setattr(runs, "read_config", lambda folder: {"env": "ClothReach-v0", "env_kwargs": {"seen": str(folder)}})
    monkeypatch.setattr(runs, "learned", lambda folder, env_id: None)
    folders = [str(tmp_path / "a" / "run"), str(tmp_path / "b" / "run")]
    start, found = policies_of(folders, "")
    assert start == "ClothReach-v0"
    seen = {name: policy.env_kwargs["seen"] for name, policy in found[start].items()}
    assert seen == {"run": folders[0], folders[1]: folders[1]}


def test_each_environment_and_committed_policy_is_one_entry_of_the_menu():
    gallery = Gallery()
    for env_id, learners in policies.available().items():
        assert gallery.titles[env_id] == env_id
        for learner in learners:
            # others pick and place, in steps too long to watch
            assert (f"{env_id}/{learner}" in gallery.titles.values()) == (f"learned, {learner}" in committed_policies(env_id))
    stage = gallery.open("ClothReach-v0/ppo")
    assert stage.policy == "learned, ppo" and stage.name == "ClothReach-v0/ppo"


def by_hand(race):
    """Play as the task's expert would: over the target and beyond it, down, and let go."""

    def to(goal):
        for _ in range(60):
            race.pull(goal + OFFSETS[0])
            race.advance()
            if np.abs(race.mine.places.mean(axis=0) - goal).max() < 0.02:
                return

    top, side = race.mine.env.task.episode["top"][0], race.mine.env.task.physics.side
    race.grab(race.mine.places.mean(axis=0) + OFFSETS[0])
    over = top + (0.0, 0.3 * side, 0.55 * side)
    to(over)
    to(over - (0.0, 0.0, 0.8 * side))
    race.let_go()
    race.drop()
    while not race.over:
        race.advance()


def test_a_race_is_played_by_hand_judged_and_saved_as_a_demonstration_that_plays_again(tmp_path):
    visitor, client = page("race")
    race = visitor.stage
    assert race.advance() is race.recording.frames[0]  # time waits for the visitor
    by_hand(race)
    scores = [stage.info["normalized_performance"] for stage in (race.mine, race.theirs)]
    assert min(scores) > 0.9 and f"{scores[0]:.2f} to {scores[1]:.2f}" in race.notes["evaluation"]
    # the policy plays as it does alone
    alone = EpisodeStage(race.mine.env_id, race.policies, race.policy)
    while not alone.over:
        alone.advance()
    assert np.array_equal(alone.frame.positions[0] + OFFSETS[1], race.frame.positions[1])
    visitor.controls["kind"].value = SAVED["demo"]
    visitor.controls["save"].turn()
    visitor.tick()
    (tmp_path / "mine.npz").write_bytes(client.files["race_demonstration.npz"])
    with np.load(tmp_path / "mine.npz") as saved:
        about = json.loads(str(saved["about"]))
        env = gym.make(f"clothgym:{about['env']}", **about["env_kwargs"])
        observation, _ = env.reset(seed=about["seed"])
        for seen, action, reward in zip(saved["observations"], saved["actions"], saved["rewards"]):
            assert np.array_equal(observation, seen)
            observation, given, over, _, info = env.step(action)
            assert given == reward
    assert over and info["is_success"] and about["is_success"] and about["performance"] == pytest.approx(scores[0])


def test_a_demonstration_is_of_an_environment_that_was_played(tmp_path):
    for stage in (EpisodeStage("ClothReach-v0"), SceneStage("patch")):
        with pytest.raises(ValueError, match="an environment that has been played"):
            save_demonstration(tmp_path / "a.npz", stage)


def test_names_that_are_none_are_told_with_the_nearest():
    with pytest.raises(ValueError, match="no environment 'ClothReech-v0'; did you mean 'ClothReach-v0'"):
        EpisodeStage("ClothReech-v0")
    with pytest.raises(ValueError, match="no policy 'exprt'; did you mean 'expert'"):
        EpisodeStage("ClothReach-v0", policy="exprt")
    with pytest.raises(ValueError, match="no scene 'pach'; did you mean 'patch'"):
        SceneStage("pach")


# --- the page -------------------------------------------------------------------------------------------------------------


def test_controls_turn_settings_of_this_visitor_alone_and_follow_them():
    (visitor, client), (theirs, _) = page(), page()
    controls = visitor.controls
    controls["fabric"].turn("denim")
    visitor.tick()
    assert controls["stretch_stiffness"].value == 1615.7
    for name, value in (("bend_rigidity", 20.0), ("integrator", "verlet"), ("auto", False), ("strain_limit", 5.0)):
        controls[name].turn(value)
    visitor.tick()
    settings = visitor.stage.settings
    assert (settings.bend_rigidity, settings.integrator, settings.strain_limit) == (2e-5, "verlet", 0.05)
    assert settings.substeps == visitor.stage.simulation.substeps and theirs.stage.settings == SceneStage("patch").settings
    controls["fabric"].turn("knit")
    visitor.tick()
    controls["bend_rigidity"].turn(200.0)
    visitor.tick()
    assert "lower the rigidity to" in client.notifications[-1] and controls["bend_rigidity"].value == pytest.approx(0.225)


def test_pause_step_scrub_and_reset_and_a_recording_plays_on_from_any_frame():
    visitor, _ = page("flag")
    controls = visitor.controls
    ticked(visitor, 5)
    controls["time"].turn("play / pause")
    visitor.tick()
    count = len(visitor.stage.recording.frames)
    controls["time"].turn("step")
    ticked(visitor, 2)
    assert len(visitor.stage.recording.frames) == count + 1 and not visitor.playing
    controls["seed"].value = 3
    controls["time"].turn("reset")
    visitor.tick()
    assert visitor.stage.seed == 3 and visitor.stage.frame.time == pytest.approx(2 / 60) and visitor.playing
    stage = advanced(EpisodeStage("ClothReach-v0", seed=3), 12)
    visitor, client = page(REPLAY, recording=stage.recording)
    visitor.tick()
    assert visitor.moment == 1 and visitor.controls["moment"].max == 12
    visitor.controls["moment"].turn(9)
    visitor.tick()
    shown = np.concatenate([node.vertices for name, node in client.scene.handles.items() if name.startswith("/sheet0/front")])
    assert np.abs(shown - stage.recording.frames[9].positions[0, 7]).max(axis=1).min() < 1e-6
    visitor.controls["time"].turn("play / pause")
    ticked(visitor, 9)
    assert visitor.moment == 12


def test_an_episode_is_watched_to_its_judgement():
    visitor, client = page()
    visitor.controls["scene"].turn("ClothReach-v0")
    visitor.tick()
    assert visitor.controls["policy"].visible and not visitor.controls["gravity"].visible
    assert client.notifications == [client.notifications[0]] and client.notifications[0].startswith("One moment: Opening")
    while not visitor.stage.over:
        visitor.tick()
    assert "Evaluated: a success" in visitor.controls["notes"].content and "reward: " in visitor.controls["readings"].content
    assert visitor.controls["moment"].value == len(visitor.stage.recording.frames) - 1


def test_of_several_scenes_picked_in_a_row_the_last_one_opens():
    visitor, _ = page()
    opened, kind = [], visitor.gallery.open
    visitor.gallery.open = lambda name: (opened.append(name), kind(name))[1]
    for title in ("Sheet over a box", "Flag in gusty wind", "Sheet over a sphere"):
        visitor.controls["scene"].turn(title)
    visitor.tick()
    assert opened == ["sphere"] == [visitor.stage.name]


def test_each_preset_can_be_pressed_and_after_an_explosion_nothing_is_read():
    visitor, client = page()
    for label in PRESETS:
        visitor.controls["presets"].turn(label)
        visitor.tick()
    assert visitor.stage.name == "race" and not [said for said in client.notifications if "One moment" not in said]
    visitor.controls["presets"].turn("make it explode")
    visitor.tick()
    for _ in range(100):
        visitor.tick()
    visitor._read_at, visitor._stale = -1.0, True
    visitor.tick()
    assert "burst: its substep of 4.17 ms is beyond its bound" in visitor.controls["notes"].content
    assert "| largest stretch | – |" in visitor.controls["readings"].content
    visitor.controls["presets"].turn("start again")
    visitor.tick()
    assert visitor.stage.settings == SceneStage("patch").settings and not visitor.stage.notes


def test_a_drag_a_click_and_a_shift_click_on_the_page_reach_the_cloth():
    visitor, client = page()
    visitor._change({"wind": 0.0, "gust": 0.0})
    visitor.tick()
    place = visitor.stage.frame.positions[0, MIDDLE].astype(float)
    node = client.scene.handles["/sheet0/back1"]
    node.drag("start", tuple(place), tuple(place))
    node.drag("update", tuple(place), tuple(place + (0, 0, 0.2)))
    ticked(visitor, 20)
    assert np.allclose(visitor.stage.frame.positions[0, MIDDLE], place + (0, 0, 0.2), atol=2e-3)
    node.drag("end", tuple(place), tuple(place + (0, 0, 0.2)))
    inner = visitor.stage.frame.positions[0, 40].astype(float)
    client.scene.click(tuple(inner + (0, 0, 1.0)), (0.0, 0.0, -1.0))
    ticked(visitor, 2)
    assert "pins=40" in link.write(visitor.stage)
    client.scene.click(tuple(place + (0, 0, 1.0)), (0.0, 0.0, -1.0), "shift")
    visitor.tick()
    assert visitor.stage._breath is not None
    # the menu turns it around, for a finger that has no shift key
    visitor.controls["click"].value, visitor.stage._breath = CLICKS[1], None
    client.scene.click(tuple(place + (0, 0, 1.0)), (0.0, 0.0, -1.0))
    visitor.tick()
    assert visitor.stage._breath is not None and not client.notifications


def test_files_contain_the_displayed_frames(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    visitor, client = page("flag")
    ticked(visitor, 3)
    visitor.playing = False
    for kind in ("png", "gif", "obj", "glb", "npz"):
        visitor.controls["kind"].value = SAVED[kind]
        visitor.controls["save"].turn()
        visitor.tick()
    assert set(client.files) == {"flag.png", "flag.gif", "flag_obj.zip", "flag.glb", "flag.npz"}
    for name, content in client.files.items():
        (tmp_path / name).write_bytes(content)
    assert len(trimesh.load(tmp_path / "flag.glb", process=False).geometry) == 2  # the sheet, and its pole
    with zipfile.ZipFile(tmp_path / "flag_obj.zip") as archive:
        archive.extractall(tmp_path)
        assert len([name for name in archive.namelist() if name.endswith(".obj")]) == 4
    mesh = trimesh.load(tmp_path / "frame_00003.obj", process=False, split_object=True, group_material=False)
    cloth = next(iter(mesh.geometry.values())) if hasattr(mesh, "geometry") else mesh
    shown = visitor.stage.recording.frames[3].positions[0]
    assert np.array_equal(cloth.vertices[: len(shown)].astype(np.float32), shown)
    assert len(Recording.load(tmp_path / "flag.npz").frames) == 4


def test_a_policy_that_raises_is_told_on_the_page_which_goes_on(capsys):
    def fail(env, observation):
        raise RuntimeError("no weights")

    visitor, client = page("ClothReach-v0", policies={"ClothReach-v0": {"broken": fail}})
    ticked(visitor, 2)
    assert not visitor.playing and len(client.notifications) == 1
    assert "RuntimeError, no weights" in client.notifications[0] and "no weights" in capsys.readouterr().err
    visitor.controls["policy"].turn("noop")
    visitor.controls["time"].turn("play / pause")
    visitor.tick()
    assert len(visitor.stage.recording.frames) == 2


def test_a_visit_that_fails_tells_its_visitor_and_ends_alone(monkeypatch, capsys):
    def fail(page):
        raise RuntimeError("a thread broke")

    monkeypatch.setattr(Page, "tick", fail)
    client = NullClient()
    visit = Visit(client, Gallery(), "patch")
    visit.thread.join(30)
    assert not visit.thread.is_alive()
    assert client.notifications[-1].startswith("This page has stopped") and "a thread broke" in capsys.readouterr().err


def test_a_link_restores_its_page():
    visitor, _ = page("flag")
    for name, value in (("gravity", 3.0), ("fabric", "denim"), ("integrator", "verlet"), ("strain_limit", 5.0)):
        visitor.controls[name].turn(value)
    visitor.controls["seed"].value = 7
    visitor.controls["time"].turn("reset")
    visitor.tick()
    visitor.stage.pin_particle(12)
    visitor.tick()
    told = link.write(visitor.stage)
    other, client = page(asked=told)
    other.tick()
    assert other.stage.settings == visitor.stage.settings and other.stage.seed == 7 and told.count("pins=12") == 1
    assert not [said for said in client.notifications if "Not possible" in said]
    assert other.controls["link"].value == f"http://here/?{told}" == f"http://here/?{link.write(other.stage)}"


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("scene=nowhere", "is not shown here"),
        ("gravity=heavy", "The link is not understood"),
        ("gravity=-4", "gravity=-4.0"),
        ("pins=99999", "the particles of this sheet are 0 to 288"),
    ],
)
def test_a_link_that_makes_no_sense_is_told_and_the_page_opens_as_always(query, words):
    visitor, client = page(asked=query)
    visitor.tick()
    assert words in "".join(client.notifications) and visitor.stage.settings == SceneStage("patch").settings
