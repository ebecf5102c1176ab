"""A sheet on a table whose end hangs over the edge: the pull that draws it back, and whether it stays by itself, in closed form.

With the weight w per length, lengths a on the table and c that hang, and an edge of radius R between them, friction makes the
tension of what hangs grow around the edge as ``dT/dt = mu T + w R (cos t + mu sin t)`` (Euler, Eytelwein; with the weight of what
lies on the edge).  So drawing it back takes

    w (mu a + exp(mu pi/2) c + R ((1 - mu^2) + 2 mu exp(mu pi/2))/(1 + mu^2)),

and it slides down by itself where this, with -mu instead of mu, is positive.  At a sharp edge it stays up to the share
f = r/(1 + r) of its length, with r = mu exp(mu pi/2).
"""

import numpy as np

from clothgym import Box, Capsule, Material, MeshCollider, Simulation, grid

SIDE, GRAVITY = 0.6, 9.81


def edge(radius=0.0, friction=0.3, thickness=0.001, half=0.5):
    """Solids of a table that ends at x = 0 with its top at z = 0, and an edge of this radius [m]; half: half its length [m]."""
    shared = {"friction": friction, "thickness": thickness}
    if radius == 0:
        return [Box(center=(-half, 0, -half), half_sides=(half, half, half), **shared)]
    top = Box(center=(-half - radius / 2, 0, -half), half_sides=(half - radius / 2, half, half), **shared)
    side = Box(center=(-half, 0, -half - radius / 2), half_sides=(half, half, half - radius / 2), **shared)
    rail = Capsule(center=(-radius, 0, -radius), radius=radius, height=2 * half + 2 * radius, axis=(0, 1, 0), **shared)
    return [top, side, rail]


def mesh_edge(radius=0.0, friction=0.3, thickness=0.001, half=0.3, resolution=128, segments=8):
    """The same as one closed mesh, a prism."""
    turn = np.linspace(np.pi / 2, 0, segments + 1) if radius else np.array([0.0])
    arc = np.stack([-radius + radius * np.cos(turn), -radius + radius * np.sin(turn)], axis=1)
    outline = np.concatenate([[(-2 * half, -2 * half), (-2 * half, 0.0)], arc, [(0.0, -2 * half)]])
    n = len(outline)
    vertices = np.concatenate([np.insert(outline, 1, y, axis=1) for y in (-half, half)])
    sides = [t for a in range(n) for b in [(a + 1) % n] for t in ((a, a + n, b + n), (a, b + n, b))]
    caps = [t for a in range(1, n - 1) for t in ((0, a, a + 1), (n, n + a + 1, n + a))]
    return [
        MeshCollider(
            vertices=vertices,
            triangles=np.array(sides + caps)[:, ::-1],
            friction=friction,
            thickness=thickness,
            resolution=resolution,
        )
    ]


def pull_of(friction, radius, on_table, length=SIDE):
    """The pull over the sheet's weight; radius: of the edge [m]; on_table: length on the table [m]."""
    growth = np.exp(friction * np.pi / 2)
    around = radius * ((1 - friction**2) + 2 * friction * growth) / (1 + friction**2)
    hangs = length - on_table - radius * np.pi / 2
    return (friction * on_table + growth * hangs + around) / length


def largest_share(friction):
    """Of a sheet that stays by itself at a sharp edge."""
    r = friction * np.exp(friction * np.pi / 2)
    return r / (1 + r)


def over_the_edge(solids, particles, share, fabric="cotton", **options):
    """A sheet of SIDE that is held by the row farthest from the edge, and hangs over it with this share of its length, at rest."""
    mesh = grid(particles, particles, SIDE, SIDE)
    row = list(range(0, particles * particles, particles))
    simulation = Simulation(
        mesh, Material.preset(fabric), colliders=solids, anchors=[row], air_density=0, bending="hinge", **options
    )
    simulation.reset(positions=mesh.rest_positions + (share * SIDE - SIDE / 2, 0, solids[0].thickness))
    # it swings down in thick air
    simulation.set_parameters(air_drag=5.0)
    simulation.step(120)
    simulation.set_parameters(air_drag=0.0)
    return simulation


def pull_back(make_solids, particles, friction, radius=0.0, fabric="cotton", share=0.4, speed=0.1, way=0.15, **options):
    """Drawing back a sheet that hangs over the edge: the mean pull over the closed form's, the largest strain, and depth [m]."""
    solids = make_solids(radius=radius, friction=friction)
    simulation = over_the_edge(solids, particles, share, fabric, **options)
    start, weight = simulation.attachment_positions[0], Material.preset(fabric).density * SIDE**2 * GRAVITY
    pulls, expected, strain, depth = [], [], 0.0, 0.0
    steps = round(60 * way / speed)
    for step in range(1, steps + 1):
        gone = speed * step / 60
        simulation.move_anchors(start - [gone, 0, 0])
        simulation.step()
        if step > steps / 6:
            pulls.append(float(simulation.pulls()[0, :, 0].sum()))
            on_table = gone - start[0, 0] - radius
            expected.append(weight * pull_of(friction, radius + solids[0].thickness, on_table))
            strain = max(strain, float(simulation.strain().max()))
            depth = max(depth, float(simulation.penetration()[0]))
    return {"ratio": float(np.mean(pulls) / np.mean(expected)), "strain": strain, "depth": depth}


def slid(make_solids, particles, friction, share, radius=0.0, fabric="cotton", seconds=2.0, **options):
    """How far a sheet with this share over the edge goes by itself [m], once friction has come down to what is asked for.

    It comes to rest where friction holds it, and then friction falls evenly within a second: so nothing swings.
    """
    simulation = over_the_edge(make_solids(radius=radius, friction=5 * friction), particles, share, fabric, **options)
    simulation.release()
    for step in range(60):
        for index, solid in enumerate(make_solids(radius=radius, friction=friction * (5 - 4 * (step + 1) / 60))):
            simulation.set_collider(index, [solid])
        simulation.step()
    start = simulation.positions[0, :, 0].min()
    simulation.step(round(60 * seconds))
    return float(simulation.positions[0, :, 0].min() - start)
