"""The playground without a browser: stages, what a visitor's hand does, and the page with a browser that shows nothing."""

import json
import zipfile

import gymnasium as gym
import numpy as np
import pytest
from stages import NullClient, advanced, page, ticked, turned

from clothgym import policies
from clothgym.collisions.solids.shapes import R_FRICTION
from clothgym.playground import hands, link
from clothgym.playground.controls import AGAIN, CLICKS, PRESETS
from clothgym.playground.episode import OFFSETS, EpisodeStage, Learnt
from clothgym.playground.exporting import save_demonstration, strain_shares
from clothgym.playground.gallery import REPLAY, Gallery, committed_policies, policies_of
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording
from clothgym.playground.scenes import SCENES, Settings, begin, scene_named, titled, turned_on_a_lathe
from clothgym.playground.server import Visit
from clothgym.playground.stage import SceneStage

MIDDLE = 544  # of the patch's 33 x 33 particles
STILL = Settings(gravity=0.0, fabric="knit", air_drag=0.75, self_collision="off")
HANGING = Settings(fabric="knit", air_drag=0.75, self_collision="off")


VIEW = [[1.0, -1.0, 1.0], [0.0, 0.0, 0.5], 35.0]


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


def test_readings_and_what_the_browser_draws_are_those_of_the_positions():
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
    mine = (stretch / mesh.springs.rest_length)[mesh.springs.kind < 2]
    assert frame.readings["strain"][0] == pytest.approx(mine.max(), rel=1e-4)
    assert client.controls["strain"]["value"] == f"{100 * mine.max():.1f} %"
    # the sheet to the bit, where it is held, and the colors of its fabric, whose scale is the scene's own
    assert np.array_equal(client.sheets[0], x.astype(np.float32)) and client.opened["strain_shown"] == 0.1
    assert np.array_equal(client.places[1], stage.scene.start[list(stage.scene.anchors)].astype(np.float32))
    assert client.look["front"] == (70, 136, 70)
    # at rest the two pins carry the sheet
    advanced(stage, 120)
    assert s.pulls()[0].sum(axis=0)[2] == pytest.approx(-9.81 * mass.sum(), rel=0.03)


def test_solids_are_told_once_and_where_they_are_in_each_frame():
    visitor, client = page("cape")
    ticked(visitor, 3)
    stage = visitor.stage
    assert [solid["kind"] for solid in client.solids] == ["capsule"] * 5 + ["sphere"]
    assert np.allclose(client.places[0], stage.simulation.collider_positions[0, 1:], atol=1e-6)
    # the feet stand on the floor, and no part of the figure is in the sheet
    assert min(at[2] - solid["half"][2] - solid["radius"] for at, solid in zip(client.places[0], client.solids)) > -0.01
    # what goes leaves a place that is empty, and takes it when it comes back
    show, frame = visitor.show, stage.frame
    for solids, there in ((frame.solids[1:], 5), (frame.solids, 6)):
        new, drawn = show.draw(type(frame)(0.0, frame.positions, solids), np.zeros((0, 3)))
        places = np.frombuffer(drawn, "<f4")[2 + frame.positions.size :].reshape(-1, 3)
        assert new == [] and len(places) == 6 and np.isfinite(places).all(axis=1).sum() == there


def test_a_gathered_sheet_is_as_long_as_at_rest_and_three_quarters_as_wide():
    scene = scene_named("patch")
    left, right = (scene.start[k] for k in scene.anchors)
    assert np.linalg.norm(right - left) == pytest.approx(0.75 * 0.6, rel=1e-3)
    stretch = lengths(scene.mesh, scene.start) / scene.mesh.springs.rest_length
    assert stretch[scene.mesh.springs.kind < 2] == pytest.approx(1.0, abs=0.02)


