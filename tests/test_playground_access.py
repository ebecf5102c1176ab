"""Floor 8: who may visit the playground, asked of the running server; and what a hostile browser may send."""

import asyncio
import contextlib
import http.client
import socket
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from stages import page, turned

from clothgym.cli import main
from clothgym.playground import access, server
from clothgym.playground.controls import MOST_SUBSTEPS
from clothgym.playground.episode import EpisodeStage
from clothgym.playground.gallery import Gallery
from clothgym.playground.page import FRAME_BUDGET, MOST_ORDERS
from clothgym.playground.stage import SceneStage

DEADLINE = 60.0  # seconds for what is waited for


@pytest.fixture(scope="module")
def running():
    pytest.importorskip("websockets")
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


def connected(port, origin=None, path="/"):
    """A websocket."""
    from websockets.sync.client import connect

    return connect(f"ws://127.0.0.1:{port}{path}", origin=origin, open_timeout=20, proxy=None)


def visited(port, origin, path="/"):
    """The status with which a websocket is answered: 101 for one that may come in."""
    from websockets.exceptions import InvalidStatus

    try:
        with connected(port, origin, path):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def answered(port, *lines):
    """The whole answer to a request of these lines."""
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(b"\r\n".join([*lines, b"Connection: close", b"", b""]))
        return b"".join(iter(lambda: client.recv(65536), b""))


def until(what):
    """The first true outcome."""
    end = time.monotonic() + DEADLINE
    while time.monotonic() < end:
        outcome = what()
        if outcome:
            return outcome
        threading.Event().wait(0.005)
    raise AssertionError("it did not happen in time")


# lines of requests that are refused, with the status
STRANGE = [
    ([b"GET / HTTP/1.1"], 400),
    ([b"GET / HTTP/1.1", b"Host: HOST", b"Host: HOST"], 400),
    ([b"GET //[ HTTP/1.1", b"Host: HOST"], 400),
    ([b"GET / HTTP/1.1", b"Host: HOST", b"Origin: http://["], 400),
    ([b"GET / HTTP/1.1", b"Host: HOST", b"Upgrade: websocket", b"Upgrade: websocket"], 400),
    ([b"GET / HTTP/1.1", b"Host: \xff"], 403),
    ([b"GET / HTTP/1.1", b"Host: HOST", b"Origin: http://\xff"], 403),
]


# --- whose requests pass ------------------------------------------------------------------------------------------------------


def test_the_page_itself_and_programs_that_are_no_browsers_come_in_and_other_sites_may_not_frame_it(running):
    port = running.access.port
    status, headers, text = asked(port)
    assert status == asked(port, f"localhost:{port}", f"http://localhost:{port}")[0] == 200 and "<html" in text
    assert headers["Content-Security-Policy"].startswith("frame-ancestors 'self'")
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


@pytest.mark.parametrize(("lines", "status"), STRANGE)
def test_a_malformed_request_is_refused_and_leaves_no_traceback(running, lines, status, caplog):
    port = running.access.port
    lines = [line.replace(b"HOST", b"127.0.0.1:%d" % port) for line in lines]
    assert answered(port, *lines).startswith(b"HTTP/1.1 %d" % status)
    assert not any(record.exc_info for record in caplog.records)


def test_beyond_loopback_a_token_is_needed_and_the_page_remembers_it():
    pytest.importorskip("websockets")
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
        # no answer to a stranger holds the token, whatever is asked
        for lines, _ in STRANGE:
            assert token.encode() not in answered(port, *lines)
    finally:
        playground.stop()


@pytest.mark.parametrize(
    ("host", "alone"),
    [("127.0.0.1", True), ("127.8.8.8", True), ("::1", True), ("localhost", True), ("0.0.0.0", False), ("", False)],
)
def test_only_loopback_needs_no_token(host, alone):
    assert (access.Access(host, 8080).token == "") == alone


def test_a_full_playground_says_so(running, monkeypatch):
    monkeypatch.setattr(running, "visits", [None] * access.MOST_VISITS)
    status, _, text = asked(running.access.port)
    assert status == 503 and f"full, with {access.MOST_VISITS} visitors" in text
    assert visited(running.access.port, None) == 503


