"""The server: a page for each visitor, with cloth of their own."""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from clothgym.checks import shown
from clothgym.playground.access import MOST_VISITS, PAGES, Access, is_loopback
from clothgym.playground.episode import Policy
from clothgym.playground.gallery import REPLAY, Gallery
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording

LOOPBACK = "127.0.0.1"
PORT, TRIED = 8080, 100  # the first port, and how many are tried
TELL = partial(print, flush=True)  # at once, also into a pipe
EASE = 0.002  # shortest pause between two frames, for the server's other threads [s]
WEB = Path(__file__).parent / "web"
TYPES = {".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8", ".css": "text/css; charset=utf-8"}
LONGEST = 4096  # bytes of a message of a browser


class Client:
    """What one browser is sent: messages and files in order, and of the frames that wait the last.

    loop: in which it is sent; other threads may call.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self._loop, self._ready = loop, asyncio.Event()
        self._waiting: list[str | bytes] = []
        self._frame: bytes | None = None

    def tell(self, what: str, content: Any) -> None:
        """Send a message as JSON."""
        self._put(json.dumps({what: content}))

    def give(self, name: str, content: bytes) -> None:
        """Send a file: the message that follows its name."""
        self._put(json.dumps({"file": name}), content)

    def draw(self, frame: bytes) -> None:
        """Send a frame, unless a later one comes before it can be sent."""
        self._frame = frame
        self._put()

    def _put(self, *messages: str | bytes) -> None:
        self._waiting += messages
        with contextlib.suppress(RuntimeError):  # the server has stopped
            self._loop.call_soon_threadsafe(self._ready.set)

    async def send_to(self, connection: Any) -> None:
        """Send what waits, until the connection is closed."""
        while await self._ready.wait():
            self._ready.clear()
            frame, self._frame = self._frame, None  # what it needs has been told before it
            waiting, self._waiting = self._waiting, []
            for message in [*waiting, frame]:
                if message is not None:
                    await connection.send(message)


class Visit:
    """One visitor's page and the thread that it lives in, until they leave.

    asked: query of the page's address; address: of the page, for its link.
    """

    def __init__(self, client: Any, gallery: Gallery, start: str, asked: str = "", address: str = "") -> None:
        self.page: Page | None = None
        self.frames = 0
        self.closed = threading.Event()
        self._client = client
        self._made = lambda: Page(client, gallery, start, self.closed.is_set, asked, address)
        self.thread = threading.Thread(target=self._live, name="visit", daemon=True)
        self.thread.start()

    def _live(self) -> None:
        try:
            self.page = self._made()
            due = time.monotonic()
            while not self.closed.is_set():
                self.page.tick()
                self.frames += 1
                # late frames are not caught up: the cloth is slow then, and no frames pile up
                due = max(due + self.page.stage.recording.time_step, time.monotonic() + EASE)
                self.closed.wait(due - time.monotonic())
        except Exception:
            # after a visitor has left, errors are expected; any other is shown, and ends this visit only
            if not self.closed.wait(1.0):
                traceback.print_exc(file=sys.stderr)
                sorry = "Something went wrong, which the server's terminal shows. Reload the page to start again."
                self._client.tell("say", ["This page has stopped", sorry])


class Playground:
    """A running server.

    Attributes:
        url: where the page is.
        visits: the visitors'.
    """

    def __init__(self, gallery: Gallery, start: str, host: str = LOOPBACK, port: int = PORT) -> None:
        self._serve, self._closed = imported_websockets()
        self.gallery, self.start = gallery, gallery.checked(start)
        self.visits: list[Visit] = []
        self._leaving: list[Visit] = []  # whose visitor has left, and whose thread may still be at its last step
        self.access = Access(host, port, lambda connections: max(connections, self._busy()) >= MOST_VISITS)
        self._files = {f"/{path.name}": (TYPES[path.suffix], path.read_bytes()) for path in WEB.iterdir() if path.suffix in TYPES}
        self._files["/"] = self._files[PAGES[-1]]
        self._loop, self._open, self._ended = asyncio.new_event_loop(), threading.Event(), asyncio.Event()
        self._failed: OSError | None = None
        self._thread = threading.Thread(target=self._run, name="playground", daemon=True)
        self._thread.start()
        self._open.wait()
        if self._failed is not None:
            raise self._failed
        self.url = self.access.url

    def _run(self) -> None:
        self._loop.run_until_complete(self._listen())
        self._loop.close()

    async def _listen(self) -> None:
        options = {"process_request": self.access.guarded(self._answered), "compression": None, "max_size": LONGEST}
        try:
            for port in [self.access.port, *range(self.access.port + 1, self.access.port + TRIED)]:
                try:
                    server = await self._serve(self._welcome, self.access.host or None, port, **options)
                    break
                except OSError as error:  # in use
                    self._failed = error
            else:
                return
            self._failed, self.access.port = None, server.sockets[0].getsockname()[1]
        finally:
            self._open.set()
        try:
            await self._ended.wait()
        finally:
            server.close()
            await server.wait_closed()

    def _answered(self, connection: Any, request: Any) -> Any:
        """The answer to a request for a file; None lets a websocket in."""
        if request.headers.get("Upgrade") is not None:
            return None
        kind, content = self._files.get(urlsplit(request.path).path, ("text/plain", b""))
        response = connection.respond(200 if content else 404, "There is no such file.\n")
        if content:
            del response.headers["Content-Type"], response.headers["Content-Length"]
            response.headers["Content-Type"], response.headers["Content-Length"] = kind, str(len(content))
            response.body = content
        return response

    async def _welcome(self, connection: Any) -> None:
        """A visit, from its first message to its last."""
        if self._busy() >= MOST_VISITS:  # several came at once
            return
        client = Client(asyncio.get_running_loop())
        visit = Visit(client, self.gallery, self.start, urlsplit(connection.request.path).query, self.url)
        self.visits.append(visit)
        sending = asyncio.create_task(client.send_to(connection))
        try:
            async for text in connection:
                message = json.loads(text)
                if visit.page is not None:
                    visit.page.take(message)
        except self._closed:
            pass
        except (ValueError, LookupError, TypeError) as error:
            print(f"A visitor has sent what makes no sense: {shown(error)}", file=sys.stderr, flush=True)
            await connection.close(1003, "a message that cannot be read")
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
            visit.closed.set()
            self.visits.remove(visit)
            self._leaving.append(visit)

    def _busy(self) -> int:
        """The number of visits, and of threads whose visitor has left."""
        self._leaving = [visit for visit in self._leaving if visit.thread.is_alive()]
        return len(self.visits) + len(self._leaving)

    def stop(self) -> None:
        """End all visits, and close the server."""
        for visit in [*self.visits, *self._leaving]:
            visit.closed.set()
            visit.thread.join(10)
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join(10)


def imported_websockets() -> Any:
    """What serves a page and its websockets, and the error of one that is closed.

    Raises:
        ImportError: websockets is missing; the message says how to install it.
    """
    try:
        from websockets.asyncio.server import serve
        from websockets.exceptions import ConnectionClosed
    except ImportError as error:
        raise ImportError("the playground needs websockets: pip install 'clothgym[view]'") from error
    return serve, ConnectionClosed


def check_address(host: str, port: int) -> None:
    """Refuse an address at which this machine cannot listen.  A port in use is not refused: the server takes the next.

    Raises:
        ValueError: an address that this machine does not have, or an invalid port.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"port={port}: must be from 0 to 65535, 0 for any that is free")
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ValueError(f"host={host!r}: cannot listen there ({error})") from error


