"""The page in a real browser: a headless Chromium, which draws with SwiftShader; what is waited for has a deadline."""

import shutil
import time

import imageio.v3 as iio
import numpy as np
import pytest

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
viser = pytest.importorskip("viser", reason="the playground needs viser: pip install 'clothgym[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="driving a browser needs playwright: pip install playwright")
if CHROMIUM is None:
    pytest.skip("no Chromium on this machine: apt-get install chromium", allow_module_level=True)

from clothgym.playground.server import serve  # noqa: E402

pytestmark = pytest.mark.slow
DEADLINE = 120.0  # seconds for what is waited for: kernels may have to be compiled, beside other tests
FLAGS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]
# other libraries' words on their own dependencies
KNOWN = ("THREE.Clock", "Unable to preventDefault inside passive event listener")


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
        known = set(playground.visits)
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
        self.tab.get_by_text("gravity m/s²").first.wait_for(timeout=1e3 * DEADLINE)

    def _arrived(self, playground, known):
        self.visit = next((visit for number, visit in list(playground.visits.items()) if number not in known), None)
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
        """The number beside a slider, or the field of a menu, of that label."""
        return self.tab.locator(
            f"xpath=//label[normalize-space()='{label}']/ancestor::*[.//input][1]//input[not(@type='hidden')]"
        ).last

    def set_number(self, label, value):
        field = self.box(label)
        field.fill(str(value))
        field.press("Enter")

    def drawn(self):
        """Wait until the browser has drawn what has been sent."""
        frames = (
            "() => new Promise(done => { let n = 0; (function next() { n++ < 3 ? requestAnimationFrame(next) : done(); })(); })"
        )
        self.tab.evaluate(frames)

    def on_screen(self, place):
        """Where a position [m] is seen in the window [pixels]."""
        camera, box = self.page.client.camera, self.tab.locator("canvas").first.bounding_box()
        eye, ahead = np.array(camera.position), np.subtract(camera.look_at, camera.position)
        ahead = ahead / np.linalg.norm(ahead)
        right = np.cross(ahead, (0, 0, 1)) / np.linalg.norm(np.cross(ahead, (0, 0, 1)))
        away, scale = (place - eye) @ ahead, box["height"] / 2 / np.tan(camera.fov / 2)
        across, up = scale * ((place - eye) @ right) / away, scale * ((place - eye) @ np.cross(right, ahead)) / away
        return box["x"] + box["width"] / 2 + across, box["y"] + box["height"] / 2 - up

    def picture(self):
        """What the window shows beside the panel, (height, width, 3)."""
        clip = {"x": 0, "y": 120, "width": 640, "height": 480}
        return iio.imread(self.tab.screenshot(clip=clip), extension=".png")[:, :, :3].astype(int)


@pytest.fixture(scope="module")
def visitor(playground, chromium):
    return Visitor(playground, chromium)


def test_it_loads_from_this_machine_alone_and_the_gravity_slider_moves_the_cloth(visitor, playground):
    visitor.until(lambda: len(visitor.stage.recording.frames) > 5)
    assert not [text for kind, text in visitor.said if kind == "error" and not text.startswith(KNOWN)]
    ours = (playground.url, "data:", "blob:", playground.url.replace("http", "ws"))
    assert not [url for url in visitor.asked if not url.startswith(ours)]
    for label in ("scene", "gravity m/s²", "wind m/s", "fabric", "integrator"):
        assert visitor.box(label).is_visible()
    for label in ("gusts m/s", "substeps", "seed", "color by"):
        assert not visitor.tab.get_by_text(label, exact=True).first.is_visible()
    start, pins, before = visitor.stage.recording.frames[0].positions[0], list(visitor.stage.scene.anchors), visitor.picture()
    visitor.set_number("gravity m/s²", 9.81)
    visitor.until(lambda: visitor.stage.frame.positions[0, :, 2].min() < 0.35)
    assert np.array_equal(visitor.stage.frame.positions[0][pins], start[pins])
    visitor.until(lambda: np.mean(np.abs(visitor.picture() - before).max(axis=2) > 25) > 0.05)


def test_a_link_opens_the_page_with_its_settings(playground, chromium):
    other = Visitor(playground, chromium, query="?scene=sphere&gravity=2.5&fabric=silk")
    assert other.stage.name == "sphere" and (other.stage.settings.gravity, other.stage.settings.fabric) == (2.5, "silk")
    other.tab.close()


def test_the_cloth_is_grabbed_thrown_and_pinned_with_the_mouse(visitor):
    visitor.page.order("preset", "start again")
    visitor.until(lambda: visitor.stage.settings.gravity == 0 and visitor.stage.frame.time > 0.2)
    particle, mouse = 144, visitor.tab.mouse

    def now():
        return visitor.stage.frame.positions[0, particle].astype(float)

    # a sheet that stands still, so that it is where the browser draws it
    visitor.page.order("press", "play / pause")
    visitor.until(lambda: not visitor.page.playing)
    visitor.drawn()
    across, down = visitor.on_screen(now())
    place = now()
    mouse.move(across, down)
    mouse.down()
    for step in range(1, 9):
        mouse.move(across, down - 10 * step)
    hand = visitor.stage.hand
    visitor.until(lambda: hand.held[0] or visitor.page._orders.qsize())
    visitor.page.order("press", "play / pause")
    visitor.until(lambda: hand.held[0] and hand.goals[0, 2] > place[2] + 0.05)
    visitor.until(lambda: now()[2] > place[2] + 0.04)
    held = int(np.argmin(((visitor.stage.simulation.grippers.positions[0, 0] - visitor.stage.frame.positions[0]) ** 2).sum(1)))
    assert np.abs(np.subtract(divmod(held, 17), divmod(particle, 17))).max() <= 1  # the mouse had the thread that was under it
    mouse.move(across, down - 160)
    mouse.up()
    visitor.until(lambda: not hand.held.any())
    # thrown: it rises beyond where it was let go, and comes back
    visitor.until(lambda: visitor.stage.frame.positions[0, held, 2] < place[2] + 0.05)
    visitor.page.order("press", "play / pause")
    visitor.until(lambda: not visitor.page.playing)
    visitor.drawn()
    mouse.click(*visitor.on_screen(now()))
    visitor.until(lambda: hand.held[1:].any())
    *_, pinned = visitor.stage.held()
    assert np.linalg.norm(pinned - now()) < 0.08
    visitor.page.order("press", "play / pause")
