"""Stages as the playground's tests want them, and a browser that shows nothing: tests read what it is told, and turn its controls
as a visitor would."""

import numpy as np

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


def turned(visitor, **values):
    """Turn controls, by name, and let the page act on it."""
    for name, value in values.items():
        visitor.take(["turn", [name, value]])
    visitor.tick()


class NullClient:
    """Stands in for a visitor's browser.

    Attributes:
        controls: what the browser knows of each; opened: the scene; solids: all that it knows of it.
        said: title and words of each message; frame: the last one, as numbers; files: by name.
    """

    def __init__(self):
        self.controls, self.opened, self.solids, self.look, self.said, self.waits, self.files = {}, {}, [], {}, [], [], {}
        self.frame = np.zeros(0, np.float32)

    def tell(self, what, content):
        if what == "set":
            for name, new in content.items():
                self.controls.setdefault(name, {}).update(new)
        elif what == "open":
            self.opened, self.solids, self.look = content, [], content["look"]
        elif what == "solids":
            self.solids += content
        elif what == "look":
            self.look = content
        else:
            {"say": self.said, "wait": self.waits}[what].append(content)

    def give(self, name, content):
        self.files[name] = content

    def draw(self, frame):
        self.frame = np.frombuffer(frame, "<f4")

    @property
    def sheets(self):
        """Positions in the last frame [m], (sheets, particles, 3)."""
        count = self.opened["sheets"] * np.prod(self.opened.get("shape") or [len(self.opened.get("uv", [])) // 2])
        return self.frame[2 : 2 + 3 * count].reshape(self.opened["sheets"], -1, 3)

    @property
    def places(self):
        """Centers of the solids that it knows [m], and held points, (points, 3) each."""
        rest = self.frame[2 + self.sheets.size :].reshape(-1, 3)
        return rest[: int(self.frame[1])], rest[int(self.frame[1]) :]
