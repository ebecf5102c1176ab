"""The plots of docs/physics.md: the library compared with closed forms and converged solutions.

    python docs/validation.py            # draws docs/validation.png, in a minute or two

Each panel has its truth from elsewhere: formulae, scipy, or an integrator of a higher order with a finer step.
"""

from __future__ import annotations

import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from numpy.typing import NDArray

from clothgym import INTEGRATORS, Material, Simulation, grid
from clothgym.lab.scenes import bending_length, cantilever, elastica_droop
from clothgym.mesh import SHEAR, STRUCTURAL_X, ClothMesh, Springs, colored_hinges

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.collections import LineCollection

PICTURE = Path(__file__).parent / "validation.png"
G = 9.81
COLORS = dict(zip(INTEGRATORS, plt.get_cmap("tab10").colors))  # type: ignore[attr-defined]
TIGHT: dict[str, dict[str, Any]] = {
    "implicit_euler": {"name": "implicit_euler", "tolerance": 1e-8},
    "projective_dynamics": {"name": "projective_dynamics", "iterations": 60},
}


def line(particles: int, spacing: float) -> ClothMesh:
    """Particles in a row, joined by springs."""
    x = np.stack([np.arange(particles) * spacing, np.zeros(particles), np.zeros(particles)], axis=1)
    ends = np.stack([np.arange(particles - 1), np.arange(1, particles)], axis=1).astype(np.int32)
    ends = np.concatenate([ends[::2], ends[1::2]])
    kind = np.full(len(ends), STRUCTURAL_X, np.int32)
    springs = Springs(ends, np.full(len(ends), spacing), kind, np.ones(len(ends)))
    none = np.zeros((0, 3), np.int32)
    return ClothMesh((1.0, 1.0), x, springs, none, np.ones(particles), colored_hinges(x, none), (2, particles))