def test_every_name_that_a_visitor_reads_is_in_words():
    visitor, client = page()
    visitor.tick()
    titles = [title for one in client.controls.values() for _, title in one["options"]]
    labels = [one["label"] for one in client.controls.values()]
    assert len(titles) > 70 and not [text for text in titles + labels if "_" in text]
    assert titled("penava_cotton") == "Cotton" and titled("learned, bc_ppo") == "Learned: behavior cloning, then PPO"


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
    stage = SceneStage("patch", Settings(fabric="knit", substeps=4, air_drag=0.75, self_collision="off"))
    bound = stage.simulation.largest_substep()[0]
    while "burst" not in stage.notes:
        stage.advance()
    assert f"{1e3 / 60 / 4:.3g} ms is beyond its bound of {1e3 * bound:.3g} ms" in stage.notes["burst"]
    first = stage.frame.positions
    assert not stage.over and np.isnan(stage.frame.readings["strain"]).all()
    # its shreds fly apart over a second, slower and slower
    advanced(stage, 28)
    assert not stage.over
    shreds = stage.advance().positions
    assert stage.over and np.isfinite(shreds).all() and np.abs(shreds - first).max() < 0.4
    ways = [np.abs(b.positions - a.positions).max() for a, b in zip(stage.recording.frames[-25:], stage.recording.frames[-24:])]
    assert ways[0] > 2 * ways[-1] > 0
    stage.change(**change)
    assert np.array_equal(stage.advance().positions, shreds) and "burst" in stage.notes
    stage.begin_again()
    assert stage.settings.substeps == "auto"
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
    assert stage.frame.positions[0, MIDDLE + 4, 2] > place[2] + 0.1
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
    place = stage.scene.start[corner]
    stage.grab(place)
    stage.pull(place + (0.0, 0.0, 0.1))
    stage.let_go()
    advanced(stage, 20)
    assert np.allclose(stage.frame.positions[0, corner], place + (0.0, 0.0, 0.1), atol=1e-5)
    x = stage.frame.positions[0].astype(float)
    stage.pin(0.8 * x[corner] + 0.1 * x[corner + 1] + 0.1 * x[corner - 33])
    assert stage.simulation.attached[0].tolist() == [False, True]


def test_a_click_pins_the_sheet_where_it_is_and_another_frees_it():
    stage = advanced(SceneStage("patch", STILL), 2)
    place = stage.frame.positions[0, MIDDLE].astype(float)
    stage.pin(place)
    advanced(stage, 1)
    stage.change(gravity=9.81)
    advanced(stage, 30)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place, atol=1e-5)
    assert np.allclose(stage.held()[2:], place, atol=1e-5) and f"pins={MIDDLE}" in link.write(stage)
    stage.pin(place)
    advanced(stage, 10)
    assert stage.frame.positions[0, MIDDLE, 2] < place[2] - 0.05


def test_a_breath_pushes_the_cloth_along_it_and_only_where_it_goes():
    stage = advanced(SceneStage("patch", STILL), 2)
    place = stage.frame.positions[0, MIDDLE].astype(float)
    stage.blow(place, (0.0, 0.0, 1.0))
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
    told = f"Success: a score of {info['normalized_performance']:.2f}, and a return of {total:.2f}."
    assert stage.notes["evaluation"] == told


def test_a_sheet_of_another_size_is_shown_as_one_that_is_not_stretched():
    visitor, client = page("ClothFoldShirt-Hard-v0")
    widths = []
    for seed in (1, 2):
        turned(visitor, seed=seed, play="reset")
        recording, sheet = visitor.stage.recording, client.sheets[0]
        # the browser measures strain between the flat sheet's points that it was told
        flat, triangles = np.reshape(client.opened["uv"], (-1, 2)), np.reshape(client.opened["triangles"], (-1, 3))
        now, rest = (np.linalg.norm(x[triangles[:, 0]] - x[triangles[:, 1]], axis=1) for x in (sheet, flat))
        assert np.median(np.abs(now / rest - 1)) < 1e-3  # at seams the layers are apart
        assert strain_shares(recording, sheet).max() < 0.2
        widths.append(recording.mesh.size[0])
    assert abs(widths[1] - widths[0]) > 0.01


@pytest.mark.parametrize("env_id", ["ClothReach-v0", "ClothDrapeGripper-v0"])
def test_a_dragged_attachment_goes_to_the_visitor(env_id):
    stage = EpisodeStage(env_id, policy="noop")
    place = stage.places[0].copy()
    stage.grab(place)
    stage.pull(place + (0.0, 0.0, 0.1))
    advanced(stage, 12)
    assert np.allclose(stage.places[0], place + (0.0, 0.0, 0.1), atol=0.02)


def test_a_dragged_attachment_goes_to_the_visitor_when_the_policy_acts_in_another_frame():
    still = Learnt(lambda env, x: np.zeros((1, *env.action_space.shape), np.float32), {"frame": "task"})
    stage = EpisodeStage("ClothFold-v0", {"still": still}, "still")
    assert abs(stage.env.task.heading()[0, 1]) > 0.1  # the sheet lies turned
    place = stage.places[0].copy()
    stage.grab(place)
    stage.pull(place + (0.1, 0.0, 0.1))
    advanced(stage, 12)
    assert np.allclose(stage.places[0], place + (0.1, 0.0, 0.1), atol=0.02)


