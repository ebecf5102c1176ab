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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import gymnasium as gym
from numpy.typing import NDArray

from clothgym import policies
from clothgym.adapters import runs
from clothgym.checks import known
from clothgym.playground import race
from clothgym.playground.access import ASKED, MOST_VISITS, Access, is_loopback
from clothgym.playground.episode import EpisodeStage, Policy, Replay
from clothgym.playground.page import Page
from clothgym.playground.recording import Recording
from clothgym.playground.scenes import SCENES, TITLES
from clothgym.playground.show import furnish
from clothgym.playground.stage import SceneStage, Stage
from clothgym.registration import ACTORS, ENVIRONMENTS, checked_id

LOOPBACK = "127.0.0.1"
PORT = 8080
REPLAY = "recording"
EASE = 0.002  # shortest pause between two frames, for the server's other threads [s]


class Gallery:
    """What can be shown, by name: scenes, environments, and a recording if there is one.

    Args:
        recording: to show again.
        policies: policies for each environment besides its expert, by id and then by name.
        actor: who acts at first in an environment without such a policy.
    """

    def __init__(
        self,
        recording: Recording | None = None,
        policies: Mapping[str, Mapping[str, Policy]] | None = None,
        actor: str = "expert",
    ) -> None:
        self.recording, self.policies, self.actor = recording, policies or {}, actor
        self.titles = {title: name for name, title in TITLES.items()} | {race.TITLE: race.RACE}
        learned = available()
        for env_id in ENVIRONMENTS:
            self.titles[env_id] = env_id
            # a committed policy in one click
            for learner in learned.get(env_id, ()):
                if f"learned, {learner}" in committed_policies(env_id):
                    self.titles[f"{env_id}, {learner}"] = f"{env_id}/{learner}"
        if recording is not None:
            self.titles = {f"recording of {recording.title}": REPLAY} | self.titles

    def checked(self, name: str) -> str:
        """The name without its namespace.

        Raises:
            ValueError: there is nothing of that name.
        """
        bare = name.removeprefix("clothgym:")
        if bare in self.titles.values():
            return bare
        if ":" not in bare and bare not in gym.registry:
            known("scene or environment", bare, self.titles.values())
        # an id that somebody else has registered, which the page lists from now on
        bare = checked_id(bare)
        self.titles = {**self.titles, bare: bare}
        return bare

    def open(self, name: str) -> Stage:
        """A new stage of that name."""
        name = self.checked(name)
        if name == REPLAY:
            assert self.recording is not None
            return Replay(self.recording, REPLAY)
        if name in SCENES:
            return SceneStage(name)
        if name == race.RACE:
            return race.Race(committed_policies(race.TASK))
        env_id, _, learner = name.partition("/")
        own = self.policies.get(env_id, {})
        actor = f"learned, {learner}" if learner else next(iter(own), self.actor)
        return EpisodeStage(env_id, {**committed_policies(env_id), **own}, actor, name=name)


class Visit:
    """One visitor's page and the thread that it lives in, until they leave.

    asked: query of the page's address; address: of the page, for its link.
    """

    def __init__(self, client: Any, gallery: Gallery, start: str, asked: str = "", address: str = "") -> None:
        self.page: Page | None = None
        self.frames = 0
        self.closed = threading.Event()
        self._client, self._gallery, self._start = client, gallery, start
        self._asked, self._address = asked, address
        self.thread = threading.Thread(target=self._live, name=f"visit {client.client_id}", daemon=True)
        self.thread.start()

    def _live(self) -> None:
        try:
            self.page = Page(
                self._client, self._gallery.open, self._gallery.titles, self._start, self.closed.is_set, self._asked, self._address
            )
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
        free = free_port(host, port)
        self.gallery, self.start = gallery, gallery.checked(start)
        self.visits: dict[int, Visit] = {}
        # viser may still write to a page that has just been closed
        warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)
        self._leaving: list[Visit] = []  # whose visitor has left, and whose thread may still be at its last step
        self.access = Access(host, free, lambda connections: max(connections, self._busy()) >= MOST_VISITS)
        with contextlib.redirect_stdout(io.StringIO()), self.access.guarding():  # no banner: our own line gives the address
            self.server = viser.ViserServer(host=host, port=free, label="clothgym", verbose=False)
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


