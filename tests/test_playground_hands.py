"""What a visitor's hand does: on stages, and on a page in a viewer that shows nothing; test_page.py has a browser."""

import json

import gymnasium as gym
import numpy as np
import pytest
from stages import advanced, page

from clothgym.playground import demonstrations, hands, link, readings, server
from clothgym.playground.colors import FABRICS, Scale, round_up
from clothgym.playground.controls import CLICKS
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.judgement import judgement
from clothgym.playground.page import Page
from clothgym.playground.presets import PRESETS
from clothgym.playground.race import Race
from clothgym.playground.stage import SceneStage
from clothgym.playground.world import Settings

MIDDLE = 144  # of the patch's 17 x 17 particles
STILL = Settings(gravity=0.0, fabric="knit", air_drag=0.75)


# --- holding, throwing, pinning -------------------------------------------------------------------------------------------


def test_what_is_grabbed_follows_the_pointer_and_flies_on_when_it_is_let_go():
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
    # a sheet without pins, which nothing pulls back
    stage.hold(0, False)
    stage.hold(1, False)
    advanced(stage, 30)
    thrown = stage.frame.positions[0, MIDDLE].astype(float)
    for way in np.arange(1, 6) * 0.04:
        stage.pull(thrown + (0.0, 0.0, way))
        advanced(stage, 1)
    before = stage.frame.positions[0, MIDDLE, 2]
    stage.let_go()
    advanced(stage, 2)
    assert stage.frame.positions[0, MIDDLE, 2] > before + 0.02
    assert not stage.sheets[0].hand.held.any() and not len(stage.pinned())


def test_the_hand_goes_on_holding_in_another_method_and_ends_with_a_reset():
    stage = advanced(SceneStage("patch", STILL), 2)
    place = stage.frame.positions[0, MIDDLE].astype(float)
    stage.grab(place)
    stage.pull(place + (0.1, 0.0, 0.1))
    advanced(stage, 10)
    stage.change(integrator="xpbd")
    stage.pull(place + (0.0, 0.0, 0.2))
    advanced(stage, 20)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place + (0.0, 0.0, 0.2), atol=2e-3)
    stage.reset()
    assert not stage.sheets[0].hand.held.any() and np.abs(stage.frame.positions[0] - stage.scene.start).max() < 1e-6


def test_a_click_pins_the_sheet_where_it_is_and_another_frees_it():
    stage = advanced(SceneStage("patch", STILL), 2)
    place, down = stage.frame.positions[0, MIDDLE].astype(float), np.array([0.0, 0.0, -1.0])
    stage.pin(place - down, down)
    advanced(stage, 1)
    stage.change(gravity=9.81)
    advanced(stage, 30)
    assert np.allclose(stage.frame.positions[0, MIDDLE], place, atol=1e-5)
    assert np.allclose(stage.pinned(), place, atol=1e-5) and link.pinned(stage.sheets[0]) == [MIDDLE]
    stage.pin(place - down, down)
    advanced(stage, 10)
    assert stage.frame.positions[0, MIDDLE, 2] < place[2] - 0.05
    # the scene's own pins can be taken out, too
    corner = stage.scene.start[stage.scene.anchors[0]]
    stage.pin(corner - down, down + (0.003, -0.003, 0))
    assert [attachment.holds for attachment in stage.attachments()] == [False, True]


def test_a_ray_meets_the_nearest_of_the_triangles_in_its_way():
    x = np.array([(0, 0, 1), (1, 0, 1), (0, 1, 1), (0, 0, 2), (1, 0, 2), (0, 1, 2)], float)
    triangles = np.array([(0, 1, 2), (3, 4, 5)])
    where, away = hands.hit(x, triangles, np.array([0.2, 0.2, 5.0]), np.array([0.01, 0.02, -1.0]))
    assert np.allclose(where, (0.23, 0.26, 2.0)) and away == pytest.approx(3.0)
    assert hands.hit(x, triangles, np.array([0.9, 0.9, 5.0]), np.array([0.0, 0.0, -1.0])) is None


