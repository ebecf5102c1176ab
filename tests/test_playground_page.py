"""The page in a viewer that shows nothing, and the server's door; test_page.py has a browser."""

import socket
import sys
import urllib.request
import zipfile
from pathlib import Path

import numpy as np
import pytest
from stages import advanced, page

import clothgym
from clothgym import Simulation, grid
from clothgym.cli import main
from clothgym.playground import files, server
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.null import NullClient
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording
from clothgym.playground.scenes import scene_named
from clothgym.playground.stage import SceneStage
from clothgym.playground.world import Settings, begin


def assert_drawn(client, frame, lifted=0.0):
    """The surface in the viewer goes through the particles of the first sheet, or lies so high above a solid at them [m]."""
    drawn = np.concatenate([node.vertices for name, node in client.scene.handles.items() if name.startswith("/sheet0/front")])
    gaps = [np.abs(drawn - particle).max(axis=1).min() for particle in frame.positions[0][::7]]
    assert max(gaps) < 1e-6 + lifted


# --- the page -----------------------------------------------------------------------------------------------------------


def test_the_gravity_slider_moves_the_cloth_of_this_visitor_alone():
    (mine, client), (theirs, _) = page(), page()
    client.gui.handles["gravity m/s²"].turn(9.81)
    for _ in range(20):
        mine.tick()
        theirs.tick()
    assert mine.stage.frame.positions[0, :, 2].min() < 0.55 < theirs.stage.frame.positions[0, :, 2].min()
    assert_drawn(client, mine.stage.frame)


def test_controls_turn_settings_and_follow_them():
    visitor, client = page()
    handles = client.gui.handles
    handles["fabric"].turn("denim")
    visitor.tick()
    assert visitor.controls["stretch_stiffness"].value == 1615.7
    handles["bending stiffness µN m"].turn(20.0)
    handles["integrator"].turn("verlet")
    handles["safe substeps"].turn(False)
    handles["strain limit %"].turn(5.0)
    visitor.tick()
    settings = visitor.stage.settings
    assert (settings.bend_rigidity, settings.integrator, settings.strain_limit) == (2e-5, "verlet", 0.05)
    assert settings.substeps == visitor.stage.sheets[0].simulation.substeps
    handles["fabric"].turn("knit")
    visitor.tick()
    handles["bending stiffness µN m"].turn(200.0)
    visitor.tick()
    assert "lower the rigidity to" in client.notifications[-1]
    assert visitor.controls["bend_rigidity"].value == pytest.approx(0.225)


def test_pause_step_scrub_and_reset():
    visitor, client = page("flag")
    controls = visitor.controls
    for _ in range(5):
        visitor.tick()
    controls["time"].turn("play / pause")
    visitor.tick()
    assert controls["state"].content.endswith("paused")
    count = len(visitor.stage.recording.frames)
    controls["time"].turn("step")
    visitor.tick()
    visitor.tick()
    assert len(visitor.stage.recording.frames) == count + 1
    controls["moment"].turn(2)
    visitor.tick()
    assert_drawn(client, visitor.stage.recording.frames[2], lifted=0.006)
    controls["seed"].value = 3
    controls["time"].turn("reset")
    visitor.tick()
    assert controls["state"].content.endswith("playing")
    assert visitor.stage.seed == 3 and visitor.stage.frame.time == pytest.approx(2 / 60)


def test_a_recording_is_scrubbed_to_any_frame_and_plays_on_from_there():
    stage = advanced(EpisodeStage("ClothReach-v0", seed=3), 12)
    visitor, client = page(server.REPLAY, recording=stage.recording)
    visitor.tick()
    assert visitor.moment == 1 and visitor.controls["moment"].max == 12
    visitor.controls["moment"].turn(9)
    visitor.tick()
    assert_drawn(client, stage.recording.frames[9])
    visitor.controls["time"].turn("step")
    visitor.tick()
    visitor.controls["time"].turn("play / pause")
    for _ in range(9):
        visitor.tick()
    assert visitor.moment == 12
    assert_drawn(client, stage.frame)
    terms = visitor.plots.shown["reward terms"].data
    assert np.array_equal(terms[0], [frame.time for frame in stage.recording.frames])
    names = sorted(stage.frame.terms)
    assert [column[-1] for column in terms[1:]] == [stage.frame.terms[name] for name in names]
    visitor.controls["time"].turn("reset")
    visitor.tick()
    assert visitor.moment == 1 and len(visitor.stage.recording.frames) == 13


def test_the_last_frame_of_an_episode_is_read_with_its_judgement():
    visitor, _ = page("ClothReach-v0")
    while not visitor.stage.over:
        visitor.tick()
    assert "Evaluated: a success" in visitor.controls["notes"].content
    assert visitor.controls["state"].content.endswith("over: reset to start again")
    assert visitor.controls["moment"].value == len(visitor.stage.recording.frames) - 1