def chain(mesh: ClothMesh, method: Any, h: float, k: float, mass: NDArray | float, substeps: int = 1, **kwargs: Any) -> Simulation:
    """A float64 simulation of such a row with a spring constant [N/m] and masses [kg]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the substep is that of the default fabric
        simulation = Simulation(
            mesh, Material(shear_stiffness=0, bend_rigidity=0, damping_time=0), integrator=method, time_step=h * substeps,
            substeps=substeps, dtype="float64", air_density=0, **kwargs,
        )  # fmt: skip
    state = simulation.get_state()
    state.stiffness[:] = 0
    state.stiffness[:, STRUCTURAL_X] = k
    state.free_inverse_mass[:] = 1 / np.asarray(mass)
    simulation.set_state(state)
    return simulation


def orders(axes: Any) -> None:
    """A mass on a spring after one radian, against cosine and sine."""
    for name, method in INTEGRATORS.items():
        errors, counts = [], (10, 20, 40, 80, 160, 320)
        for steps in counts:
            mass = chain(line(2, 1.0), TIGHT.get(name, name), 1 / steps, 1.0, 1.0, gravity=(0, 0, 0), anchors=[0])
            mass.reset(positions=[[0, 0, 0], [1.1, 0, 0]])
            mass.step(steps)
            x, v = mass.positions[0, 1, 0] - 1, mass.velocities[0, 1, 0]
            errors.append(np.hypot(x - 0.1 * np.cos(1), v + 0.1 * np.sin(1)))
        label = f"{name}, order {method.order}" if method.order else f"{name}, does not converge"
        axes.plot([1 / n for n in counts], errors, marker="o", ms=3, lw=1.2, color=COLORS[name], label=label)
    axes.set(xscale="log", yscale="log", xlabel="substep x frequency", ylabel="error, of 0.1", title="Oscillator: order")
    axes.set_ylim(bottom=1e-19)  # below the lines there is room for their names
    axes.legend(fontsize=6.5, frameon=False, loc="lower right", ncols=2)


def swings(axes: Any) -> None:
    """Energy of an undamped sheet that swings from two corners, at the same substep."""
    sheet, fabric = grid(9, 9, 0.3, 0.3), Material(damping_time=0.0)
    scale = fabric.density * 0.09 * G * 0.3
    for name in INTEGRATORS:
        if name in ("explicit_euler", "pbd"):
            continue  # one explodes, and the other has no such energy
        cloth = Simulation(
            sheet, fabric, integrator=TIGHT.get(name, name), time_step=1 / 60, substeps=40, anchors=sheet.corners[2:],
            air_density=0,
            dtype="float64",
        )  # fmt: skip
        first, energies = cloth.energy().total[0], [0.0]
        for _ in range(120):
            cloth.step()
            energies.append((cloth.energy().total[0] - first) / scale)
        axes.plot(np.arange(121) / 60, energies, lw=1.2, color=COLORS[name], label=name)
    axes.set(xlabel="time [s]", ylabel="energy gained / (weight x side)", title="Undamped swing: energy")
    axes.legend(fontsize=6.5, frameon=False)


def catenary(axes: Any) -> None:
    """Sag of a cable of length 1.2 over a span of 1, against the elastic catenary, under refinement."""
    from scipy.optimize import brentq

    length, stretch = 1.2, 1e-3  # weight over axial stiffness

    # in units of the weight per length: H, with x(s) = H s/EA + (H/w)(asinh(V/H) - asinh((V - w s)/H))
    axial = length / stretch
    pull = brentq(lambda h: h * length / axial + 2 * h * np.arcsinh(length / (2 * h)) - 1, 1e-3, 10)
    half = length / 2
    sag = half * half / (2 * axial) + np.sqrt(pull**2 + half**2) - pull
    links, errors = (4, 8, 16, 32, 64), []
    for n in links:
        mesh = line(n + 1, length / n)
        masses = np.full(n + 1, length / n)
        cable = chain(mesh, "verlet", 2e-4 * 16 / n, axial * n / length, masses, 2000, gravity=(0, 0, -1.0), anchors=[0, n])
        state = cable.get_state()
        state.drag_rate[:] = 3.0
        cable.set_state(state)
        s = np.linspace(-1, 1, n + 1)
        cable.reset(positions=np.stack([(s + 1) / 2, np.zeros(n + 1), 0.29 * (s * s - 1)], axis=1))
        for _ in range(400):
            cable.step()
            if np.abs(cable.velocities).max() < 1e-9:
                break
        errors.append(abs(-cable.positions[0, :, 2].min() - sag))
    axes.plot(links, errors, "o-", ms=4, color="#d1495b", label="chain at rest")
    axes.plot(links, errors[0] * (links[0] / np.array(links, float)) ** 2, "k--", lw=0.8, label="order 2")
    axes.set(xscale="log", yscale="log", xlabel="links", ylabel="error of the sag", title="Elastic catenary")
    axes.set_xticks(links, [str(n) for n in links])
    axes.minorticks_off()
    axes.legend(fontsize=7, frameon=False)


def elastica(axes: Any) -> None:
    """Droop of a clamped strip over its weight, against the heavy elastica."""
    weights = np.geomspace(0.3, 60, 40)
    axes.plot(weights, [elastica_droop(w) for w in weights], "k-", lw=1, label="heavy elastica")
    for bending, marker, color in (("hinge", "o", "#d1495b"), ("quadratic", "x", "#2e86ab")):
        found = []
        for weight in (0.5, 2.0, 8.0, 30.0):
            fabric = Material(density=0.2, stretch_stiffness=200, shear_stiffness=80, bend_rigidity=2e-5, damping_time=1e-4)
            strip = cantilever(fabric, overhang=bending_length(fabric) * weight ** (1 / 3), bending=bending)
            found.append((strip.weight, strip.droop))
        axes.plot(*zip(*found), marker, ms=6, color=color, label=f"bending={bending!r}")
    axes.set(xscale="log", xlabel="G = weight L^3 / B", ylabel="droop of the chord [degrees]", title="Cantilever")
    axes.legend(fontsize=7, frameon=False)


def softness(axes: Any) -> None:
    """Stiffness of a chain of 8 links under XPBD, over the nominal one, by iterations and substep."""
    links, counts = 8, (1, 2, 4, 8, 64)
    q2 = np.geomspace(0.01, 4, 9)
    for iterations in counts:
        found = []
        for q in q2:
            method = {"name": "xpbd", "iterations": iterations}
            hanging = chain(line(links + 1, 1.0), method, 0.01, q / 1e-4, 1.0, gravity=(0, 0, 0), anchors=[0])
            found.append(_stiffness(hanging, 1e-4 * q / 1e-4, links) / (q / 1e-4))
        axes.plot(q2, found, "o-", ms=3, lw=1, label=f"{iterations} iterations" if iterations > 1 else "1 iteration")
    axes.plot(q2, 1 / (1 + q2 * (links - 1) / links), "k--", lw=0.9, label="1/(1 + q^2 (N - 1)/N)")
    axes.set(xscale="log", xlabel="q^2 = h^2 k/m", ylabel="stiffness over nominal", title="XPBD: a chain of 8 links", ylim=(0, 1.1))
    axes.legend(fontsize=7, frameon=False)


def _stiffness(hanging: Simulation, load: float, links: int) -> float:
    """Of a link, from the whole elongation at rest under an end load [N]: ``load N / elongation`` [N/m]."""
    state = hanging.get_state()
    state.drag_rate[:] = 3.0
    hanging.set_state(state)
    view, h = hanging.view, hanging.time_step / hanging.substeps
    for _ in range(3000):
        view.v[0, 0, -1, 0] += h * load * (1 + 3.0 * h)  # the substep's drag takes its share of the push as well
        hanging.step()
    return load * links / (hanging.positions[0, -1, 0] - links)


def strain_map(axes: Any) -> None:
    """Provot's soft sheet at rest, and with a limit: strain of its threads and diagonals; all springs and masses are alike."""
    sheet = grid(17, 17, 1.0, 1.0)
    sheet = replace(sheet, springs=sheet.springs._replace(weight=np.ones_like(sheet.springs.weight)), area=np.full(289, 1 / 289))
    fabric = Material(density=0.1, stretch_stiffness=1.0, shear_stiffness=0.4, bend_rigidity=0, damping_time=0.0, air_drag=0.1)
    for limit, offset in ((None, 0.0), (0.1, 2.3)):
        cloth = Simulation(
            sheet, fabric, integrator="semi_implicit_euler", substeps=8, anchors=(0, 16), gravity=(0, G, 0), air_density=0,
            strain_limit=limit, dtype="float64",
        )  # fmt: skip
        state = cloth.get_state()
        state.stiffness[:] = 1.0
        cloth.set_state(state)
        cloth.step(900)
        springs = sheet.springs
        shown = springs.kind <= SHEAR
        ends = cloth.positions[0][springs.particles[shown]][:, :, :2]
        vectors = cloth.positions[0][springs.particles[shown, 1]] - cloth.positions[0][springs.particles[shown, 0]]
        strain = np.linalg.norm(vectors, axis=1) / springs.rest_length[shown] - 1
        flipped = np.stack([ends[:, :, 0] + offset, -ends[:, :, 1]], axis=2)
        drawn = LineCollection(list(flipped), array=strain, cmap="magma_r", lw=0.9, clim=(0, 1.75))
        axes.add_collection(drawn)
        worst = int(np.argmax(strain))
        label = "no limit" if limit is None else f"limit {limit:.0%}"
        axes.text(offset, 0.62, f"{label}: {strain.max():.1%}", ha="center", fontsize=8)
        axes.plot(*flipped[worst].T, color="#1d6fb8", lw=3)
    axes.set(title="Provot's sheet: strain; thick: the largest", xlim=(-0.8, 3.1), ylim=(-1.1, 0.8), aspect="equal")
    axes.axis("off")
    plt.colorbar(drawn, ax=axes, shrink=0.7)


def main() -> None:
    warnings.filterwarnings("ignore", message=".*substeps of.*")  # xpbd at the others' substep is part of the picture
    figure, panels = plt.subplots(2, 3, figsize=(14, 8.2), layout="constrained")
    begun = time.perf_counter()
    for axes, draw in zip(panels.flat, (orders, swings, catenary, elastica, softness, strain_map)):
        draw(axes)
        axes.spines[["top", "right"]].set_visible(False)
        print(f"{draw.__name__} {time.perf_counter() - begun:.0f} s", flush=True)
    figure.savefig(PICTURE, dpi=120)
    plt.close(figure)
    print(f"written to {PICTURE}")


if __name__ == "__main__":
    main()