def test_a_breath_pushes_the_cloth_along_it_and_only_where_it_goes():
    stage = advanced(SceneStage("patch", STILL), 2)
    place = stage.frame.positions[0, MIDDLE].astype(float)
    stage.blow(place - (0, 0, 1), (0.0, 0.0, 1.0))
    advanced(stage, 1)
    assert 0.1 < stage.sheets[0].simulation.velocities[0, MIDDLE, 2] < hands.BREATH_SPEED  # cloth is not faster than the air
    advanced(stage, 3)
    risen = stage.frame.positions[0, :, 2] - stage.scene.start[:, 2]
    assert risen[MIDDLE] > 0.03 and risen[MIDDLE] == pytest.approx(risen.max(), rel=0.2)
    assert abs(risen[0]) < 0.2 * risen[MIDDLE]


def test_all_compared_sheets_are_held_alike():
    stage = advanced(SceneStage("patch", STILL, compared=("silk", "denim")), 2)
    place = stage.frame.positions[1, MIDDLE].astype(float)
    stage.grab(place)
    stage.pull(place + (0, 0, 0.1))
    advanced(stage, 20)
    for k in range(2):
        assert np.allclose(stage.frame.positions[k, MIDDLE] - stage.offsets[k], place - stage.offsets[1] + (0, 0, 0.1), atol=2e-3)


def test_compared_fabrics_are_of_their_own_stuff_and_color_whatever_changes():
    visitor, client = page()
    visitor.controls["presets"].turn("silk and denim")
    visitor.tick()
    assert visitor.stage.name == "flag" and visitor.stage.compared == ("silk", "denim")
    visitor.controls["gravity"].turn(5.0)
    visitor.tick()
    silk, denim = (sheet.simulation for sheet in visitor.stage.sheets)
    assert silk.parameters[0, 0] == pytest.approx(0.083) and denim.parameters[0, 0] == pytest.approx(0.4)
    assert {one.get_state().gravity[0, 2] for one in (silk, denim)} == {np.float32(-5.0)}
    assert [client.scene.handles[f"/sheet{k}/front0"].color for k in range(2)] == [FABRICS["silk"][0], FABRICS["denim"][0]]
    with pytest.raises(ValueError, match="integrators or fabrics, not both"):
        visitor.stage.compare(("silk", "xpbd"))


# --- the page -------------------------------------------------------------------------------------------------------------


def test_a_drag_a_click_and_a_shift_click_on_the_page_reach_the_cloth():
    visitor, client = page()
    visitor._change({"wind": 0.0, "gust": 0.0})
    visitor.tick()
    place = visitor.stage.frame.positions[0, MIDDLE].astype(float)
    node = client.scene.handles["/sheet0/back1"]
    node.drag("start", tuple(place), tuple(place))
    node.drag("update", tuple(place), tuple(place + (0, 0, 0.2)))
    for _ in range(20):
        visitor.tick()
    assert np.allclose(visitor.stage.frame.positions[0, MIDDLE], place + (0, 0, 0.2), atol=2e-3)
    node.drag("end", tuple(place), tuple(place + (0, 0, 0.2)))
    inner = visitor.stage.frame.positions[0, 40].astype(float)
    client.scene.click(tuple(inner + (0, 0, 1.0)), (0.0, 0.0, -1.0))
    visitor.tick()
    visitor.tick()
    assert link.pinned(visitor.stage.sheets[0]) == [40]
    client.scene.click(tuple(place + (0, 0, 1.0)), (0.0, 0.0, -1.0), "shift")
    visitor.tick()
    assert visitor.stage._breath is not None
    # the menu turns it around, for a finger that has no shift key
    visitor.controls["click"].value = CLICKS[1]
    visitor.stage._breath = None
    client.scene.click(tuple(place + (0, 0, 1.0)), (0.0, 0.0, -1.0))
    visitor.tick()
    assert visitor.stage._breath is not None and not client.notifications


