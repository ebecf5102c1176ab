"""Stages as the playground's tests want them, and a viewer that shows nothing: tests read what a page creates, and move its
controls as a visitor would."""

import asyncio
from contextlib import contextmanager
from types import SimpleNamespace

from clothgym.playground.gallery import Gallery
from clothgym.playground.page import Page


def advanced(stage, frames):
    for _ in range(frames):
        stage.advance()
    return stage


def page(start="patch", left=lambda: False, asked="", **kwargs):
    client = NullClient()
    return Page(client, Gallery(**kwargs), start, left, asked, "http://here/"), client


def ticked(visitor, times=1):
    for _ in range(times):
        visitor.tick()


class Handle:
    """A control or a node with its properties as attributes."""

    def __init__(self, kind, content=None, value=None, **properties):
        self.kind, self.content, self.value, self.callbacks = kind, content, value, []
        self.__dict__.update(properties)

    def on_update(self, callback):
        self.callbacks.append(callback)

    def on_drag(self, button):
        return self.on_update

    def _call(self, **event):
        for callback in self.callbacks:
            outcome = callback(SimpleNamespace(target=self, client_id=0, **event))
            if asyncio.iscoroutine(outcome):
                asyncio.run(outcome)

    def drag(self, phase, start, end):
        """Act as a visitor: drag a node from one position to another."""
        self._call(phase=phase, start_position=start, end_position=end)

    def turn(self, value=None):
        """Act as a visitor: set a control to a value, or press a button."""
        self.value = value
        self._call()

    def remove(self):
        self.removed = True

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


class Part:
    """A viewer's scene or controls: ``add_...`` makes a handle, kept by its name or label; all other calls are ignored."""

    def __init__(self):
        self.handles, self.clicks = {}, {}
        self.main_panel = SimpleNamespace(dock_right=lambda: None, set_width=lambda _: None)

    def on_click(self, modifier=None):
        return lambda callback: self.clicks.setdefault(modifier, callback)

    def click(self, origin, direction, modifier=None):
        """Act as a visitor: click where a ray leads."""
        asyncio.run(self.clicks[modifier](SimpleNamespace(ray_origin=origin, ray_direction=direction, modifier=modifier)))

    def reset(self):
        self.handles.clear()

    def __getattr__(self, name):
        def call(label=None, *values, **properties):
            if name.startswith("add_"):
                value = properties.get("initial_value", values[-1] if values else None)
                handle = Handle(name.removeprefix("add_"), label, value, **properties)
                self.handles[label] = handle
                return handle

        return call


class NullClient:
    """Stands in for a client of viser."""

    client_id = 0

    def __init__(self):
        self.scene, self.gui = Part(), Part()
        self.camera = SimpleNamespace(
            position=(1.0, -1.0, 1.0), look_at=(0.0, 0.0, 0.0), fov=0.6, image_width=1280, image_height=800
        )
        self.files, self.notifications = {}, []

    @contextmanager
    def atomic(self):
        yield

    def send_file_download(self, filename, content):
        self.files[filename] = content

    def add_notification(self, title, body, **_):
        self.notifications.append(f"{title}: {body}")
        return Handle("notification")