def serve(
    start: str, host: str = LOOPBACK, port: int = PORT, replay: Path | None = None,
    policies: Mapping[str, Mapping[str, Policy]] | None = None, actor: str = "expert", tell: Callable[[str], None] = TELL,
) -> Playground:  # fmt: skip
    """Start the server, after a first step of the initial scene, which compiles its kernels.

    policies, actor: see ``Gallery``.

    Raises:
        ImportError: websockets is missing.
        FileNotFoundError, ValueError: no such scene, environment, file or address; the message says what would do.
        OSError: no port is free.
    """
    imported_websockets()
    recording = Recording.load(replay) if replay is not None else None
    gallery = Gallery(recording, policies, actor)
    start = gallery.checked(REPLAY if recording is not None and not start else start or "patch")
    check_address(host, port)
    tell(f"opening {start} (the first time on a machine it is compiled, up to a minute, once) ...")
    begun = time.perf_counter()
    gallery.open(start).advance()
    playground = Playground(gallery, start, host, port)
    if not is_loopback(host):
        tell(
            f"--host {host}: other machines can reach this page. Anybody with its address can use this machine's processors. The "
            "token in it changes with each start; the connection is not encrypted."
        )
    tell(f"ready after {time.perf_counter() - begun:.1f} s: open {playground.url} in a browser; Ctrl+C ends it")
    return playground
