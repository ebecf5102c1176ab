"""The page in a real browser: a headless Chromium, which draws with SwiftShader; what is waited for has a deadline."""

import shutil
import time

import imageio.v3 as iio
import numpy as np
import pytest

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
pytest.importorskip("websockets", reason="the playground needs websockets: pip install 'clothgym[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="driving a browser needs playwright: pip install playwright")
if CHROMIUM is None:
    pytest.skip("no Chromium on this machine: apt-get install chromium", allow_module_level=True)

from clothgym.playground.recording import Recording  # noqa: E402
from clothgym.playground.server import serve  # noqa: E402

pytestmark = pytest.mark.slow
DEADLINE = 120.0  # seconds for what is waited for: kernels may have to be compiled, beside other tests
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]


@pytest.fixture(scope="module")
def playground():
    running = serve("patch", port=0, tell=lambda _: None)
    yield running
    running.stop()


@pytest.fixture(scope="module")
def chromium():
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


class Visitor:
    """A tab, the server's side of it, and what the console said."""

    def __init__(self, playground, browser, width=1000, height=620, query=""):
        known = list(playground.visits)
        self.said, self.asked = [], []
        self.tab = browser.new_page()
        self.tab.set_default_timeout(1e3 * DEADLINE)
        self.tab.set_viewport_size({"width": width, "height": height})
        self.tab.on("console", lambda message: self.said.append((message.type, message.text)))
        self.tab.on("pageerror", lambda error: self.said.append(("error", str(error))))
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.goto(playground.url + "/" * bool(query) + query, timeout=1e3 * DEADLINE)
        self.visit = None
        self.until(lambda: self._arrived(playground, known))
        self.tab.wait_for_function("page.placed !== undefined && !page.stale")

    def _arrived(self, playground, known):
        self.visit = next((visit for visit in list(playground.visits) if visit not in known), None)
        return self.visit is not None and self.visit.page is not None

    @property
    def page(self):
        return self.visit.page

    @property
    def stage(self):
        return self.visit.page.stage

    def until(self, what):
        """Let the tab live while it is waited for."""
        end = time.monotonic() + DEADLINE
        while not what():
            assert time.monotonic() < end, "it did not happen in time"
            self.tab.wait_for_timeout(30)

    def box(self, label):
        """The number beside a slider, or a menu, of that label."""
        return self.tab.locator(".control", has_text=label).locator("input[type=number], select").first

    def drawn(self):
        """Wait until the browser has drawn what has been sent."""
        self.tab.wait_for_timeout(100)
        self.tab.wait_for_function("page.placed && !page.stale")

    def on_screen(self, place):
        """Where a position [m] is seen in the window [pixels]."""
        across, up, _ = self.tab.evaluate("(place) => page.viewer.toPicture(place)", list(map(float, place)))
        size = self.tab.viewport_size
        return (0.5 + 0.5 * across) * size["width"], (0.5 - 0.5 * up) * size["height"]

    def picture(self):
        """What the window shows beside the panel, (height, width, 3)."""
        clip = {"x": 0, "y": 120, "width": 640, "height": 480}
        return iio.imread(self.tab.screenshot(clip=clip), extension=".png")[:, :, :3].astype(int)


@pytest.fixture(scope="module")
def visitor(playground, chromium):
    return Visitor(playground, chromium)


def test_it_loads_from_this_machine_alone_and_the_gravity_slider_moves_the_cloth(visitor, playground):
    visitor.until(lambda: len(visitor.stage.recording.frames) > 5)
    assert visitor.said == []
    assert not [url for url in visitor.asked if not url.startswith((playground.url, "data:"))]
    for label in ("Scene", "Gravity, m/s²", "Wind, m/s", "Fabric", "Integrator"):
        assert visitor.box(label).is_visible()
    for label in ("Gusts, m/s", "Substeps", "Seed", "Color by"):
        assert not visitor.box(label).is_visible()
    start, pins, before = visitor.stage.recording.frames[0].positions[0], list(visitor.stage.scene.anchors), visitor.picture()
    visitor.box("Gravity, m/s²").fill("9.81")
    visitor.box("Gravity, m/s²").press("Enter")
    visitor.until(lambda: visitor.stage.frame.positions[0, :, 2].min() < 0.35)
    assert np.array_equal(visitor.stage.frame.positions[0][pins], start[pins])
    visitor.until(lambda: np.mean(np.abs(visitor.picture() - before).max(axis=2) > 25) > 0.05)
    # red of the fabric on a gray floor; cream where strain is colored, and nothing is strained
    red = np.mean(visitor.picture()[..., 0] - visitor.picture()[..., 1] > 60)
    visitor.tab.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    visitor.box("Color by").select_option("strain")
    visitor.until(lambda: np.mean(visitor.picture()[..., 0] - visitor.picture()[..., 1] > 60) < 0.5 * red)
    assert red > 0.03
    visitor.box("Color by").select_option("fabric")
    visitor.tab.evaluate("document.querySelectorAll('details').forEach((one) => (one.open = false))")