def policies_of(names: Sequence[str], start: str) -> tuple[str, dict[str, dict[str, Policy]]]:
    """What is shown first, the first run's environment if nothing is asked; and the runs' policies, by environment and folder.

    names: the runs' folders; who may act in any environment is left out.

    Raises:
        ImportError: Stable-Baselines3 is missing; the message says how to get it.
        FileNotFoundError, ValueError: a folder without a run that can be used here.
    """
    # what is wrong with any of them is said before the first is loaded, which takes seconds
    configs = {name: runs.read_config(Path(name)) for name in names if name not in ACTORS}
    found: dict[str, dict[str, Policy]] = {}
    for run, config in configs.items():
        env_id = config["env"]
        act = runs.learned(Path(run), env_id)
        own = found.setdefault(env_id, {})
        name = Path(run).resolve().name
        # runs of the same name are distinguished by their full paths
        own[name if name not in own else str(Path(run).resolve())] = Learnt(act, config["env_kwargs"])
        start = start or env_id
    return start, found


@cache
def available() -> dict[str, list[str]]:
    """The learners of committed policies, by environment id."""
    return policies.available()


@cache
def committed_policies(env_id: str) -> dict[str, Policy]:
    """The policies that come with the project, by name; without those that pick and place, in steps too long to watch."""
    found: dict[str, Policy] = {}
    for learner in available().get(env_id, []):
        policy = policies.load(env_id, learner)
        # a sheet settles before the visitor's eyes
        kwargs = {name: value for name, value in policy.about["env_kwargs"].items() if name != "settling"}
        if "action_mode" not in kwargs:
            found[f"learned, {learner}"] = Learnt(partial(_decided, policy), kwargs)
    return found


def _decided(policy: policies.Policy, env: Any, observations: Any) -> NDArray:
    return policy(observations)


@dataclass(frozen=True)
class Learnt:
    """A policy for batches, in a single environment, and what that was made with when the policy was trained."""

    act: Callable[[Any, Any], NDArray]
    env_kwargs: Mapping[str, Any]

    def __call__(self, env: Any, observation: Any) -> NDArray:
        if isinstance(observation, Mapping):  # of a goal task
            return self.act(env, {name: part[None] for name, part in observation.items()})[0]
        return self.act(env, observation[None])[0]


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


def free_port(host: str, port: int, tries: int = 20) -> int:
    """The first port from this one on that nobody listens at; 0 takes any.

    Raises:
        ValueError: an address that this machine does not have, an invalid port, or no free one.
    """
    if not 0 <= port <= 65535:
        raise ValueError(f"port={port}: must be from 0 to 65535, 0 for any that is free")
    last: OSError | None = None
    for candidate in range(port, min(port + tries, 65536)):
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
            except (socket.gaierror, OverflowError) as error:
                raise ValueError(f"host={host!r}: is no address ({error})") from error
            except OSError as error:
                last = error
                continue
            return int(probe.getsockname()[1])
    raise ValueError(f"host={host!r}, port={port}: cannot listen there ({last})")


def say(line: str) -> None:
    """Print at once, also into a pipe."""
    print(line, flush=True)


def serve(
    start: str, host: str = LOOPBACK, port: int = PORT, replay: Path | None = None,
    policies: Mapping[str, Mapping[str, Policy]] | None = None, actor: str = "expert", tell: Callable[[str], None] = say,
) -> Playground:  # fmt: skip
    """Begin to serve, after a first look at what is shown first, which compiles what it needs.

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
    free_port(host, port)
    tell(f"opening {start} (the first time on a machine it is compiled, up to a minute, once) ...")
    begun = time.perf_counter()
    stage = gallery.open(start)
    if not stage.over:
        stage.advance()
    playground = Playground(gallery, start, host, port)
    if not is_loopback(host):
        tell(
            f"--host {host}: other machines can reach this page. Whoever has its address can use this machine's processors. The "
            "token in it changes with each start; what is sent is not encrypted."
        )
    tell(f"ready after {time.perf_counter() - begun:.1f} s: open {playground.url} in a browser; Ctrl+C ends it")
    return playground
