"""The page in a real browser: a headless Chromium, which draws with SwiftShader; what is waited for has a deadline."""

import contextlib
import http.server
import os
import shutil
import signal
import socket
import subprocess
import tempfile
import threading
import time

import imageio.v3 as iio
import numpy as np
import pytest

CHROMIUM = next((path for path in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if path), None)
viser = pytest.importorskip("viser", reason="the playground needs viser: pip install 'clothgym[view]'")
playwright = pytest.importorskip("playwright.sync_api", reason="driving a browser needs playwright: pip install playwright")
if CHROMIUM is None:
    pytest.skip("no Chromium on this machine: apt-get install chromium", allow_module_level=True)

from clothgym.playground.recording import yarns  # noqa: E402
from clothgym.playground.server import LOOPBACK, serve  # noqa: E402

DEADLINE = 300.0  # seconds for what is waited for: kernels may have to be compiled, beside other tests
PATIENCE = 5.0  # seconds for an open list to hold still
REBOUND = "--host-resolver-rules=MAP evil.example 127.0.0.1"
FLAGS = [REBOUND, "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]
# other libraries' words on their own dependencies
KNOWN = ("THREE.Clock", "Unable to preventDefault inside passive event listener")


def until(what, deadline=DEADLINE):
    """The first true outcome."""
    end = time.monotonic() + deadline
    while time.monotonic() < end:
        outcome = what()
        if outcome:
            return outcome
        time.sleep(0.02)
    raise AssertionError("it did not happen in time")


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


def answers(port):
    with socket.socket() as probe:
        return probe.connect_ex((LOOPBACK, port)) == 0


@contextlib.contextmanager
def second_browser():
    """A browser that is a process of its own, which can be killed, and its port."""
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        process = subprocess.Popen(
            [CHROMIUM, "--headless=new", f"--remote-debugging-port={port}", f"--user-data-dir={profile}", *FLAGS, "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            until(lambda: answers(port))
            yield process, port
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(DEADLINE)


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
        self.visit = until(lambda: self._arrived(playground, known))
        # a phone does not show the controls at first
        self.tab.get_by_text("gravity m/s²" if width > 576 else "clothgym").first.wait_for(timeout=1e3 * DEADLINE)

    def _arrived(self, playground, known):
        self.tab.wait_for_timeout(20)
        new = [visit for number, visit in list(playground.visits.items()) if number not in known]
        return new[0] if new and new[0].page is not None else None

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

    def choose(self, label, option):
        # a list that opened while its panel still unfolded may have closed again: then it is opened once more
        choice, end = self.tab.get_by_role("option", name=option, exact=True), time.monotonic() + DEADLINE
        while True:
            self.box(label).click()
            try:
                return choice.click(timeout=1e3 * PATIENCE)
            except playwright.TimeoutError:
                assert time.monotonic() < end, f"{label}: {option} could not be chosen in time"

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


def test_it_loads_from_this_machine_alone_without_an_error_in_the_console(visitor, playground):
    visitor.until(lambda: len(visitor.stage.recording.frames) > 5)
    assert not [text for kind, text in visitor.said if kind == "error" and not text.startswith(KNOWN)]
    outside = [
        url for url in visitor.asked if not url.startswith((playground.url, "data:", "blob:", playground.url.replace("http", "ws")))
    ]
    assert not outside


def test_the_page_has_its_own_title_and_icon_and_opens_alive_with_five_controls_in_sight(visitor):
    assert visitor.tab.title() == "clothgym"
    icon = visitor.tab.locator('link[rel="icon"]').get_attribute("href")
    assert "ce4032" in icon and "ec1c24" not in icon  # coral gingham, not the library's logo
    x = visitor.stage.frame.positions[0]
    visitor.until(lambda: np.abs(visitor.stage.frame.positions[0] - x).max() > 0.01)
    for label in ("scene", "gravity m/s²", "wind m/s", "fabric", "integrator"):
        assert visitor.box(label).is_visible()
    for label in ("gusts m/s", "substeps", "seed", "color by"):
        assert not visitor.tab.get_by_text(label, exact=True).first.is_visible()


def test_the_gravity_slider_moves_the_cloth_and_its_pins_stay_to_the_last_bit(visitor):
    start, pins = visitor.stage.recording.frames[0].positions[0], list(visitor.stage.scene.anchors)
    before = visitor.picture()
    visitor.set_number("gravity m/s²", 9.81)
    visitor.until(lambda: visitor.stage.frame.positions[0, :, 2].min() < 0.35)
    assert np.array_equal(visitor.stage.frame.positions[0][pins], start[pins])
    visitor.until(lambda: np.mean(np.abs(visitor.picture() - before).max(axis=2) > 25) > 0.05)


def test_the_stretch_that_the_page_reads_is_the_cores_and_the_threads_there_light_up(visitor):
    s, mesh, scale = visitor.stage.sheets[0].simulation, visitor.stage.scene.mesh, visitor.page.show.scale
    visitor.set_number("gravity m/s²", 9.81)
    visitor.until(lambda: s.strain()[0].max() > 0.45 * scale.strained)
    visitor.page.order("press", "play / pause")
    visitor.until(lambda: not visitor.page.playing)
    strain = s.strain()[0]
    visitor.tab.get_by_text(f"{100 * strain.max():.2f} %", exact=True).first.wait_for(timeout=1e3 * DEADLINE)
    # what was sent to the browser is drawn where the core is most strained, as red as its share of the scale asks for
    node, springs = visitor.page.show.threads[0], yarns(mesh)
    loud, idle = np.flatnonzero(strain > 0.26 * scale.strained), strain < 0.2 * scale.strained
    drawn = np.linalg.norm(node.points[:, 1] - node.points[:, 0], axis=1)
    ends = s.positions[0][mesh.springs.particles[springs[loud]]]
    assert np.linalg.norm(node.points[loud] - ends, axis=2).max() < 0.0031 and not drawn[idle].any()
    gray, yellow, orange, red = (112, 118, 138), (255, 206, 92), (255, 122, 40), (232, 20, 56)
    shares = strain[loud] / scale.strained
    shade = np.array([np.interp(shares, (0, 0.33, 0.66, 1), c) for c in zip(gray, yellow, orange, red)]).T / 255
    light = 255 * ((shade + 0.055) / 1.055) ** 2.4
    assert len(loud) and shares.max() <= 1 and np.abs(node.colors[loud] - light[:, None]).max() < 2
    visitor.page.order("press", "play / pause")


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
    hand = visitor.stage.sheets[0].hand
    visitor.until(lambda: hand.held[0] or visitor.page._orders.qsize())
    visitor.page.order("press", "play / pause")
    visitor.until(lambda: hand.held[0] and hand.goals[0, 2] > place[2] + 0.05)
    visitor.until(lambda: now()[2] > place[2] + 0.04)
    held = int(
        np.argmin(((visitor.stage.sheets[0].simulation.grippers.positions[0, 0] - visitor.stage.frame.positions[0]) ** 2).sum(1))
    )
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
    (pinned,) = visitor.stage.pinned()
    assert np.linalg.norm(pinned - now()) < 0.08
    visitor.page.order("press", "play / pause")


def test_a_race_is_run_with_the_mouse_and_judged(visitor):
    visitor.page.order("preset", "race")
    visitor.until(lambda: visitor.stage.name == "race")
    race, mouse = visitor.stage, visitor.tab.mouse
    visitor.drawn()
    assert race.frame.time == 0  # time waits for the visitor
    start = race.frame.positions[0, 16 * 17 + 8 - 4 * 17].astype(float)
    across, down = visitor.on_screen(start)
    mouse.move(across, down)
    mouse.down()
    for step in range(1, 9):
        mouse.move(across + 12 * step, down - 6 * step)
    visitor.until(lambda: race.frame.time > 0.3)
    moved = np.mean([one.position for one in race.mine.attachments()], axis=0) - race.mine.recording.frames[0].positions[0].mean(
        axis=0
    )
    assert moved[1] > 0.05
    mouse.up()
    visitor.tab.get_by_role("button", name="Let go").click()
    visitor.until(lambda: "evaluation" in race.notes)
    assert "Yours: Evaluated" in race.notes["evaluation"] and race.theirs.info["normalized_performance"] > 0.5
    visitor.tab.get_by_text("Yours: Evaluated").first.wait_for(timeout=1e3 * DEADLINE)


def test_a_link_opens_the_page_with_its_settings_and_a_phone_shows_the_sheet_alone(playground, chromium):
    other = Visitor(playground, chromium, 390, 844, "?scene=sphere&gravity=2.5&fabric=silk")
    assert other.stage.name == "sphere" and (other.stage.settings.gravity, other.stage.settings.fabric) == (2.5, "silk")
    other.until(lambda: not other.tab.get_by_text("gravity m/s²").first.is_visible())
    box = other.tab.locator("canvas").first.bounding_box()
    assert (box["width"], box["height"]) == (390, 844)
    assert not [text for kind, text in other.said if kind == "error" and not text.startswith(KNOWN)]
    other.tab.close()


def test_menus_switch_the_integrator_and_the_colors(visitor):
    visitor.page.order("open", "Pinned patch")
    visitor.until(lambda: visitor.stage.name == "patch")
    visitor.choose("integrator", "verlet")
    visitor.until(lambda: visitor.stage.sheets[0].simulation.integrator.name == "verlet")
    visitor.drawn()
    red = visitor.picture()
    visitor.tab.get_by_text("Hands and colors").click()
    visitor.choose("color by", "strain")

    def darker():
        gone = red - visitor.picture()
        return np.mean((gone[:, :, 0] > 50) & (gone[:, :, 0] > gone[:, :, 2] + 30)) > 0.02

    visitor.until(darker)


def test_two_visitors_have_a_cloth_each_and_a_killed_browser_leaves_the_server_well(playground, visitor):
    with second_browser() as (process, port):
        browser = visitor.tab.context.browser.browser_type.connect_over_cdp(f"http://{LOOPBACK}:{port}", timeout=1e3 * DEADLINE)
        other = Visitor(playground, browser.contexts[0], 320, 240)  # a browser without a graphics card is slow
        steps = visitor.stage.steps
        assert other.stage is not visitor.stage
        other.until(lambda: len(other.stage.recording.frames) > 5)
        visitor.page.order("change", {"gravity": 9.81})
        visitor.until(lambda: visitor.stage.frame.positions[0, :, 2].min() < 0.4)
        assert other.stage.settings.gravity == 0 and other.stage.frame.positions[0, :, 2].min() > 0.5
        thread = other.visit.thread
        os.killpg(process.pid, signal.SIGKILL)
        until(lambda: other.visit not in playground.visits.values())
        until(lambda: not thread.is_alive())
    visitor.until(lambda: visitor.stage.steps > steps + 10)
    assert visitor.visit.thread.is_alive() and playground.visits


def test_pages_of_other_origins_and_of_a_rebound_name_do_not_come_in(playground, chromium):
    enter = """([address, protocol]) => new Promise((done) => {
        const socket = new WebSocket(address, protocol);
        socket.onopen = () => done(true);
        socket.onclose = () => done(false);
    })"""
    port, protocol = playground.access.port, f"viser-v{viser.__version__}"
    near, rebound = f"ws://{LOOPBACK}:{port}/", f"ws://evil.example:{port}/"
    with other_site() as site, contextlib.closing(chromium.new_page()) as tab:
        for name in ("evil.example", LOOPBACK):
            tab.goto(f"http://{name}:{site}/")
            assert not tab.evaluate(enter, [near, protocol])
        # a name that now means this machine: neither the page nor, from the refusal, the websocket
        assert tab.goto(f"http://evil.example:{port}/").status == 403
        assert not tab.evaluate(enter, [near, protocol]) and not tab.evaluate(enter, [rebound, protocol])
        # the same from the server's own address
        assert tab.goto(playground.url).status == 200
        assert tab.evaluate(enter, [near, protocol])


@contextlib.contextmanager
def other_site():
    """The port of a server with an empty page."""
    with http.server.ThreadingHTTPServer((LOOPBACK, 0), EmptyPage) as running:
        threading.Thread(target=running.serve_forever).start()
        try:
            yield running.server_port
        finally:
            running.shutdown()


class EmptyPage(http.server.BaseHTTPRequestHandler):
    def do_GET(self):
        self.send_response(200)
        self.send_header("Content-Length", "0")
        self.end_headers()

    def log_message(self, *_):
        """Say nothing."""


def test_nothing_listens_beyond_loopback(playground):
    assert playground.server.request_share_url() is None  # viser's own opens a tunnel to the world
    port = int(playground.url.rsplit(":", 1)[1])
    addresses = {info[4][0] for info in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET)} - {LOOPBACK}
    for address in addresses:
        if not address.startswith("127."):
            with socket.socket() as probe:
                probe.settimeout(1.0)
                assert probe.connect_ex((address, port)) != 0
    assert listening_at(port) in ({"0100007F"}, set())


def listening_at(port):
    """Local addresses, in the kernel's hexadecimal, at which this machine listens on that port; none where it does not tell."""
    found = set()
    for table in ("/proc/net/tcp", "/proc/net/tcp6"):
        if os.path.exists(table):
            with open(table) as file:
                for line in list(file)[1:]:
                    local, state = line.split()[1], line.split()[3]
                    address, at = local.split(":")
                    if int(at, 16) == port and state == "0A":
                        found.add(address)
    return found
