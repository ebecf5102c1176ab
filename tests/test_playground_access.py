"""Floor 8: who may visit the playground, asked of the running server; and what a hostile browser may send."""

import contextlib
import http.client
import threading

import numpy as np
import pytest

from clothgym.playground import access, server
from clothgym.playground.null import NullClient
from clothgym.playground.page import MOST_SUBSTEPS, Page
from clothgym.playground.stage import FRAME_BUDGET, SceneStage

PROTOCOL = "viser-v1.1.1"


@pytest.fixture(scope="module")
def running():
    pytest.importorskip("viser")
    playground = server.serve("patch", port=0, tell=lambda _: None)
    yield playground
    playground.stop()


def asked(port, host=None, origin=None, path="/", cookie=None):
    """Status, headers and text of a request."""
    headers = {"Host": host or f"127.0.0.1:{port}", "Origin": origin, "Cookie": cookie}
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=20)) as connection:
        connection.request("GET", path, headers={name: value for name, value in headers.items() if value})
        answer = connection.getresponse()
        return answer.status, answer.headers, answer.read().decode(errors="replace")


def visited(port, origin, host="127.0.0.1", path="/"):
    """The status with which a websocket is answered: 101 for one that may come in."""
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect

    try:
        with connect(f"ws://{host}:{port}{path}", subprotocols=[PROTOCOL], origin=origin, open_timeout=20, proxy=None):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


# --- whose requests pass ------------------------------------------------------------------------------------------------------


def test_the_page_itself_and_programs_that_are_no_browsers_come_in(running):
    port = running.access.port
    assert asked(port)[0] == asked(port, f"localhost:{port}", f"http://localhost:{port}")[0] == 200
    for origin in (f"http://127.0.0.1:{port}", None):
        assert visited(port, origin) == 101


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://localhost", "http://127.0.0.1:1", "file://"])
def test_pages_of_other_origins_do_not(running, origin):
    assert visited(running.access.port, origin) == 403 == asked(running.access.port, origin=origin)[0]


@pytest.mark.parametrize("host", ["attacker.com", "attacker.com:{}", "127.0.0.1", "localhost:1", "127.0.0.1:{}.evil.example"])
def test_a_name_that_was_rebound_to_this_machine_does_not(running, host):
    port = running.access.port
    name = host.format(port)
    status, _, text = asked(port, name)
    assert status == 403 and f"http://127.0.0.1:{port}" in text
    assert asked(port, name, f"http://{name}")[0] == 403


def test_other_sites_may_not_frame_the_page(running):
    _, headers, _ = asked(running.access.port)
    assert headers["Content-Security-Policy"].startswith("frame-ancestors 'self'")


def test_beyond_loopback_a_token_is_needed_and_the_page_remembers_it():
    pytest.importorskip("viser")
    said = []
    playground = server.serve("patch", host="0.0.0.0", port=0, tell=said.append)
    try:
        port, token = playground.access.port, playground.access.token
        assert len(token) >= 32 and playground.url.endswith(f":{port}/?token={token}")
        assert any("other machines can reach this page" in line for line in said) and playground.url in said[-1]
        # neither without it nor with another; nor through a page that has another name for this address
        for path in ("/", "/?token=", "/?token=" + "A" * len(token), "/assets/x.js"):
            assert asked(port, path=path)[0] == 403
        assert visited(port, f"http://127.0.0.1:{port}") == visited(port, None) == 403
        status, headers, _ = asked(port, path=f"/?token={token}")
        cookie = headers["Set-Cookie"]
        assert status == 200 and "HttpOnly" in cookie and "SameSite=Strict" in cookie
        assert asked(port, cookie=cookie.split(";")[0])[0] == 200
        assert visited(port, None, path=f"/?token={token}") == 101
        assert visited(port, "http://evil.example", path=f"/?token={token}") == 403
    finally:
        playground.stop()


def test_a_viser_that_cannot_be_guarded_is_not_opened(monkeypatch):
    pytest.importorskip("viser")
    monkeypatch.setattr(access.Access, "guarded", lambda self, process: process)
    with pytest.raises(RuntimeError, match="cannot be guarded"):
        server.Playground(server.Gallery(), "patch", port=0)


@pytest.mark.parametrize(
    ("host", "alone"),
    [("127.0.0.1", True), ("127.8.8.8", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("", False)],
)
def test_only_loopback_needs_no_token(host, alone):
    assert (access.Access(host, 8080).token == "") == alone


def test_a_full_playground_says_so(running, monkeypatch):
    monkeypatch.setattr(running, "visits", dict.fromkeys(range(access.MOST_VISITS)))
    status, _, text = asked(running.access.port)
    assert status == 503 and f"full, with {access.MOST_VISITS} visitors" in text
    assert visited(running.access.port, None) == 503


# --- what a browser may send --------------------------------------------------------------------------------------------------


def page(left=lambda: False):
    client, gallery = NullClient(), server.Gallery()
    return Page(client, gallery.open, gallery.titles, "patch", left), client


@pytest.mark.parametrize("value", [1e9, float("inf"), float("nan"), -1e12, "1e9", None, [3]])
def test_sliders_stay_within_their_ranges_whatever_is_sent(value):
    visitor, client = page()
    handles = client.gui.handles
    handles["by the bound"].turn(False)
    for label in ("substeps", "yarns N/m", "gravity m/s²", "wind m/s", "moment"):
        # a browser may change a control's own range, too
        handles[label].max = 1e300
        handles[label].turn(value)
        visitor.tick()
    handles["seed"].value = value
    handles[""].turn("reset")
    visitor.tick()
    settings, stage = visitor.stage.settings, visitor.stage
    assert 1 <= settings.substeps <= MOST_SUBSTEPS and 0 <= settings.stretch_stiffness <= 2000
    assert 0 <= settings.gravity <= 9.81 and 0 <= settings.wind <= 12 and 0 <= visitor.moment < len(stage.recording.frames)
    assert np.isfinite(stage.frame.positions).all()


@pytest.mark.parametrize("label", ["scene", "fabric", "integrator", "bending", "with itself", "color by", "as", "sheet 1"])
def test_a_choice_that_is_none_changes_nothing(label):
    visitor, client = page()
    before = visitor.stage.settings
    client.gui.handles[label].turn("no such thing")
    visitor.tick()
    visitor.tick()
    assert visitor.stage.settings == before and visitor.stage.name == "patch" and visitor.playing


def test_a_frame_is_cut_short_where_it_takes_too_long(monkeypatch):
    stage = SceneStage("patch")
    clock = iter(np.arange(0, 1e3, FRAME_BUDGET * 0.9))
    monkeypatch.setattr("clothgym.playground.stage.time.perf_counter", lambda: float(next(clock)))
    stage.advance()
    assert stage.steps == 1


def test_a_film_ends_with_its_visitor():
    left = threading.Event()
    visitor, client = page(left.is_set)
    for _ in range(3):
        visitor.tick()
    left.set()
    client.gui.handles["as"].value = "film (GIF)"
    client.gui.handles["Save"].turn(True)
    visitor.tick()
    assert not client.files and "the visitor has left" in client.notifications[-1]
