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

DEADLINE = 90.0  # seconds for what is waited for: kernels may have to be compiled, beside other tests
REBOUND = "--host-resolver-rules=MAP evil.example 127.0.0.1"
FLAGS = [REBOUND, "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox", "--disable-dev-shm-usage"]
# another library's word on its own dependency
KNOWN = ("THREE.Clock",)


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

    def __init__(self, playground, browser, width=1000, height=620):
        known = set(playground.visits)
        self.said, self.asked = [], []
        self.tab = browser.new_page()
        self.tab.set_viewport_size({"width": width, "height": height})
        self.tab.on("console", lambda message: self.said.append((message.type, message.text)))
        self.tab.on("pageerror", lambda error: self.said.append(("error", str(error))))
        self.tab.on("request", lambda request: self.asked.append(request.url))
        self.tab.goto(playground.url, timeout=1e3 * DEADLINE)
        self.visit = until(lambda: self._arrived(playground, known))
        self.tab.get_by_text("gravity m/s²").wait_for(timeout=1e3 * DEADLINE)

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
        self.box(label).click()
        self.tab.get_by_role("option", name=option, exact=True).click()

    def picture(self):
        """What the middle of the window shows, between the panels, (height, width, 3)."""
        clip = {"x": 280, "y": 190, "width": 370, "height": 420}
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


def test_the_gravity_slider_moves_the_cloth_and_its_pins_stay_to_the_last_bit(visitor):
    start, pins = visitor.stage.recording.frames[0].positions[0], list(visitor.stage.scene.anchors)
    assert np.abs(visitor.stage.frame.positions[0] - start).max() < 1e-6
    before = visitor.picture()
    visitor.set_number("gravity m/s²", 9.81)
    visitor.until(lambda: visitor.stage.frame.positions[0, :, 2].min() < 0.5)
    assert np.array_equal(visitor.stage.frame.positions[0][pins], start[pins])
    # the sheet has left where it lay flat, seen from above, and hangs where there was floor; the rest of the room is as it was
    visitor.until(lambda: np.mean(np.abs(visitor.picture() - before).max(axis=2) > 25) > 0.1)
    after = visitor.picture()
    assert np.mean(np.abs(after - before).max(axis=2)[-40:] > 40) < 0.05


def test_the_most_strained_thread_that_the_page_names_is_the_cores(visitor):
    visitor.tab.get_by_text("play / pause").click()
    visitor.until(lambda: not visitor.page.playing)
    s, mesh = visitor.stage.sheets[0].simulation, visitor.stage.scene.mesh
    strain = s.strain()[0]
    # the sheet is symmetric: several are the most strained, but for rounding
    most = mesh.springs.particles[mesh.springs.kind < 3][strain > strain.max() - 2e-5]
    named = [visitor.tab.get_by_role("cell", name=f"{i} to {j}", exact=True) for i, j in most]
    visitor.until(lambda: sum(cell.count() for cell in named) == 1)
    visitor.until(lambda: visitor.tab.get_by_role("cell", name=f"{100 * strain.max():.2f} %", exact=True).count() == 1)
    # what was sent to the browser is red where the core is most strained
    node = visitor.page.show._yarns[0]
    springs = yarns(mesh)
    loud = np.argsort(strain)[-6:]
    assert np.array_equal(node.points[loud], s.positions[0][mesh.springs.particles[springs[loud]]])
    assert np.all(node.colors[loud, :, 0] > 150) and np.all(node.colors[loud, :, 1] < 40)
    visitor.tab.get_by_text("play / pause").click()


def test_menus_switch_the_integrator_and_the_colors(visitor):
    visitor.choose("integrator", "verlet")
    visitor.until(lambda: visitor.stage.sheets[0].simulation.integrator.name == "verlet")
    visitor.tab.get_by_text("verlet", exact=True).first.wait_for(timeout=1e3 * DEADLINE)
    dark = visitor.picture()
    visitor.choose("color by", "fabric")

    def reddish():
        red = visitor.picture() - dark
        return np.mean((red[:, :, 0] > 50) & (red[:, :, 0] > red[:, :, 2] + 30)) > 0.05

    visitor.until(reddish)


def test_two_visitors_have_a_cloth_each_and_a_killed_browser_leaves_the_server_well(playground, visitor):
    with second_browser() as (process, port):
        browser = visitor.tab.context.browser.browser_type.connect_over_cdp(f"http://{LOOPBACK}:{port}", timeout=1e3 * DEADLINE)
        other = Visitor(playground, browser.contexts[0], 320, 240)  # a browser without a graphics card is slow
        frames = len(visitor.stage.recording.frames)
        assert other.stage is not visitor.stage
        other.until(lambda: len(other.stage.recording.frames) > 5)
        assert np.abs(other.stage.frame.positions[0] - other.stage.scene.start).max() < 1e-6
        assert np.abs(visitor.stage.frame.positions[0] - visitor.stage.scene.start).max() > 0.1
        thread = other.visit.thread
        os.killpg(process.pid, signal.SIGKILL)
        until(lambda: other.visit not in playground.visits.values())
        until(lambda: not thread.is_alive())
    visitor.until(lambda: len(visitor.stage.recording.frames) > frames + 5)
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
