"""The demo: what was recorded, what its files hold, and what the page makes of them in a headless Chromium."""

import base64
import gzip
import importlib.util
import json
import shutil
import struct
import sys
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import pytest

import clothgym

DEMO = Path(__file__).parent.parent / "docs" / "demo"
# a script of docs/, whose name training/ has, too
_spec = importlib.util.spec_from_file_location("demo_record", DEMO / "record.py")
record = importlib.util.module_from_spec(_spec)
sys.modules["demo_record"] = record
_spec.loader.exec_module(record)

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]


@pytest.fixture(scope="module")
def opened(tmp_path_factory):
    """The page from a disk, its episodes, one of them made up of known numbers, and what it said to the console."""
    playwright = pytest.importorskip("playwright.sync_api", reason="driving a browser needs playwright: pip install playwright")
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    root = tmp_path_factory.mktemp("demo")
    folder = root / "docs" / "demo"
    shutil.copytree(DEMO, folder, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(DEMO.parent.parent / "clothgym" / "playground" / "web", root / "clothgym" / "playground" / "web")
    record.written("walk", walk(), folder / "episodes")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        tab, said = browser.new_page(viewport={"width": 390, "height": 480}), []
        tab.on("console", lambda message: said.append(message.text))
        tab.on("pageerror", lambda error: said.append(str(error)))
        tab.goto((folder / "index.html").as_uri() + "#reach")
        tab.wait_for_function("page.episode !== undefined && (page.play(false), true)")
        yield tab, said
        browser.close()


def walk():
    """A recording of points that jump about: all differences are large, and many wrap around."""
    x = np.random.default_rng(3).uniform(-0.8, 0.8, (7, 12, 3))
    x[0, 0], x[1, 0], x[2, 0] = -1.6, 1.6, -1.6
    return record.Recorded(x, {"time_step": 0.1})


def decoded(tab, name):
    """Positions as the page has them [m], (frames, points, 3)."""
    made = tab.evaluate(
        "async (name) => { const one = await loadEpisode(name); return [one.frames, one.points, Array.from(one.positions)]; }", name
    )
    return np.array(made[2]).reshape(made[0], made[1], 3)


@pytest.mark.slow
def test_the_page_decodes_the_positions_that_were_recorded(opened):
    tab, _ = opened
    assert np.abs(decoded(tab, "walk") - walk().positions).max() <= 0.5 * record.QUANTUM + 1e-6


@pytest.mark.slow
def test_the_page_shows_what_the_committed_policy_does(opened):
    # played again here, without the script that recorded it
    tab, _ = opened
    policy = clothgym.policies.load("ClothReach-v0")
    env = policy.make().unwrapped
    observation, info = env.reset(seed=1_000_000)
    sheets, over = [env.task.simulation.positions[0]], False
    while not over:
        observation, _, terminated, truncated, info = env.step(policy(observation))
        sheets.append(env.task.simulation.positions[0])
        over = terminated or truncated
    shown = decoded(tab, "reach")[:, : sheets[0].shape[0]]
    assert np.abs(shown - np.array(sheets)).max() < 1e-4
    # the drawn surface goes through the particles: every fourth vertex of it, in both directions
    middle = len(sheets) // 2
    tab.evaluate("(frame) => page.seek(frame * page.episode.time_step)", middle)
    fine = np.array(tab.evaluate("Array.from(page.viewer.sheets[0].sheet.positions)")).reshape(33, 33, 3)
    assert np.abs(fine[::4, ::4].reshape(-1, 3) - sheets[middle]).max() < 1e-4
    # and it ends as the episode did
    tab.evaluate("page.seek(page.episode.duration)")
    assert f"Success · score {info['normalized_performance']:.2f}" in tab.inner_text("#verdict")


@pytest.mark.slow
def test_every_episode_is_drawn_without_a_word_to_the_console(opened):
    tab, said = opened
    for name in record.EPISODES:
        tab.evaluate("(name) => page.open(name).then(() => page.play(false))", name)
        sheet = np.array(tab.evaluate("Array.from(page.viewer.sheets[0].sheet.positions)"))
        assert np.isfinite(sheet).all()
        if name == "fold":
            tab.wait_for_function("!page.stale")
            picture = iio.imread(tab.screenshot(), extension=".png")[:, :, :3].astype(int)
    # red of the fabric on a gray floor, above the panel
    stage = picture[: int(tab.evaluate("document.querySelector('#panel').getBoundingClientRect().top"))]
    assert np.mean(stage[..., 0] - stage[..., 1] > 60) > 0.02
    assert tab.evaluate("document.documentElement.scrollWidth") == 390
    assert said == []


@pytest.mark.slow
def test_a_link_names_an_episode_and_one_that_is_missing_is_said(opened):
    tab, said = opened
    tab.evaluate("location.hash = 'fold'")
    tab.wait_for_function("page.episode.id === 'ClothFold-v0'")
    assert tab.inner_text("#title") == "Fold"
    tab.evaluate("page.open('nowhere')")
    tab.wait_for_function("document.querySelector('#trouble').textContent.includes('nowhere.js is missing')")
    said.clear()


@pytest.mark.slow
def test_a_finger_takes_hold_of_the_sheet_and_throws_it(opened):
    tab, said = opened
    tab.evaluate("page.open('hand')")
    tab.wait_for_function("page.hand.cloth.time > 0.1")
    said.clear()
    # a particle between the pins, in pixels
    place = tab.evaluate("""() => {
        const { cloth } = page.hand;
        const [across, up] = page.viewer.toPicture(cloth.x.map((row) => row[28 * 33 + 16]));
        return [(0.5 + 0.5 * across) * innerWidth, (0.5 - 0.5 * up) * innerHeight];
    }""")
    tab.mouse.move(*place)
    tab.mouse.down()
    held = tab.evaluate("page.hand.held.p")
    # within reach of the finger, on the grid of 33 x 33
    assert max(abs(held // 33 - 28), abs(held % 33 - 16)) < 8 and tab.evaluate("page.hand.cloth.w[page.hand.held.p]") == 0
    before = np.array(tab.evaluate("page.hand.cloth.x.map((row) => row[page.hand.held.p])"))
    tab.mouse.move(place[0] + 60, place[1] - 20, steps=4)
    began = tab.evaluate("page.hand.cloth.time")
    tab.wait_for_function(f"page.hand.cloth.time > {began + 0.2}")
    moved = np.array(tab.evaluate("page.hand.cloth.x.map((row) => row[page.hand.held.p])")) - before
    assert np.linalg.norm(moved) > 0.05
    tab.mouse.up()
    assert tab.evaluate(f"[page.hand.held, page.hand.cloth.w[{held}] > 0]") == [None, True]
    # explicit Euler bursts, which is said, and the sheet begins again
    tab.click("text=Explicit Euler")
    tab.wait_for_function("page.hand.burst > 0", timeout=60_000)
    assert "It has burst" in tab.inner_text("#verdict")
    tab.wait_for_function("!page.hand.explicit && page.hand.burst <= 0", timeout=60_000)
    assert np.isfinite(tab.evaluate("Math.max(...page.viewer.sheets[0].sheet.own)")) and said == []


def test_files_are_small_and_complete():
    paths = {path.stem: path.stat().st_size for path in record.FOLDER.glob("*.js")}
    assert set(paths) == {*record.EPISODES, "index"}
    assert max(paths.values()) < 300_000 and sum(paths.values()) < 3_000_000
    listed = json.loads(record.INDEX.read_text().removeprefix("const EPISODES = ").removesuffix(";\n"))
    assert [one["name"] for one in listed] == list(record.EPISODES)
    # the page draws parts of grids alone
    shown = {env_id for env_id in clothgym.policies.available() if "Shirt" not in env_id and "Canonicalize" not in env_id}
    assert {chosen.env_id for chosen in record.EPISODES.values()} == shown


@pytest.mark.parametrize("name", record.EPISODES)
def test_an_episode_is_of_the_policy_that_is_committed_now(name):
    """Where it is not, ``python docs/demo/record.py NAME`` records it again."""
    content = gzip.decompress(base64.b64decode((record.FOLDER / f"{name}.js").read_text().split('"')[3]))
    (length,) = struct.unpack_from("<I", content)
    header, about = json.loads(content[4 : 4 + length]), clothgym.policies.load(record.EPISODES[name].env_id).about
    assert header["learner"] == record.LEARNERS[about["learner"]]
    assert {key: header[key] for key in ("success_rate", "episodes", "digest")} == {
        key: about[key] for key in ("success_rate", "episodes", "digest")
    }


def test_solids_that_come_and_go_are_followed():
    from clothgym import Sphere
    from clothgym.render import Drawn

    first, second = (Drawn(Sphere(center=(k, 0, 0), radius=0.1)) for k in (1, 2))
    solids, centers = record.tracks([[(first, True)], [], [(second, True), (first, True)], [(first, False)]])
    assert [one["shown"] for one in solids] == [[0, 1, 2, 3], [2, 3], [3, 4]]
    assert centers[:, 0, 0].tolist() == [1, 1, 2, 2]
    assert [one["holds"] for one in solids] == [True, True, False]


def test_what_is_too_far_away_is_refused():
    x = np.zeros((2, 1, 3))
    x[1] = 4.0
    with pytest.raises(ValueError, match=r"positions reach 2\.00 m from their middle: must be within 1\.64 m"):
        record.packed(record.Recorded(x, {}))
