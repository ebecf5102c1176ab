"""Sheets that slide on sheets, and what Coulomb's law and mechanics say of them."""

import numpy as np

import clothgym

THICKNESS, G = 0.004, 9.81


def cut(length, width, spacing):
    """A grid with about a given spacing."""
    return clothgym.grid(max(2, round(width / spacing) + 1), max(2, round(length / spacing) + 1), length, width)


def _both(lower, upper, triangles, mode, friction, **options):
    """The lower sheet, which is held, and the upper one, as one mesh, where they are; and the number of particles below."""
    n = len(lower)
    rest = np.vstack([lower, options.pop("upper_rest", upper) + (0, 0, 1.0)])
    mesh = clothgym.triangle_mesh(rest, np.vstack([triangles[0], triangles[1] + n]))
    simulation = clothgym.Simulation(
        mesh,
        anchors=list(range(n)),
        air_density=0,
        self_collision={"mode": mode, "thickness": THICKNESS, "friction": friction},
        bending="springs",
        **options,
    )
    simulation.reset(positions=np.vstack([lower, upper]))
    return simulation, n


def flat_layers(spacings, turn, degrees, mode, friction, lift=1.0):
    """A small sheet on a large one, on a slope; spacings: below and above, in thicknesses; turn: of the small one [rad]."""
    large, small = cut(0.5, 0.22, spacings[0] * THICKNESS), cut(0.144, 0.096, spacings[1] * THICKNESS)
    c, s = np.cos(turn), np.sin(turn)
    upper = small.rest_positions @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (-0.1187, 0.0007, lift * THICKNESS)
    slope = np.radians(degrees)
    gravity = (G * np.sin(slope), 0, -G * np.cos(slope))
    return _both(large.rest_positions, upper, (large.triangles, small.triangles), mode, friction, gravity=gravity)


def speed_on_slope(degrees, friction, time):
    """That a block on a slope has after a time, from rest [m/s]."""
    slope = np.radians(degrees)
    return max(0.0, G * (np.sin(slope) - friction * np.cos(slope))) * time


def _strip(around, spacing, tails):
    """A strip, and where it is when it hangs over the upper half of a lying cylinder, at a distance from its axis."""
    mesh = cut(sum(tails) + np.pi * around, 0.06, spacing)
    s = mesh.rest_positions[:, 0] - mesh.rest_positions[:, 0].min() - tails[0]
    turn = np.clip(s / around, 0, np.pi)
    down = np.minimum(s, 0) - np.maximum(s - np.pi * around, 0)
    return mesh, np.stack([-around * np.cos(turn), mesh.rest_positions[:, 1] + 0.0011, around * np.sin(turn) + down], axis=1)


def strip_over_cylinder(radius, spacings, tails, mode, friction, skew=0.0):
    """A strip over a cylinder that is itself a sheet, which is held.

    spacings: below and above [m].  tails: the lengths that hang down [m].  skew: of the lower grid, along the circumference.
    """
    large = cut(radius * (np.pi + 1), 0.06 + 4 * spacings[0], spacings[0])
    angle = np.pi / 2 + (large.rest_positions[:, 0] + skew * large.rest_positions[:, 1]) / radius
    lower = np.stack([-radius * np.cos(angle), large.rest_positions[:, 1], radius * np.sin(angle)], axis=1)
    small, upper = _strip(radius + THICKNESS, spacings[1], tails)
    triangles = large.triangles, small.triangles
    simulation, n = _both(lower, upper, triangles, mode, friction, upper_rest=small.rest_positions + (0, 0, 1.0))
    return simulation, n, small.shape


def strip_over_solid(radius, spacing, tails, friction):
    """The same strip over a solid cylinder, which is smooth."""
    small, upper = _strip(radius + THICKNESS, spacing, tails)
    solid = clothgym.Capsule(radius=radius, thickness=THICKNESS, height=2.0, axis=(0, 1, 0), friction=friction)
    simulation = clothgym.Simulation(small, air_density=0, colliders=[solid])
    simulation.reset(positions=upper)
    return simulation, 0, small.shape


def speed_along(simulation, n, shape):
    """Mean speed of a strip along itself [m/s]."""
    x, v = (a[0, n:].reshape(*shape, 3).mean(axis=0) for a in (simulation.positions, simulation.velocities))
    along = np.gradient(x, axis=0)
    return float(np.mean(np.sum(along * v, axis=1) / np.linalg.norm(along, axis=1)))


def speed_over_cylinder(radius, tails, time):
    """That a chain over half a cylinder has after a time, from rest, without friction [m/s].

    Its longer end pulls: length d2s/dt2 = g (falling - rising + 2 s).
    """
    rising, falling = tails
    rate = np.sqrt(2 * G / (rising + falling + np.pi * radius))
    assert (falling - rising) / 2 * (np.cosh(rate * time) - 1) < rising
    return (falling - rising) / 2 * rate * np.sinh(rate * time)