def test_a_phone_has_a_sheet_at_the_bottom_and_every_task_is_drawn_without_a_word_to_the_console(playground, chromium):
    other = Visitor(playground, chromium, 390, 844, "?scene=ClothHook-v0")
    for name in ("ClothHook-v0", "race", "pawn"):  # a sheet with a hole, two sheets, and a solid that is a mesh
        other.page.order("open", name)
        other.until(lambda: other.stage.name == name and other.stage.recording.frames)  # noqa: B023 - called here
        other.drawn()
        sheets = np.array(other.tab.evaluate("page.viewer.sheets.map(({ sheet }) => Array.from(sheet.positions.slice(0, 3)))"))
        assert sheets.shape == (len(other.stage.recording.labels), 3) and np.isfinite(sheets).all()
    top = "document.querySelector('#panel').getBoundingClientRect().top"
    before = other.tab.evaluate(top)
    assert before > 450 and other.tab.evaluate("document.documentElement.scrollWidth") == 390
    other.tab.click("#handle")
    assert other.tab.evaluate(top) < before - 50 and other.said == []
    other.tab.close()


def test_the_view_stays_above_the_floor_and_comes_home(visitor):
    home = np.array(visitor.tab.evaluate("page.orbit.camera.eye"))
    for way in (-400, 900):
        visitor.tab.mouse.move(60, 500)
        visitor.tab.mouse.down()
        visitor.tab.mouse.move(90, 500 + way, steps=3)
        visitor.tab.mouse.up()
        eye = np.array(visitor.tab.evaluate("page.orbit.camera.eye"))
        assert eye[2] > 0.01 and np.linalg.norm(eye - home) > 0.1
    visitor.tab.click("#home")
    assert np.allclose(visitor.tab.evaluate("page.orbit.camera.eye"), home)


def test_a_link_opens_the_page_with_its_settings(playground, chromium):
    other = Visitor(playground, chromium, query="?scene=sphere&gravity=2.5&fabric=silk")
    assert other.stage.name == "sphere" and (other.stage.settings.gravity, other.stage.settings.fabric) == (2.5, "silk")
    # its own link is the same, and what it saves arrives
    other.tab.click("summary:has-text('Save and share')")
    other.until(lambda: "?scene=sphere&fabric=silk&gravity=2.5" in other.tab.input_value("#link"))
    other.tab.select_option("#folder-Save-and-share select", "npz")
    with other.tab.expect_download() as arrived:
        other.tab.click("button:text-is('Save')")
    assert arrived.value.suggested_filename == "sphere.npz"
    assert Recording.load(arrived.value.path()).title == "Sheet over a sphere"
    other.tab.close()


def test_the_cloth_is_grabbed_thrown_and_pinned_with_the_mouse(visitor):
    visitor.page.order("preset", "Start again")
    visitor.until(lambda: visitor.stage.settings.gravity == 0 and visitor.stage.frame.time > 0.2)
    particle, mouse = 544, visitor.tab.mouse

    def now():
        return visitor.stage.frame.positions[0, particle].astype(float)

    # a sheet that stands still, so that it is where the browser draws it
    visitor.page.order("press", "play")
    visitor.until(lambda: not visitor.page.playing)
    visitor.drawn()
    across, down = visitor.on_screen(now())
    place, still = now(), visitor.stage.frame.positions[0]
    listen = "() => { const send = page.send; window.sent = []; page.send = (...one) => (sent.push(one), send.apply(page, one)); }"
    visitor.tab.evaluate(listen)
    mouse.move(60, 500)
    assert visitor.tab.evaluate("document.querySelector('#stage').style.cursor") == "grab"
    mouse.move(across, down)
    assert visitor.tab.evaluate("document.querySelector('#stage').style.cursor") == "pointer"
    mouse.down()
    for step in range(1, 9):
        mouse.move(across, down - 10 * step)
    hand = visitor.stage.hand
    visitor.until(lambda: hand.held[0] or visitor.page._orders.qsize())
    visitor.page.order("press", "play")
    visitor.until(lambda: hand.held[0] and hand.goals[0, 2] > place[2] + 0.05)
    visitor.until(lambda: now()[2] > place[2] + 0.04)
    # the mouse has the particle that was under it
    _, (_, point) = visitor.tab.evaluate("window.sent[0]")
    held = int(np.argmin(((still - point) ** 2).sum(axis=1)))
    assert np.abs(still[held] - point).max() < 1e-6 and np.hypot(*np.subtract(visitor.on_screen(point), (across, down))) < 15
    mouse.move(across, down - 160)
    mouse.up()
    visitor.until(lambda: not hand.held.any())
    # thrown: it rises beyond where it was let go, and comes back
    visitor.until(lambda: visitor.stage.frame.positions[0, held, 2] < place[2] + 0.05)
    visitor.page.order("press", "play")
    visitor.until(lambda: not visitor.page.playing)
    visitor.drawn()
    click = visitor.on_screen(now())
    mouse.click(*click)
    visitor.until(lambda: hand.held[1:].any())
    *_, pinned = visitor.stage.held()
    assert np.hypot(*np.subtract(visitor.on_screen(pinned), click)) < 15
    visitor.page.order("press", "play")