def test_a_learned_policy_acts_in_the_environment_that_it_was_trained_in():
    still = Learnt(lambda env, x: np.zeros((1, *env.action_space.shape), np.float32), {"wind": {"speed": [2.0, 2.0]}})
    stage = EpisodeStage("ClothReach-v0", {"run": still})
    assert stage.env.task.wind is None
    stage.choose("run")
    advanced(stage, 1)
    assert np.linalg.norm(stage.simulation.get_state().wind[0]) == pytest.approx(2.0)
    assert "As Run was trained, with wind=" in stage.notes["run"]


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
    assert min(scores) > 0.9 and f"you score {scores[0]:.2f}, the policy {scores[1]:.2f}." in race.notes["evaluation"]
    # the policy plays as it does alone
    alone = EpisodeStage(race.mine.env_id, race.policies, race.policy)
    while not alone.over:
        alone.advance()
    assert np.array_equal(alone.frame.positions[0] + OFFSETS[1], race.frame.positions[1])
    turned(visitor, kind="demo", save=VIEW)
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
    told = client.controls
    turned(visitor, fabric="denim")
    assert told["stretch_stiffness"]["value"] == 1615.7 and client.look["front"] == (46, 68, 122)
    turned(visitor, bend_rigidity=20.0, integrator="verlet", auto=False, strain_limit=5.0)
    settings = visitor.stage.settings
    assert (settings.bend_rigidity, settings.integrator, settings.strain_limit) == (2e-5, "verlet", 0.05)
    assert settings.substeps == visitor.stage.simulation.substeps and theirs.stage.settings == SceneStage("patch").settings
    # nobody is told what they have just turned themselves
    told["gravity"]["value"] = "theirs"
    turned(visitor, gravity=2.0)
    assert told["gravity"]["value"] == "theirs" and visitor.stage.settings.gravity == 2.0
    turned(visitor, fabric="knit")
    turned(visitor, bend_rigidity=200.0)
    assert "lower the rigidity to" in client.said[-1][1] and 0.05 < told["bend_rigidity"]["value"] < 20


def test_pause_step_scrub_and_reset_and_a_recording_plays_on_from_any_frame():
    visitor, client = page("flag")
    ticked(visitor, 5)
    turned(visitor, play="play")
    assert client.controls["play"]["value"] == "paused"
    count = len(visitor.stage.recording.frames)
    turned(visitor, play="step")
    ticked(visitor, 2)
    assert len(visitor.stage.recording.frames) == count + 1 and not visitor.playing
    turned(visitor, seed=3, play="reset")
    assert visitor.stage.seed == 3 and visitor.stage.frame.time == pytest.approx(2 / 60) and visitor.playing
    stage = advanced(EpisodeStage("ClothReach-v0", seed=3), 12)
    visitor, client = page(REPLAY, recording=stage.recording)
    visitor.tick()
    assert visitor.moment == 1 and client.controls["moment"]["high"] == 12
    turned(visitor, moment=9)
    assert np.array_equal(client.sheets, stage.recording.frames[9].positions)
    turned(visitor, play="play")
    ticked(visitor, 8)
    assert visitor.moment == 12 and client.controls["play"]["value"] == "over"
    # and begins again by itself
    ticked(visitor, round(2.0 / stage.recording.time_step) + 2)
    assert visitor.moment < 12


def test_an_episode_is_watched_to_its_judgement_and_another_begins():
    visitor, client = page()
    turned(visitor, scene="ClothReach-v0")
    assert client.controls["policy"]["visible"] and not client.controls["gravity"]["visible"]
    assert client.waits[0].startswith("Opening ClothReach-v0") and client.waits[-1] == "" and not client.said
    while not visitor.stage.over:
        visitor.tick()
    assert client.controls["verdict"]["value"][-1][1].startswith("Success: a score of ")
    assert any(row[0].startswith("Reward: ") for row in client.controls["readings"]["value"])
    assert client.controls["moment"]["value"] == len(visitor.stage.recording.frames) - 1
    waited = 0
    while visitor.stage.over:
        visitor.tick()
        waited += 1
    assert waited * visitor.stage.recording.time_step == pytest.approx(4.0, abs=0.1)
    assert visitor.stage.seed == 1 == client.controls["seed"]["value"] and not client.controls["verdict"]["value"]


def test_of_several_scenes_picked_in_a_row_the_last_one_opens():
    visitor, _ = page()
    opened, kind = [], visitor.gallery.open
    visitor.gallery.open = lambda name: (opened.append(name), kind(name))[1]
    turned(visitor, scene="box")
    for name in ("box", "flag", "sphere"):
        visitor.take(["turn", ["scene", name]])
    visitor.tick()
    assert opened == ["box", "sphere"] and visitor.stage.name == "sphere"