def test_the_line_on_a_wait_stays_until_the_first_frame_which_is_what_compiles():
    visitor, client = page()
    visitor.tick()
    assert not client.notifications
    kind = SceneStage.advance
    for turn in (
        lambda: visitor.controls["integrator"].turn("verlet"),
        lambda: visitor.controls["compare"].turn(True),
        lambda: visitor.controls["scene"].turn("Flag in gusty wind"),
    ):
        seen = []
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(SceneStage, "advance", lambda stage, seen=seen: (seen.append(visitor._waiting.removed), kind(stage))[1])
            turn()
            visitor.tick()
        assert seen == [False] and visitor._waiting is None and client.notifications.pop().startswith("One moment")
    # nothing is waited for while it stands still, and then as soon as it goes on
    visitor.playing = False
    visitor.controls["bending"].turn("hinge")
    visitor.tick()
    assert visitor._waiting is None and len(client.notifications) == 1
    visitor.controls["time"].turn("step")
    visitor.tick()
    visitor.controls["time"].turn("step")
    visitor.tick()
    assert visitor._waiting is None and len(client.notifications) == 2


def test_plots_end_where_the_frames_do_after_a_reset_and_in_another_scene(monkeypatch):
    monkeypatch.setattr("clothgym.playground.page.READ_EVERY", 0.0)  # each frame is read, however fast it came
    visitor, _ = page("flag")

    def spans():
        return {plot.scales["x"]["range"] for plot in visitor.plots.shown.values()}

    for _ in range(3):
        visitor.tick()
    assert spans() == {(0.0, 2.0)}
    for _ in range(75):
        visitor.stage.advance()
    visitor.tick()
    assert spans() == {(0.0, 4.0)}
    visitor.controls["time"].turn("reset")
    visitor.tick()
    assert spans() == {(0.0, 2.0)}


def test_comparison_has_a_sheet_and_a_color_for_each():
    visitor, client = page()
    visitor.controls["compared 1"].value = "verlet"
    visitor.controls["compare"].turn(True)
    visitor.tick()
    assert [sheet.name for sheet in visitor.stage.sheets] == ["semi_implicit_euler", "verlet"]
    visitor.controls["show"].turn("fabric")
    visitor.tick()
    colors = [client.scene.handles[f"/sheet{k}/front0"].color for k in range(2)]
    assert len(set(colors)) == 2 and not visitor.controls["integrator"].visible
    visitor.controls["compare"].turn(False)
    visitor.tick()
    assert len(visitor.stage.sheets) == 1


def test_other_scenes_environments_and_contact():
    visitor, client = page()
    visitor.controls["scene"].turn("Sheet over a box")
    for _ in range(16):
        visitor.tick()
    visitor.controls["show"].turn("contact")
    visitor.tick()
    frame = visitor.stage.frame
    assert frame.touching.any() and np.array_equal(client.scene.handles["/touching"].points, frame.positions[frame.touching])
    x = frame.positions[0].astype(float)
    c, s = np.cos(0.4), np.sin(0.4)
    own = x @ np.array([(c, -s, 0), (s, c, 0), (0, 0, 1)]) - (0, 0, 0.18)
    to_box = np.linalg.norm(np.maximum(np.abs(own) - 0.18, 0), axis=1)
    away = np.minimum(to_box, x[:, 2])
    assert np.all(away[frame.touching[0]] < 0.0025) and np.all(frame.touching[0][away < 0.0015])
    visitor.controls["scene"].turn("ClothReach-v0")
    visitor.tick()
    visitor.tick()
    assert visitor.controls["policy"].visible and "reward: " in visitor.controls["readings"].content
    assert not visitor.controls["Compare"].visible