def test_a_visit_ends_with_its_visitor_whose_thread_counts_until_it_does(running, monkeypatch):
    inside, ready = threading.Event(), threading.Event()

    def long_step(stage):
        inside.set()
        assert ready.wait(DEADLINE)
        return stage.frame

    monkeypatch.setattr(SceneStage, "advance", long_step)
    monkeypatch.setattr(server, "MOST_VISITS", 1)
    port = running.access.port
    try:
        until(lambda: not running._busy())
        with connected(port):
            assert inside.wait(DEADLINE)
            (visit,) = running.visits
            for _ in range(1000):
                visit.page.order("press", "step")
        # they have left in the midst of a step, with orders still to come
        assert visit.closed.wait(DEADLINE)
        until(lambda: not running.visits)
        assert visit.thread.is_alive() and visited(port, None) == 503
    finally:
        ready.set()
    visit.thread.join(DEADLINE)
    assert not visit.thread.is_alive() and visit.frames <= 1
    until(lambda: visited(port, None) == 101)


# --- what a browser may send --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "message",
    [
        b"\xc1",
        "text",
        "7",
        '["turn", 5]',
        '["turn", ["no such", 1]]',
        '["turn", [[], 1]]',
        '["stop", 1]',
        '["grasp", ["start"]]',
        '{"a": 1}',
    ],
)
def test_a_message_that_makes_no_sense_ends_its_visit_with_a_sentence(running, message, capsys, caplog):
    from websockets.exceptions import ConnectionClosed

    with connected(running.access.port) as client, pytest.raises(ConnectionClosed, match="cannot be read"):
        visit = until(lambda: running.visits[-1] if running.visits else None)
        until(lambda: visit.page)
        client.send(message)
        while True:
            client.recv(timeout=DEADLINE)
    said = capsys.readouterr().err
    assert said.startswith("A visitor has sent what makes no sense: ") and said.count("\n") == 1
    assert not any(record.exc_info for record in caplog.records)
    until(lambda: not running.visits)


def test_what_is_sent_are_messages_in_order_and_of_the_frames_that_wait_the_last():
    loop = asyncio.new_event_loop()
    client, sent = server.Client(loop), []

    class Connection:
        async def send(self, message):
            sent.append(message)

    async def send_for_a_while():
        await asyncio.wait_for(client.send_to(Connection()), 0.2)

    client.draw(b"first")
    client.tell("solids", [1])
    client.draw(b"second")
    client.give("a.npz", b"content")
    with pytest.raises(TimeoutError):
        loop.run_until_complete(send_for_a_while())
    loop.close()
    assert sent == ['{"solids": [1]}', '{"file": "a.npz"}', b"content", b"second"]


def test_the_page_and_its_parts_are_served_and_nothing_else(running):
    port = running.access.port
    for name, kind in (("/", "text/html"), ("/viewer.js", "text/javascript"), ("/look.css", "text/css")):
        status, headers, text = asked(port, path=name)
        assert status == 200 and headers["Content-Type"].startswith(kind) and len(text.encode()) == int(headers["Content-Length"])
    for name in ("/server.py", "/../server.py", "/web/viewer.js", "/%2e%2e/server.py"):
        assert asked(port, path=name)[0] == 404


@pytest.mark.parametrize("value", [1e9, float("inf"), float("nan"), -1e12, "1e9", None, [3]])
def test_sliders_stay_within_their_ranges_for_any_input(value):
    visitor, client = page()
    turned(visitor, auto=False)
    for name in ("substeps", "stretch_stiffness", "gravity", "wind", "moment"):
        turned(visitor, **{name: value})
    turned(visitor, seed=value, play="reset")
    settings, stage = visitor.stage.settings, visitor.stage
    if value not in (1e9, -1e12, "1e9"):
        # neither the lowest nor the largest: nothing changes
        assert settings == SceneStage("patch").settings.changed(substeps=settings.substeps) and stage.seed == 0
        assert any(title == "Not possible" and words.startswith("Gravity, m/s²=") for title, words in client.said)
        assert client.controls["gravity"]["value"] == settings.gravity
    assert 1 <= settings.substeps <= MOST_SUBSTEPS and 0 <= settings.stretch_stiffness <= 2000
    assert 0 <= settings.gravity <= 9.81 and 0 <= settings.wind <= 12 and 0 <= visitor.moment < len(stage.recording.frames)
    assert np.isfinite(stage.frame.positions).all()


def test_a_choice_that_is_none_changes_nothing():
    visitor, _ = page()
    before = visitor.stage.settings
    for name in ("scene", "fabric", "integrator", "bending", "self_collision", "show", "kind", "presets"):
        for value in ("no such thing", None, [3]):
            turned(visitor, **{name: value})
    assert visitor.stage.settings == before and visitor.stage.name == "patch" and visitor.playing


