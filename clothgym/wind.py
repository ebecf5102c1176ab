"""Floor 1: wind, a random series of air velocities from steady wind and gusts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.checks import finite, not_negative, positive, shown


@dataclass(frozen=True, kw_only=True)
class Wind:
    """The distribution of the wind in an episode: a steady horizontal wind, and gusts.

    Attributes:
        speed: range of the steady wind's speed [m/s].
        direction: range of the direction in which it blows, measured from the x axis [rad].
        gust: root mean square of each of the three components of the gusts [m/s].
        gust_time: correlation time of the gusts [s].

    Gusts are a first-order Markov process, ``u' = u r + sqrt(1 - r^2) gust xi`` with ``r = exp(-dt/gust_time)``.  This is Dryden's
    longitudinal turbulence (MIL-F-8785C, 3.7.1).  Its scale is ``gust_time`` times the speed.

    Raises:
        ValueError: an invalid range [low, high], a negative speed or gust, or a time that is not positive.
    """

    speed: Sequence[float] = (0.0, 0.0)
    direction: Sequence[float] = (-np.pi, np.pi)
    gust: float = 0.0
    gust_time: float = 0.5

    def __post_init__(self) -> None:
        for name in ("speed", "direction"):
            bounds = finite(f"wind {name}", getattr(self, name))
            if bounds.shape != (2,) or bounds[0] > bounds[1]:
                raise ValueError(f"wind {name}={shown(getattr(self, name))}: must be a range [low, high]")
            object.__setattr__(self, name, tuple(bounds.tolist()))
        if self.speed[0] < 0:
            raise ValueError(f"wind speed={self.speed!r}: must not be below zero; change the direction instead")
        object.__setattr__(self, "gust", not_negative("wind gust", self.gust))
        object.__setattr__(self, "gust_time", positive("wind gust_time", self.gust_time))

    def series(self, rng: np.random.Generator, steps: int, time_step: float) -> NDArray[np.float64]:
        """Air velocities in successive control steps, steady wind plus gusts [m/s], (steps, 3).  time_step: [s]."""
        speed, direction = rng.uniform(self.speed[0], self.speed[1]), rng.uniform(self.direction[0], self.direction[1])
        noise = rng.standard_normal((steps, 3))
        out = np.empty((steps, 3))
        gusts(noise, self.gust, float(np.exp(-time_step / self.gust_time)), out)
        return out + speed * np.array([np.cos(direction), np.sin(direction), 0.0])


@kernel
def gusts(noise, rms, keep, out):
    """``u <- u r + sqrt(1 - r^2) gust xi`` at each step, into ``out``, (steps, 3); see ``Wind``.

    The process starts from its stationary distribution.  noise: xi, (steps, 3).  rms: gust [m/s].  keep: r.
    """
    fresh = np.sqrt(1 - keep * keep)
    for c in range(noise.shape[1]):
        u = rms * noise[0, c]
        out[0, c] = u
        for step in range(1, noise.shape[0]):
            u = keep * u + fresh * rms * noise[step, c]
            out[step, c] = u
