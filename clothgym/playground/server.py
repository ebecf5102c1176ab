"""The server: a page for each visitor, with cloth of their own."""

from __future__ import annotations

import contextlib
import io
import socket
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from clothgym.playground.access import ASKED, MOST_VISITS, Access, is_loopback
from clothgym.playground.episode import Policy
from clothgym.playground.gallery import REPLAY, Gallery
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording
from clothgym.playground.show import furnish

LOOPBACK = "127.0.0.1"
PORT = 8080
TELL = partial(print, flush=True)  # at once, also into a pipe
EASE = 0.002  # shortest pause between two frames, for the server's other threads [s]


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
        self.thread = threading.Thread(target=self._live, name=f"visit {client.client_id}", daemon=True)
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
                with contextlib.suppress(Exception):
                    self._client.add_notification("This page has stopped", sorry, color="red")


class Playground:
    """A running server.

    Attributes:
        url: where the page is.
        visits: the visitors', by the number of the client.
    """

    def __init__(self, gallery: Gallery, start: str, host: str = LOOPBACK, port: int = PORT) -> None:
        viser = imported_viser()
        self.gallery, self.start = gallery, gallery.checked(start)
        self.visits: dict[int, Visit] = {}
        self._leaving: list[Visit] = []  # whose visitor has left, and whose thread may still be at its last step
        # viser may still write to a page that has just been closed
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
        self.access = Access(host, port, lambda connections: max(connections, self._busy()) >= MOST_VISITS)
        with contextlib.redirect_stdout(io.StringIO()), self.access.guarding():  # no banner: our own line gives the address
            self.server = viser.ViserServer(host=host, port=port, label="clothgym", verbose=False)
        self.access.port = self.server.get_port()
        if not self.access.stands():
            self.server.stop()
            raise RuntimeError(
                f"viser {viser.__version__} cannot be guarded against other web pages, so the playground does not open: install a "
                "version that it was tested with, pip install 'clothgym[view]'"
            )
        # viser can open a public tunnel for any visitor who asks: not here
        self.server.request_share_url = lambda verbose=True: None
        furnish(self.server.scene)
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(206, 64, 50), control_width="large")
        self.url = self.access.url
        self.server.on_client_connect(self._come)
        self.server.on_client_disconnect(self._go)

    def _busy(self) -> int:
        """The number of visits, and of threads whose visitor has left."""
        self._leaving = [visit for visit in self._leaving if visit.thread.is_alive()]
        return len(self.visits) + len(self._leaving)

    async def _come(self, client: Any) -> None:
        if self._busy() >= MOST_VISITS:  # several came at once
            client.add_notification("The playground is full", f"It has {MOST_VISITS} visitors. Try again later.", color="orange")
            return
        self.visits[client.client_id] = Visit(client, self.gallery, self.start, ASKED.get(), self.url)

    async def _go(self, client: Any) -> None:
        visit = self.visits.pop(client.client_id, None)
        if visit is not None:
            visit.closed.set()
            self._leaving.append(visit)

    def stop(self) -> None:
        """End all visits, and close the server."""
        for visit in [*self.visits.values(), *self._leaving]:
            visit.closed.set()
            visit.thread.join(10)
        self.server.stop()


def imported_viser() -> Any:
    """viser.

    Raises:
        ImportError: viser is missing; the message says how to install it.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError("the playground needs viser: pip install 'clothgym[view]'") from error
    return viser


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
        ImportError: viser is missing.
        FileNotFoundError, ValueError: no such scene, environment, file or address; the message says what would do.
        RuntimeError: this viser cannot be guarded.
    """
    imported_viser()
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
