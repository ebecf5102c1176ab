"""A viewer that shows nothing: tests read what the page creates, and move its controls as a visitor would."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any


class Handle:
    """A control or a node with its properties as attributes."""

    def __init__(self, kind: str, **properties: Any) -> None:
        self.kind, self.removed = kind, False
        self.value: Any = None
        self.content: Any = None
        self.callbacks: list[Callable[[Any], Any]] = []
        for name, value in properties.items():
            setattr(self, name, value)

    def on_update(self, callback: Callable[[Any], Any]) -> Callable[[Any], Any]:
        self.callbacks.append(callback)
        return callback

    def on_drag(self, button: str) -> Callable[..., Any]:
        """As a node: register what a drag calls."""
        return self.on_update

    def drag(self, phase: str, start: Any, end: Any) -> None:
        """Act as a visitor: drag a node from one position to another."""
        for callback in self.callbacks:
            asyncio.run(callback(SimpleNamespace(target=self, phase=phase, start_position=start, end_position=end, client_id=0)))

    def turn(self, value: Any = None, phase: str = "update") -> None:
        """Act as a visitor: set a control to a value, press a button, or drag a node."""
        self.value = value
        for callback in self.callbacks:
            outcome = callback(SimpleNamespace(target=self, phase=phase, client_id=0))
            if asyncio.iscoroutine(outcome):
                asyncio.run(outcome)

    def remove(self) -> None:
        self.removed = True

    def place(self, *_: Any) -> Handle:
        """Ignore the placement of a panel."""
        return self

    dock_left = dock_right = set_width = add_tab = place

    def __enter__(self) -> Handle:
        return self

    def __exit__(self, *_: object) -> None:
        return None


class Part:
    """A viewer's scene or controls: ``add_...`` creates a handle by its name or label; all other calls are ignored."""

    def __init__(self) -> None:
        self.handles: dict[str, Handle] = {}
        self.main_panel = Handle("panel")
        self.clicks: dict[str | None, Callable[[Any], Any]] = {}

    def on_click(self, modifier: str | None = None) -> Callable[..., Any]:
        """Register what a click anywhere calls."""
        return lambda callback: self.clicks.setdefault(modifier, callback)

    def click(self, origin: Any, direction: Any, modifier: str | None = None) -> None:
        """Act as a visitor: click where a ray leads."""
        asyncio.run(self.clicks[modifier](SimpleNamespace(ray_origin=origin, ray_direction=direction, modifier=modifier)))

    def reset(self) -> None:
        self.handles.clear()

    def __getattr__(self, name: str) -> Callable[..., Any]:
        if name.startswith("__"):
            raise AttributeError(name)

        def call(label: Any = None, *values: Any, **properties: Any) -> Any:
            if not name.startswith("add_"):
                return None
            handle = Handle(name.removeprefix("add_"), **properties)
            handle.value = properties.get("initial_value", values[-1] if values else None)
            handle.content = label
            self.handles[str(label) if isinstance(label, str) else handle.kind] = handle
            return handle

        return call


class NullClient:
    """Stands in for a client of viser."""

    client_id = 0

    def __init__(self) -> None:
        self.scene, self.gui = Part(), Part()
        self.camera = SimpleNamespace(
            position=(1.0, -1.0, 1.0), look_at=(0.0, 0.0, 0.0), fov=0.6, image_width=1280, image_height=800
        )
        self.files: dict[str, bytes] = {}
        self.notifications: list[str] = []

    @contextmanager
    def atomic(self) -> Iterator[None]:
        yield

    def send_file_download(self, filename: str, content: bytes, **_: Any) -> None:
        self.files[filename] = content

    def add_notification(self, title: str, body: str, **_: Any) -> Handle:
        self.notifications.append(f"{title}: {body}")
        return Handle("notification")