@pytest.mark.parametrize("value", [float("nan"), 1e300])
def test_a_drag_or_a_click_to_nowhere_moves_nothing_to_nowhere(value):
    visitor, client = page()
    visitor.tick()
    place = visitor.stage.frame.positions[0, 144].tolist()
    for phase in ("start", "update", "end"):
        for there in ([value] * 3, [0.0, value, 0.0], "here", [[]], 7):
            visitor.take(["grasp", [phase, there]])
    for where, way in (([value] * 3, [0.0, 0.0, -1.0]), (place, [value] * 3), (None, "down")):
        visitor.take(["touch", [False, where, way]])
        visitor.take(["touch", [True, where, way]])
    for _ in range(5):
        visitor.tick()
    assert np.isfinite(visitor.stage.frame.positions).all() and not visitor.stage.notes
    episode = EpisodeStage("ClothReach-v0")
    episode.grab(episode.places[0])
    episode.pull([1e30, -1e30, 0.5])
    np.testing.assert_array_equal(episode._dragged[0], [9.0, -9.0, 0.5])


def test_nothing_is_done_for_a_visitor_who_has_left():
    left = threading.Event()
    visitor, _ = page(left=left.is_set)
    visitor.tick()
    steps, frames = visitor.stage.steps, len(visitor.stage.recording.frames)
    for _ in range(MOST_ORDERS + 5):  # those beyond are dropped
        visitor.order("press", "step")
    assert visitor._orders.qsize() == MOST_ORDERS
    left.set()
    visitor.tick()
    assert (visitor.stage.steps, len(visitor.stage.recording.frames)) == (steps, frames)


def test_orders_and_frames_that_take_long_are_cut_short_and_only_on_a_page(monkeypatch):
    visitor, _ = page()
    visitor.tick()
    clock = iter(np.arange(0, 1e6, FRAME_BUDGET * 0.6))
    monkeypatch.setattr("clothgym.playground.page.time.monotonic", lambda: float(next(clock)))
    for _ in range(10):
        visitor.order("drop")
    visitor.tick()
    assert len(visitor._later) == 9
    clock = iter(np.arange(0, 1e3, FRAME_BUDGET * 1.1))
    monkeypatch.setattr("clothgym.playground.stage.time.perf_counter", lambda: float(next(clock)))
    alone, steps = SceneStage("patch"), visitor.stage.steps
    visitor.stage.advance()
    alone.advance()
    # a film that is exported does not depend on how fast the machine is
    assert (visitor.stage.steps - steps, alone.steps) == (0, 2)


# --- the server's door --------------------------------------------------------------------------------------------------------


def test_loopback_is_the_default_and_a_port_in_use_gives_the_next(running):
    assert server.LOOPBACK == "127.0.0.1"
    assert server.serve.__defaults__[0] == server.Playground.__init__.__defaults__[0] == server.LOOPBACK
    other = server.Playground(Gallery(), "patch", port=running.access.port)
    try:
        assert other.access.port > running.access.port and asked(other.access.port)[0] == 200
    finally:
        other.stop()
    with pytest.raises(OSError):
        asked(other.access.port)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["flagg"], "did you mean 'flag'"),
        (["--host", "300.1.1.1"], "cannot listen there"),
        (["--replay", "nowhere.npz"], "nowhere.npz"),
        (["--policy", "nowhere"], "no policy 'nowhere' (there are: noop, random, expert"),
    ],
)
def test_the_command_reports_wrong_arguments(arguments, words, capsys):
    pytest.importorskip("websockets")
    with pytest.raises(SystemExit):
        main(["view", *arguments])
    assert words in capsys.readouterr().err


def test_without_its_server_there_is_a_sentence(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "websockets.asyncio.server", None)
    with pytest.raises(SystemExit):
        main(["view"])
    assert "pip install 'clothgym[view]'" in capsys.readouterr().err


def test_nothing_listens_beyond_loopback(running):
    port = running.access.port
    assert listening_at(port) in ({"0100007F"}, set())


def listening_at(port):
    """Local addresses, in the kernel's hexadecimal, at which this machine listens on that port; none where it does not tell."""
    tables = [path for path in (Path("/proc/net/tcp"), Path("/proc/net/tcp6")) if path.exists()]
    rows = [line.split() for path in tables for line in path.read_text().splitlines()[1:]]
    ends = [row[1].split(":") for row in rows if row[3] == "0A"]
    return {address for address, at in ends if int(at, 16) == port}
