"""A hostile browser: requests and websocket messages that no page of ours sends.  Whatever comes, the server goes on.

Each attack has a connection of its own to a server in this process.  After it the server answers a sound request, and what
the visit has simulated has settings within their ranges and a finite cloth; a visit that has ended leaves nothing behind.
"""

from __future__ import annotations

import contextlib
import http.client
import io
import socket
import threading
import time
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

import numpy as np

from clothgym.playground import server
from clothgym.playground.controls import MOST_SUBSTEPS

SECONDS = 20.0  # in which the server answers
MESSAGES = 12  # of an attack
TYPES = (
    "GuiUpdateMessage", "ViewerCameraMessage", "TransformControlsUpdateMessage", "TransformControlsDragStartMessage",
    "TransformControlsDragEndMessage", "SceneNodeClickMessage", "ScenePointerMessage", "GuiButtonHoldMessage",
    "GuiFormSubmitMessage", "FileTransferStartUpload", "FileTransferPart", "FileTransferPartAck", "RunJavascriptMessage",
    "ShareUrlRequest", "Message", "",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, 0, -1, 1, 7, 2**53, 1e9, 1e308, float("nan"), float("inf"), "", "strict", "1e9", "x" * 10**5, b"\x00" * 99, [], {},
    [1.0, 2.0, 3.0], [float("nan")] * 3, [1e30] * 4, [[1]] * 9, {"a": {"b": []}},
)  # fmt: skip
PROPERTIES = ("value", "value", "value", "min", "max", "step", "options", "disabled", "label", "uuid", "no such")
LINES = (
    b"Host: HOST", b"Host: HOST", b"Host: evil.example", b"Host:", b"Origin: http://evil.example", b"Origin: null",
    b"Origin: http://HOST", b"Upgrade: websocket", b"Connection: Upgrade", b"Content-Length: -1",
    b"Transfer-Encoding: chunked", b"Cookie: " + b"a=b;" * 999,
    b"Sec-WebSocket-Key: x", b"X: " + b"y" * 9000, b"\xff\xfe: \x00", b": nothing", b"no colon",
)  # fmt: skip
TARGETS = (
    b"/", b"/?token=x", b"/../../etc/passwd", b"/%2e%2e/%2e%2e/etc/passwd", b"//[", b"/" + b"x" * 9000, b"\x00", b"*",
    b"http://evil/",
)  # fmt: skip


def attacks(rng: np.random.Generator) -> Iterator[tuple[str, Callable[[], None]]]:
    """Without end: what to paste, and what it does."""
    while True:
        form, seed = (requested, sent)[rng.integers(2)], int(rng.integers(2**31))
        yield f"attacks.protocol.{form.__name__}({seed})", lambda form=form, seed=seed: form(seed)  # type: ignore[misc]


def requested(seed: int) -> None:
    """A request of lines that do not belong together.

    Raises:
        AssertionError: it is served although it is none of ours, or the server is gone.
    """
    rng, port = np.random.default_rng(seed), _running().access.port
    method = [b"GET", b"GET", b"GET", b"POST", b"BREW", b""][rng.integers(6)]
    lines = [LINES[one] for one in rng.integers(len(LINES), size=rng.integers(6))]
    host = b"127.0.0.1:%d" % port
    content = b"\r\n".join([method + b" " + TARGETS[rng.integers(len(TARGETS))] + b" HTTP/1.1", *lines, b"", b""]).replace(
        b"HOST", host
    )
    if rng.random() < 0.2:
        content = rng.bytes(int(rng.integers(1, 999)))
    with socket.create_connection(("127.0.0.1", port), timeout=SECONDS) as client, contextlib.suppress(ConnectionError):
        client.sendall(content)
        client.shutdown(socket.SHUT_WR)
        answer = b"".join(iter(lambda: client.recv(65536), b""))
        assert b"root:" not in answer, "it serves this machine's files"
        hosts = [line for line in lines if line.startswith(b"Host:")]
        strange = hosts != [b"Host: HOST"] or any(b"evil" in line or b"null" in line for line in lines)
        assert not (strange and answer.startswith((b"HTTP/1.1 200", b"HTTP/1.1 101"))), answer[:60]
    _stands()


