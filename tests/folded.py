"""Sheets that lie over themselves."""

import numpy as np

import clothgym

SIDE = 0.6


def sheet(points=13):
    return clothgym.grid(points, points, SIDE, SIDE)


def three_layers(mesh, gap):
    """The sheet folded in three, layers ``gap`` apart, the folds round."""
    arc = np.pi * gap / 2
    flat = (SIDE - 2 * arc) / 3
    s = mesh.rest_positions[:, 0] - mesh.rest_positions[:, 0].min()
    bend_one, bend_two = (s - flat) / (gap / 2), (s - 2 * flat - arc) / (gap / 2)
    along = np.select(
        [s < flat, s < flat + arc, s < 2 * flat + arc, s < 2 * flat + 2 * arc],
        [s, flat + gap / 2 * np.sin(bend_one), 2 * flat + arc - s, -gap / 2 * np.sin(bend_two)],
        s - 2 * flat - 2 * arc,
    )
    height = np.select(
        [s < flat, s < flat + arc, s < 2 * flat + arc, s < 2 * flat + 2 * arc],
        [0 * s, gap / 2 * (1 - np.cos(bend_one)), 0 * s + gap, gap + gap / 2 * (1 - np.cos(bend_two))],
        2 * gap,
    )
    return np.stack([along, mesh.rest_positions[:, 1], height + 0.01], axis=1)
