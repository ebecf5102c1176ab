"""A task about something that stands anywhere, turned by any angle: points as it sees them."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from clothgym.envs.task import Task


class FramedTask(Task):
    """Base of tasks whose episodes remember where something stands, and ``turn``, cosine and sine of its yaw.

    Attributes:
        frame_at: the field of an episode's record that says where [m].
    """

    frame_at: ClassVar[str]

    def in_frame(self, points: NDArray) -> NDArray:
        """World points as along, across and above it [m], (num_envs, points, 3)."""
        d, (c, s) = points - self.episode[self.frame_at][:, None], self.turns
        return np.stack([c * d[..., 0] + s * d[..., 1], c * d[..., 1] - s * d[..., 0], d[..., 2]], axis=2)

    def out_of_frame(self, ways: NDArray) -> NDArray:
        """Ways along, across and above it as ways in the world, (num_envs, ways, 3)."""
        c, s = self.turns
        return np.stack([c * ways[..., 0] - s * ways[..., 1], s * ways[..., 0] + c * ways[..., 1], ways[..., 2]], axis=2)

    @property
    def turns(self) -> tuple[NDArray, NDArray]:
        """Cosines and sines of the yaws, each (num_envs, 1)."""
        return self.episode["turn"][:, :1], self.episode["turn"][:, 1:]

    def before(self, env: int, x: NDArray, across: float, along: float) -> NDArray:
        """A sheet about the origin [m], (particles, 3), turned with it and put before it."""
        own = self.episode[env]
        c, s = own["turn"]
        u, v = x[:, 0] + along, x[:, 1] + across
        return np.stack([own[self.frame_at][0] + c * u - s * v, own[self.frame_at][1] + s * u + c * v, x[:, 2]], axis=1)