def sent(seed: int) -> None:
    """Messages within a visit.

    Raises:
        AssertionError: the visit takes nonsense, dies while its visitor is there, or outlives them.
    """
    import msgspec
    import viser
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    rng, running = np.random.default_rng(seed), _running()
    before = set(running.visits)
    url = f"ws://127.0.0.1:{running.access.port}"
    with connect(url, subprotocols=[f"viser-v{viser.__version__}"], open_timeout=SECONDS, proxy=None) as client:  # type: ignore[list-item]
        client.send(msgspec.msgpack.encode(CAMERA))
        visit = _until(lambda: next((running.visits[one] for one in list(running.visits) if one not in before), None))
        _until(lambda: visit.page is not None and visit.frames)
        with contextlib.suppress(ConnectionClosed):
            for _ in range(rng.integers(1, MESSAGES)):
                client.send(_message(visit, rng, msgspec.msgpack.encode))
            # all has been taken when two more frames are there, or the connection is closed
            frames = visit.frames
            _until(lambda: visit.frames > frames + 1 or visit.closed.is_set() or not visit.thread.is_alive())
            assert visit.closed.is_set() or visit.thread.is_alive(), "the visit has died while its visitor was there"
        _sound(visit.page.stage)
    _until(visit.closed.is_set)
    visit.thread.join(SECONDS)
    assert not visit.thread.is_alive(), "the visit outlives its visitor"
    _stands()


CAMERA = {
    "type": "ViewerCameraMessage", "wxyz": [1, 0, 0, 0], "position": [1, -1, 1], "look_at": [0, 0, 0], "up_direction": [0, 0, 1],
    "near": 0.1, "far": 10.0, "fov": 0.6, "image_height": 9, "image_width": 9,
}  # fmt: skip


def _message(visit: Any, rng: np.random.Generator, encode: Callable[[Any], bytes]) -> bytes | str:
    """What a browser could send: to a control that is there, in most cases."""

    def some() -> Any:
        return VALUES[rng.integers(len(VALUES))]

    handles = list(visit.page.client.gui._gui_input_handle_from_uuid)
    form = rng.integers(10)
    if form < 6 and handles:
        names = [PROPERTIES[one] for one in rng.integers(len(PROPERTIES), size=rng.integers(1, 3))]
        return encode({"type": TYPES[0], "uuid": handles[rng.integers(len(handles))], "updates": {name: some() for name in names}})
    if form == 6:
        return encode({**CAMERA, list(CAMERA)[rng.integers(1, len(CAMERA))]: some()})
    if form == 7:
        names = (
            "uuid",
            "name",
            "updates",
            "position",
            "wxyz",
            "source_component_uuid",
            "transfer_uuid",
            "size_bytes",
            "part_count",
            "content",
        )
        return encode({"type": TYPES[rng.integers(len(TYPES))], **{name: some() for name in names if rng.random() < 0.5}})
    if form == 8:
        return encode(some())
    return rng.bytes(int(rng.integers(1, 99))) if rng.random() < 0.7 else "text"


def _sound(stage: Any) -> None:
    """Whatever was sent, what is simulated makes sense."""
    assert np.isfinite(stage.frame.positions).all(), "the cloth is not finite"
    settings = getattr(stage, "settings", None)
    if settings is None:  # an environment's
        return
    assert settings.substeps == "auto" or 1 <= settings.substeps <= MOST_SUBSTEPS, settings
    assert 0 <= settings.stretch_stiffness <= 2000, settings
    assert abs(settings.gravity) <= 10 and 0 <= settings.wind <= 12, settings


def _until(what: Callable[[], Any]) -> Any:
    """The first true outcome."""
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        if outcome := what():
            return outcome
        threading.Event().wait(0.005)
    raise AssertionError("the server did not come to it in time")


def _stands() -> None:
    """The server answers a sound request."""
    connection = http.client.HTTPConnection("127.0.0.1", _running().access.port, timeout=SECONDS)
    with contextlib.closing(connection):
        connection.request("GET", "/")
        assert connection.getresponse().status == 200, "the server does not answer any more"


@cache
def _running() -> Any:
    with contextlib.redirect_stdout(io.StringIO()):
        return server.serve("patch", port=0, tell=lambda _: None)
