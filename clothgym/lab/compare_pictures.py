"""Pictures of a comparison: a work-precision plot, and the sheets side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.integrators import INTEGRATORS
from clothgym.lab.compare_plan import LANES, Row, Setting, described
from clothgym.lab.compare_scenes import Scene
from clothgym.render import Camera, Renderer

INK, QUIET = "#2b2d42", "#8d99ae"
REFERENCE = "#c4bdb2"
STYLES = (("-", "o"), ("--", "s"), (":", "^"))
PANEL, ACROSS, DPI = 300, 5, 100  # pixels of a sheet's picture, sheets in a row, pixels of an inch
FLOATING = 1e-4  # lower end of the error axis, at the rounding of float32 [mm]


def pyplot() -> Any:
    """matplotlib.pyplot without windows.

    Raises:
        ImportError: matplotlib is missing; the message says how to install it.
    """
    try:
        import matplotlib
    except ImportError as error:
        raise ImportError('the plots need matplotlib: pip install "clothgym[plots]"') from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot


def draw_work_precision(results: Row, path: Path) -> None:
    """Plot error over cost: a color for each integrator, and a line for each choice of its options."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9.6, 5.0), layout="constrained")
    axes.set(xscale="log", yscale="log")
    lines: dict[tuple[str, str], list[Row]] = {}
    for row in results["rows"]:
        if not row["variant"]:
            lines.setdefault((row["integrator"], described(row["options"])), []).append(row)
    seen: dict[str, int] = {}
    for (name, options), rows in lines.items():
        style, marker = STYLES[seen.setdefault(name, 0)]
        seen[name] += 1
        stable = [row for row in rows if row["stable"]]
        failed = [row["substeps"] for row in rows if not row["stable"]]
        label = f"{name}, {options}" if options else name
        notes = ["inconsistent"] * (not rows[0]["consistent"])
        if failed:
            notes.append(f"unstable with {max(failed)}" + " or fewer" * (len(failed) > 1) if stable else "always unstable")
        x, y = ([row[key] for row in stable] for key in ("ms_batch", "error_mm"))
        look = {"ls": style, "marker": marker, "ms": 4.5, "lw": 1.5, "mfc": INTEGRATORS[name].color if seen[name] == 1 else "white"}
        axes.plot(x, np.maximum(y, FLOATING), color=INTEGRATORS[name].color, label="\n   ".join([label, *notes]), **look)
        if stable and seen[name] == 1:
            for row in (stable[0], stable[-1]):
                place = row["ms_batch"], max(row["error_mm"], FLOATING)
                offset = (4, -10) if name == "semi_implicit_euler" else (4, 4)  # verlet's line is the same
                look = {"fontsize": 7.5, "color": INTEGRATORS[name].color, "clip_on": True}
                axes.annotate(row["substeps"], place, offset, textcoords="offset points", **look)
    scene, about = results["scene"], results["reference"]
    bound = 5 * max(scene["size"][2:])
    axes.axhline(bound, color=QUIET, lw=0.9, ls=(0, (6, 4)), zorder=0)
    axes.annotate(
        "5 mm per meter", (1, bound), (-2, 3), ("axes fraction", "data"), "offset points", ha="right", color=QUIET, fontsize=8
    )
    axes.set_xlabel(f"ms of one core per simulated second of one sheet, one of {LANES}", color=INK)
    axes.set_ylabel(f"rms error after {about['seconds']:g} s [mm]", color=INK)
    axes.set_title(f"{scene['name']}: {scene['breaks'].split(':')[0]}", loc="left", fontsize=11, color=INK)
    axes.grid(which="major", color="#e4e2dd", lw=0.6)
    axes.legend(
        frameon=False, fontsize=8.5, loc="upper left", bbox_to_anchor=(1.0, 1.0), title="numbers: substeps of a 1/60 s step",
        title_fontsize=8.5, alignment="left",
    )  # fmt: skip
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def draw_sheets(scene: Scene, reference: NDArray, sheets: Sequence[tuple[Setting, Row, NDArray | None]], path: Path) -> None:
    """Draw the reference, and the sheet of each integrator in its color; an unstable one as it bursts, from above.

    reference, sheets: positions [m], (particles, 3); None for an unstable one of an older record.
    """
    plt = pyplot()
    labels, pictures = ["converged reference\n"], [_picture(scene, reference, REFERENCE)]
    for setting, row, sheet in sheets:
        outcome = f"{row['error_mm']:.3g} mm off" if row["stable"] else "bursts"
        detail = setting.variant or f"{setting.substeps} substeps"
        labels.append(f"{setting.integrator}\n{detail}, {outcome}")
        pictures.append(_picture(scene, sheet, INTEGRATORS[setting.integrator].color, burst=not row["stable"]))
    across = min(ACROSS, len(pictures))
    down = -(-len(pictures) // across)
    figure = plt.figure(figsize=(across * PANEL / DPI, down * (PANEL + 52) / DPI), facecolor="white")
    for place, (label, picture) in enumerate(zip(labels, pictures)):
        row_number, column = divmod(place, across)
        left, top = column / across, 1 - row_number / down
        high = PANEL / (PANEL + 52) / down
        axes = figure.add_axes((left + 0.002, top - high, 1 / across - 0.004, high))
        axes.imshow(picture, aspect="auto", interpolation="antialiased")
        axes.set_axis_off()
        first, second = label.split("\n")
        color = INTEGRATORS[first].color if first in INTEGRATORS else INK
        middle, under = left + 0.5 / across, top - high
        unit = 1 / (down * (PANEL + 52))
        figure.text(middle, under - 6 * unit, first, ha="center", va="top", fontsize=12, weight="bold", color=color)
        figure.text(middle, under - 27 * unit, second, ha="center", va="top", fontsize=10.5, color=INK)
    figure.savefig(path, dpi=DPI)
    plt.close(figure)


def _picture(scene: Scene, sheet: NDArray | None, color: str, burst: bool = False) -> NDArray[np.uint8]:
    """A sheet above the floor, or the floor alone, (PANEL, PANEL, 3); one that has burst as a whole, from above."""
    front = tuple(int(color[place : place + 2], 16) for place in (1, 3, 5))
    back = tuple(round(0.6 * value) for value in front)
    renderer = Renderer(
        scene.mesh.triangles,
        scene.mesh.rest_positions[:, :2],
        _above(sheet, scene) if burst and sheet is not None else Camera(eye=scene.eye, target=scene.target),
        PANEL,
        PANEL,
        antialias=3,
        threads=1,
        grid_shape=scene.mesh.shape,
        front=front,  # type: ignore[arg-type]
        back=back,  # type: ignore[arg-type]
    )
    if sheet is None:
        return renderer.rgb(np.full_like(scene.mesh.rest_positions, -9.0))  # far below the floor
    pins = [(tuple(sheet[p]), (43, 45, 66)) for p in scene.held if len(scene.held) <= 4]
    return renderer.rgb(sheet, markers=pins)  # type: ignore[arg-type]


def _above(sheet: NDArray, scene: Scene) -> Camera:
    """A camera that sees all of a sheet obliquely from above, from the side of the scene's own."""
    middle = (sheet.min(axis=0) + sheet.max(axis=0)) / 2
    radius = float(np.linalg.norm(sheet - middle, axis=1).max())
    side = np.subtract(scene.eye, scene.target)[:2]
    way = np.append(side / np.linalg.norm(side), 1.1)
    distance = 3.2 * radius
    return Camera(
        eye=tuple(middle + distance * way / np.linalg.norm(way)),
        target=tuple(middle),
        vertical_fov=2 * float(np.degrees(np.arcsin(radius / distance))),
    )
