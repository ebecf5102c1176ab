"""Color map of strain: larger strains are darker and redder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym.mesh import SHEAR, ClothMesh
from clothgym.render.solids import linear_color

# magma by van der Walt and Smith (2015, CC0), from light to dark without its ends, which shading needs; perceptually uniform,
# within 2 of 255 of the original table
MAGMA = (
    (252, 240, 178), (254, 211, 149), (254, 182, 124), (253, 152, 105), (249, 121, 93), (239, 93, 94), (220, 72, 105),
    (196, 60, 117), (170, 51, 125), (144, 42, 129), (118, 33, 129), (93, 23, 127), (68, 15, 118),
)  # fmt: skip
STEPS = 256


def heat_colors(values: ArrayLike, low: float = 0.0, high: float = 1.0) -> NDArray[np.uint8]:
    """sRGB of each value, (..., 3): cream at ``low`` and below, then coral, then violet at ``high`` and above.

    Raises:
        ValueError: a value that is not finite, or an empty range.
    """
    if not (np.isfinite(low) and np.isfinite(high) and low < high):
        raise ValueError(f"heat range low={low!r}, high={high!r}: must be finite, with low < high")
    shares = (np.asarray(values, np.float64) - low) / (high - low)
    if not np.all(np.isfinite(shares)):
        raise ValueError("a value is not finite: draw the last finite state instead")
    places = np.linspace(0, 1, len(MAGMA))
    channels: Sequence[NDArray] = [np.interp(shares, places, channel) for channel in zip(*MAGMA)]
    return np.round(np.stack(channels, axis=-1)).astype(np.uint8)


def heat_palette() -> NDArray[np.float32]:
    """Linear colors of ``STEPS`` values from 0 to 1, (STEPS, 3)."""
    return np.stack([linear_color(color) for color in heat_colors(np.linspace(0, 1, STEPS))])


def largest_at_particles(mesh: ClothMesh, strain: ArrayLike) -> NDArray[np.float32]:
    """The largest ``strain``, (num_envs, structural springs), of the springs that meet at each particle, (num_envs, particles).

    ``Simulation.strain()`` returns that of structural springs.  Particles without any have 0.
    """
    strain = np.asarray(strain, np.float32)
    ends = mesh.springs.particles[mesh.springs.kind < SHEAR]
    if strain.ndim != 2 or strain.shape[1] != len(ends):
        raise ValueError(f"strain has shape {strain.shape}: must be (num_envs, {len(ends)}), a value for each structural spring")
    largest = np.full((mesh.num_particles, len(strain)), -np.inf, np.float32)
    for side in (0, 1):
        np.maximum.at(largest, ends[:, side], strain.T)
    return np.where(np.isneginf(largest), np.float32(0), largest).T