def test_each_preset_can_be_pressed_and_after_an_explosion_nothing_is_read():
    visitor, client = page()
    for label in PRESETS:
        turned(visitor, presets=label)
    assert visitor.stage.name == "race" and not client.said
    turned(visitor, presets="Make it explode")
    while "burst" not in visitor.stage.notes:
        visitor.tick()
    visitor._read_at, visitor._stale = -1.0, True
    visitor.tick()
    ((subject, words),) = client.controls["verdict"]["value"]
    assert subject == "burst" and words.startswith("Semi-implicit Euler burst: its substep of 4.17 ms is beyond its bound")
    assert ["Largest stretch", "–"] in client.controls["readings"]["value"] and client.controls["strain"]["value"] == "–"
    turned(visitor, presets=AGAIN)
    assert visitor.stage.settings == SceneStage("patch").settings and not visitor.stage.notes


def test_a_drag_a_click_and_a_shift_click_on_the_page_reach_the_cloth():
    visitor, client = page()
    visitor._change({"wind": 0.0, "gust": 0.0})
    visitor.tick()
    place = visitor.stage.frame.positions[0, MIDDLE].astype(float)
    visitor.take(["grasp", ["start", place.tolist()]])
    visitor.take(["grasp", ["update", (place + (0, 0, 0.2)).tolist()]])
    ticked(visitor, 20)
    assert np.allclose(visitor.stage.frame.positions[0, MIDDLE], place + (0, 0, 0.2), atol=2e-3)
    assert np.allclose(client.places[1][-1], place + (0, 0, 0.2), atol=2e-3)
    visitor.take(["grasp", ["end", place.tolist()]])
    inner = visitor.stage.frame.positions[0, 140].tolist()
    visitor.take(["touch", [False, inner, [0.0, 0.0, -1.0]]])
    ticked(visitor, 2)
    assert "pins=140" in link.write(visitor.stage)
    visitor.take(["touch", [True, inner, [0.0, 0.0, -1.0]]])
    visitor.tick()
    assert visitor.stage._breath is not None
    # the menu turns it around, for a finger that has no shift key
    visitor.stage._breath = None
    turned(visitor, click=CLICKS[1])
    visitor.take(["touch", [False, inner, [0.0, 0.0, -1.0]]])
    visitor.tick()
    assert visitor.stage._breath is not None and not client.said


def test_files_contain_the_displayed_frames(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    visitor, client = page("flag")
    ticked(visitor, 3)
    visitor.playing = False
    for kind in ("png", "gif", "obj", "glb", "npz"):
        turned(visitor, kind=kind, save=VIEW)
    assert set(client.files) == {"flag.png", "flag.gif", "flag_obj.zip", "flag.glb", "flag.npz"} and client.waits[-1] == ""
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
    loaded = Recording.load(tmp_path / "flag.npz")
    assert len(loaded.frames) == 4 and loaded.fabric == "silk"


def test_a_policy_that_raises_is_told_on_the_page_which_goes_on(capsys):
    def fail(env, observation):
        raise RuntimeError("no weights")

    visitor, client = page("ClothReach-v0", policies={"ClothReach-v0": {"broken": fail}})
    ticked(visitor, 2)
    assert not visitor.playing and len(client.said) == 1
    assert "RuntimeError, no weights" in client.said[0][1] and "no weights" in capsys.readouterr().err
    turned(visitor, policy="noop", play="play")
    assert len(visitor.stage.recording.frames) == 2


def test_a_visit_that_fails_tells_its_visitor_and_ends_alone(monkeypatch, capsys):
    def fail(page):
        raise RuntimeError("a thread broke")

    monkeypatch.setattr(Page, "tick", fail)
    client = NullClient()
    visit = Visit(client, Gallery(), "patch")
    visit.thread.join(30)
    assert not visit.thread.is_alive()
    assert client.said[-1][0] == "This page has stopped" and "a thread broke" in capsys.readouterr().err


def test_a_link_restores_its_page():
    visitor, _ = page("flag")
    turned(visitor, gravity=3.0, fabric="denim", integrator="verlet", strain_limit=5.0, seed=7, play="reset")
    visitor.stage.pin_particle(12)
    visitor.tick()
    told = link.write(visitor.stage)
    other, client = page(asked=told)
    other.tick()
    assert other.stage.settings == visitor.stage.settings and other.stage.seed == 7 and told.count("pins=12") == 1
    assert not client.said
    assert client.controls["link"]["value"] == f"http://here/?{told}" == f"http://here/?{link.write(other.stage)}"