@pytest.mark.parametrize("value", [float("nan"), float("inf"), 1e300])
def test_a_drag_or_a_click_to_nowhere_moves_nothing_to_nowhere(value):
    visitor, client = page()
    visitor.tick()
    place = visitor.stage.frame.positions[0, MIDDLE].astype(float)
    node = client.scene.handles["/sheet0/front0"]
    for phase in ("start", "update", "end"):
        node.drag(phase, (value,) * 3, (value,) * 3)
        node.drag(phase, tuple(place), (0.0, value, 0.0))
    client.scene.click((value,) * 3, (0.0, 0.0, -1.0))
    client.scene.click(tuple(place), (value,) * 3, "shift")
    for _ in range(5):
        visitor.tick()
    assert np.isfinite(visitor.stage.frame.positions).all() and not visitor.stage.sheets[0].burst


def test_after_an_explosion_nothing_is_read_and_what_happened_stands_over_the_cloth():
    visitor, client = page()
    visitor.controls["presets"].turn("make it explode")
    while "burst" not in visitor.stage.notes:
        visitor.tick()
    visitor._read_at = -1.0
    visitor._stale = True
    visitor.tick()
    table = visitor.controls["readings"].content
    assert f"| largest stretch | {readings.NOTHING} |" in table and f"| energy | {readings.NOTHING} |" in table
    assert "0.00" not in table and visitor.controls["glance"].content == "The sheet has burst."
    said = client.scene.handles["/said"]
    assert "burst: its substep of 4.17 ms is beyond its bound" in said.value.replace("\n", " ")
    assert said.position[2] > visitor.stage.frame.positions[0, :, 2].max()
    assert max(map(len, said.value.splitlines())) <= 52
    visitor.controls["presets"].turn("start again")
    visitor.tick()
    assert visitor.stage.settings == SceneStage("patch").settings and "/said" not in client.scene.handles


def test_of_several_scenes_picked_in_a_row_the_last_one_opens_and_nothing_old_is_read():
    visitor, _ = page()
    visitor.tick()
    opened, kind, seen = [], visitor._open_stage, []

    def opening(name):
        opened.append(name)
        seen.append([visitor.controls[one].content for one in ("glance", "readings")] + [visitor.controls["working"].visible])
        return kind(name)

    visitor._open_stage = opening
    for title in ("Sheet over a box", "Flag in gusty wind", "Sheet over a sphere"):
        visitor.controls["scene"].turn(title)
    visitor.tick()
    assert opened == ["sphere"] == [visitor.stage.name] and seen == [["", "", True]]
    assert not visitor.controls["working"].visible and visitor.controls["glance"].content


def test_five_controls_and_the_presets_are_in_sight_and_each_preset_can_be_pressed():
    visitor, client = page()
    for label in PRESETS:
        visitor.controls["presets"].turn(label)
        visitor.tick()
    assert visitor.stage.name == "race" and not [said for said in client.notifications if "Not possible" in said]
    # of eight, since the viewer that shows nothing keeps handles by their labels, and a button is called "Save", too
    shut = [handle for handle in client.gui.handles.values() if handle.kind == "folder" and handle.content is not None]
    assert len(shut) == 7 and not any(handle.expand_by_default for handle in shut)


def test_the_scale_fits_what_is_shown():
    assert [round_up(value) for value in (0.39, 0.051, 0.02, 0.0)] == pytest.approx([0.4, 0.06, 0.02, 0.0])
    stage = advanced(SceneStage("patch", Settings(fabric="knit", air_drag=0.75)), 60)
    scale = Scale(0.08)
    scale.fit(stage.recording, stage.frame)
    largest = stage.frame.readings["strain"][0]
    assert largest <= scale.strained < 1.5 * largest
    small = stage.recording.frames[0]
    for _ in range(60):
        scale.fit(stage.recording, small)
    assert scale.strained < 0.01


def test_no_number_is_minus_zero():
    assert [readings.signed(value) for value in (-1e-6, 0.0, -0.00006, 0.5)] == ["0", "0", "-0.0001", "+0.5000"]


# --- episodes -------------------------------------------------------------------------------------------------------------