def test_files_hold_what_was_shown(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    visitor, client = page("flag")
    for _ in range(3):
        visitor.tick()
    visitor.playing = False
    for kind in ("picture (PNG)", "meshes (OBJ, zipped)", "moving mesh (glTF)", "recording (NPZ)"):
        visitor.controls["kind"].value = kind
        visitor.controls["save"].turn()
        visitor.tick()
    (tmp_path / "flag.glb").write_bytes(client.files["flag.glb"])
    moving = trimesh.load(tmp_path / "flag.glb", process=False).geometry
    assert len(moving) == 2  # the sheet, and its pole
    uv = max(moving.values(), key=lambda part: len(part.vertices)).visual.uv
    assert uv.min() >= 0 and uv.max() <= 1 and np.ptp(uv[:, 0]) == pytest.approx(1.0)
    assert set(client.files) == {"flag.png", "flag_obj.zip", "flag.glb", "flag.npz"}
    assert client.files["flag.png"].startswith(b"\x89PNG")
    (tmp_path / "flag.zip").write_bytes(client.files["flag_obj.zip"])
    with zipfile.ZipFile(tmp_path / "flag.zip") as archive:
        archive.extractall(tmp_path)
        assert len(archive.namelist()) == 4
    mesh = trimesh.load(tmp_path / "frame_00003.obj", process=False, split_object=True, group_material=False)
    cloth = next(iter(mesh.geometry.values())) if hasattr(mesh, "geometry") else mesh
    shown = visitor.stage.recording.frames[3].positions[0]
    assert np.array_equal(cloth.vertices[: len(shown)].astype(np.float32), shown)
    (tmp_path / "flag.npz").write_bytes(client.files["flag.npz"])
    assert len(Recording.load(tmp_path / "flag.npz").frames) == 4


def test_a_saved_picture_has_the_colors_that_are_shown():
    iio = pytest.importorskip("imageio.v3")
    stage = advanced(SceneStage("patch", Settings(fabric="knit", gravity=9.81), compared=("semi_implicit_euler", "xpbd")), 10)
    camera = NullClient().camera
    camera.position, camera.look_at, camera.fov = (0.0, -3.0, 1.2), (0.0, 0.2, 0.5), 0.7
    made = {color: files.made("png", stage, 10, camera, color)[1] for color in ("fabric", "strain")}
    pictures = {color: iio.imread(content, extension=".png").astype(int) for color, content in made.items()}
    left, right = (pictures["fabric"][:, half].reshape(-1, 3) for half in (slice(0, 480), slice(480, 960)))
    hues = [side[np.ptp(side, axis=1) > 60].mean(axis=0) for side in (left, right)]
    assert np.abs(hues[0] - hues[1]).max() > 40
    assert np.mean(np.abs(pictures["fabric"] - pictures["strain"]).max(axis=2) > 40) > 0.02


# --- the server's door --------------------------------------------------------------------------------------------------


def test_nothing_but_loopback_is_listened_at_by_default():
    assert server.LOOPBACK == "127.0.0.1"
    assert server.serve.__defaults__[0] == server.Playground.__init__.__defaults__[0] == server.LOOPBACK


def test_the_real_server_gives_its_page_and_stops():
    pytest.importorskip("viser")
    running = server.serve("patch", port=0, tell=lambda _: None)
    try:
        assert running.url.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(running.url, timeout=20) as answer:
            assert answer.status == 200 and b"<html" in answer.read()
    finally:
        running.stop()
    with pytest.raises(OSError):
        urllib.request.urlopen(running.url, timeout=20)


def test_a_visit_that_fails_tells_its_visitor_and_ends_alone(monkeypatch, capsys):
    def fail(page):
        raise RuntimeError("a thread broke")

    monkeypatch.setattr(Page, "tick", fail)
    client = NullClient()
    visit = server.Visit(client, server.Gallery(), "patch")
    visit.thread.join(30)
    assert not visit.thread.is_alive()
    assert client.notifications[-1].startswith("This page has stopped") and "a thread broke" in capsys.readouterr().err


def test_a_port_in_use_gives_the_next():
    with socket.socket() as taken:
        taken.bind((server.LOOPBACK, 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert server.free_port(server.LOOPBACK, port) > port
    for host, port, words in (("300.1.1.1", 8080, "is no address"), (server.LOOPBACK, 99999, "from 0 to 65535")):
        with pytest.raises(ValueError, match=words):
            server.free_port(host, port)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["flagg"], "did you mean 'flag'"),
        (["--port", "99999"], "from 0 to 65535"),
        (["--replay", "nowhere.npz"], "nowhere.npz"),
        (["--policy", "nowhere"], "no policy 'nowhere' (there are: noop, random, expert"),
    ],
)
def test_the_command_says_what_is_wrong(arguments, words, capsys):
    pytest.importorskip("viser")
    with pytest.raises(SystemExit):
        main(["view", *arguments])
    assert words in capsys.readouterr().err


def test_without_the_extra_there_is_a_sentence(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(SystemExit):
        main(["view"])
    assert "pip install 'clothgym[view]'" in capsys.readouterr().err


def test_the_core_and_the_stages_know_nothing_of_viser():
    for path in Path(clothgym.__file__).parent.rglob("*.py"):
        if path.name != "server.py" and "envs" not in path.parts:
            assert "import viser" not in path.read_text(), path


def test_a_scenes_simulation_takes_options_and_a_seed_shifts_only_what_is_free():
    scene = scene_named("patch")
    s = scene.simulation(integrator="verlet", substeps=12)
    assert isinstance(s, Simulation) and s.integrator.name == "verlet" and s.substeps == 12
    begin(s, scene, seed=5)
    moved = np.abs(s.positions[0] - scene.start.astype(np.float32)).max(axis=1) > 0
    assert not moved[list(scene.anchors)].any() and moved.sum() == grid(17, 17, 0.6, 0.6).num_particles - 2