def by_hand(race):
    """Play as the task's expert would: over the target and beyond it, down, and let go."""

    def to(goal):
        for _ in range(60):
            race.pull(goal + race._offsets[0])
            race.advance()
            if np.abs(np.mean([one.position for one in race.mine.attachments()], axis=0) - goal).max() < 0.02:
                return

    top, side = race.mine.env.task.episode["top"][0], race.mine.env.task.physics.side
    race.grab(np.mean([one.position for one in race.mine.attachments()], axis=0) + race._offsets[0])
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
    assert isinstance(race, Race) and race.advance() is race.recording.frames[0]  # time waits for the visitor
    by_hand(race)
    scores = [stage.info["normalized_performance"] for stage in (race.mine, race.theirs)]
    assert min(scores) > 0.9 and f"{scores[0]:.2f} to {scores[1]:.2f}" in race.notes["evaluation"]
    assert "Yours: Evaluated: a success" in race.notes["evaluation"]
    # the policy plays as it does alone
    alone = EpisodeStage(race.mine.env_id, race.policies, race.policy)
    while not alone.over:
        alone.advance()
    assert np.array_equal(alone.frame.positions[0] + race._offsets[1], race.frame.positions[1])
    visitor.controls["kind"].value = "demonstration (NPZ)"
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


def test_a_demonstration_is_of_an_environment_as_it_is(tmp_path):
    stage = EpisodeStage("ClothReach-v0", policy="noop")
    with pytest.raises(ValueError, match="nothing has been played yet"):
        demonstrations.save(tmp_path / "a.npz", stage)
    stage.change(gravity=1.0)
    advanced(stage, 1)
    with pytest.raises(ValueError, match="a setting has been changed"):
        demonstrations.save(tmp_path / "a.npz", stage)


def test_an_episode_without_success_ends_with_what_was_missed():
    stage = EpisodeStage("ClothDrape-v0", policy="noop")
    while not stage.over:
        stage.advance()
    words = stage.notes["evaluation"]
    assert "no success" in words and "it covers 0%, 90% is enough" in words and "off center" in words
    fine = {"failure": 0, "is_success": 0, "normalized_performance": 0.5, "rms_speed": 0.1}
    assert judgement(fine, 1.0) == "Evaluated: no success, performance 0.50, return 1.00: it still moves at 10.0 cm/s."


def test_each_environment_and_committed_policy_is_one_entry_of_the_menu():
    gallery = server.Gallery()
    for env_id, learners in server.available().items():
        assert gallery.titles[env_id] == env_id
        for learner in learners:
            name = f"{env_id}/{learner}"
            if name not in gallery.titles.values():  # it picks and places, in steps too long to watch
                assert f"learned, {learner}" not in server.committed_policies(env_id)
    stage = gallery.open("ClothReach-v0/ppo")
    assert stage.policy == "learned, ppo" and stage.name == "ClothReach-v0/ppo"


# --- links ----------------------------------------------------------------------------------------------------------------


def linked(query):
    gallery, (_, client) = server.Gallery(), page()
    return Page(client, gallery.open, gallery.titles, "patch", asked=query, address="http://here/"), client


def test_a_link_restores_what_it_was_copied_from():
    visitor, _ = page("flag")
    for name, value in (("gravity", 3.0), ("fabric", "denim"), ("integrator", "verlet"), ("strain_limit", 5.0)):
        visitor.controls[name].turn(value)
    visitor.controls["seed"].value = 7
    visitor.controls["time"].turn("reset")
    visitor.tick()
    visitor.stage.pin_particle(12)
    visitor.tick()
    told = link.write(visitor.stage)
    other, client = linked(told)
    other.tick()
    assert other.stage.settings == visitor.stage.settings and other.stage.seed == 7
    assert link.pinned(other.stage.sheets[0]) == [12] and not [said for said in client.notifications if "Not possible" in said]
    assert other.controls["link"].value == f"http://here/?{told}" == f"http://here/?{link.write(other.stage)}"


@pytest.mark.parametrize(
    ("query", "words"),
    [
        ("scene=nowhere", "is not shown here"),
        ("gravity=heavy", "The link is not understood"),
        ("gravity=-4", "gravity=-4.0"),
        ("pins=99999", "the particles of this sheet are 0 to 288"),
        ("compared=silk", "choose two to 4"),
        ("fabric=linen", "no material preset 'linen'"),
    ],
)
def test_a_link_that_makes_no_sense_is_told_and_the_page_opens_as_always(query, words):
    visitor, client = linked(query)
    visitor.tick()
    assert words in "".join(client.notifications) and visitor.stage.settings == SceneStage("patch").settings
