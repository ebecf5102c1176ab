"""Recordings: frames that can be shown again, saved to a file and loaded."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import positive
from clothgym.collisions import MeshCollider
from clothgym.material import spring_stiffness
from clothgym.mesh import SHEAR, ClothMesh, Hinges, Springs, frozen
from clothgym.parameters import PROPERTIES
from clothgym.render import Camera, Drawn
from clothgym.render.solids import KINDS
from clothgym.simulation import Simulation

TOUCHING = 1e-3  # distance from where it would rest within which a particle touches a solid [m]
MESH = ("rest_positions", "triangles", "area")


@dataclass(frozen=True)
class Frame:
    """One moment; the first axis of its arrays is the sheet, of which a comparison has several.

    Attributes:
        time: since the start [s].
        positions: [m], (sheets, particles, 3) float32.
        stiffness: of the springs by kind [N/m], (sheets, kinds).
        touching: which particles touch a solid, (sheets, particles).
        solids: what is drawn beside the sheets.
        readings: numbers by name, (sheets,) each.
        terms: reward terms by name; none outside an environment.
    """

    time: float
    positions: NDArray[np.float32]
    stiffness: NDArray[np.float64]
    touching: NDArray[np.bool_]
    solids: tuple[Drawn, ...] = ()
    readings: Mapping[str, NDArray[np.float64]] = field(default_factory=dict)
    terms: Mapping[str, float] = field(default_factory=dict)


def read(simulation: Simulation, cost: float, penetration: float) -> dict[str, float]:
    """The readings of one sheet: largest strain of its yarns, energy [J], deepest penetration [m], and a control step's cost [s].

    With a strain limit also the largest strain before limiting in the last control step.  cost, penetration: measured elsewhere.
    """
    energy, limiting = simulation.energy(), simulation.limiting
    readings = {
        "strain": float(simulation.strain().max()),
        "energy": float(energy.total[0]),
        "kinetic": float(energy.kinetic[0]),
        "penetration": penetration,
        "cost": cost,
    }
    if limiting is not None:
        readings["strain before limiting"] = float(limiting.before[0])
    return readings


def touching(simulation: Simulation) -> NDArray[np.bool_]:
    """Which particles of its first sheet touch a solid, (particles,)."""
    # distances are to the surface at which the cloth comes to rest
    return simulation.contacts().distance[0] <= TOUCHING


def stiffness(simulation: Simulation) -> NDArray[np.float64]:
    """Of its first sheet's springs by kind [N/m], (kinds,); bending springs only if hinges do not bend the sheet."""
    properties = dict(zip(PROPERTIES, simulation.parameters[0]))
    bend = 0.0 if simulation.bending.hinged else properties["bend_rigidity"]
    moduli = (properties["stretch_stiffness"], properties["shear_stiffness"], bend)
    return spring_stiffness(simulation.mesh, *(np.array(modulus) for modulus in moduli))


# --- springs ------------------------------------------------------------------------------------------------------------


def yarns(mesh: ClothMesh, diagonals: bool = False) -> NDArray[np.int64]:
    """The springs that are drawn: yarns, or edges of a triangle mesh, and optionally diagonals."""
    return np.flatnonzero(mesh.springs.kind <= SHEAR if diagonals else mesh.springs.kind < SHEAR)


def strains(mesh: ClothMesh, x: NDArray, springs: NDArray) -> NDArray[np.float64]:
    """Length over rest length, minus one, (springs,); x: positions [m], (particles, 3)."""
    first, second = x[mesh.springs.particles[springs]].transpose(1, 0, 2).astype(np.float64)
    return np.linalg.norm(second - first, axis=1) / mesh.springs.rest_length[springs] - 1


def tensions(mesh: ClothMesh, x: NDArray, springs: NDArray, stiffness: NDArray) -> NDArray[np.float64]:
    """Elastic force of each spring [N], (springs,), negative where it pushes; stiffness by kind [N/m], (kinds,)."""
    constant = stiffness[mesh.springs.kind[springs]] * mesh.springs.weight[springs]
    return constant * strains(mesh, x, springs) * mesh.springs.rest_length[springs]


# --- files --------------------------------------------------------------------------------------------------------------


@dataclass
class Recording:
    """Frames of one mesh.

    Attributes:
        title: of the scene or environment.
        mesh: the sheet; time_step: between frames [s]; camera: where it is seen from.
        labels: a name for each sheet.
        strained: strain at which the color scale ends.
        frames: in order.
    """

    title: str
    mesh: ClothMesh
    time_step: float
    camera: Camera
    labels: Sequence[str] = ("",)
    strained: float = 0.05
    frames: list[Frame] = field(default_factory=list)

    def save(self, path: str | Path) -> None:
        """Write as ``npz`` without pickle.

        Raises:
            ValueError: there are no frames.
        """
        if not self.frames:
            raise ValueError(f"{str(path)!r}: there are no frames to save yet")
        frames = self.frames
        shapes: dict[Drawn, int] = {}
        solids = [
            (number, shapes.setdefault(solid.at_origin, len(shapes)), *solid.collider.center)
            for number, frame in enumerate(frames)
            for solid in frame.solids
        ]
        arrays: dict[str, Any] = {
            "time": [frame.time for frame in frames],
            "positions": [frame.positions for frame in frames],
            "stiffness": [frame.stiffness for frame in frames],
            "touching": [frame.touching for frame in frames],
            "solids": np.array(solids, np.float64).reshape(-1, 5),
        }
        names = {kind: sorted({name for frame in frames for name in getattr(frame, kind)}) for kind in ("readings", "terms")}
        for kind in names:
            for name in names[kind]:
                arrays[f"{kind}: {name}"] = _column([getattr(frame, kind).get(name) for frame in frames])
        about = {
            "title": self.title, "time_step": self.time_step, "labels": list(self.labels), "strained": self.strained,
            "camera": asdict(self.camera), "shapes": list(map(_as_text, shapes)), "grid": self.mesh.shape, "size": self.mesh.size,
        }  # fmt: skip
        mesh = {f"mesh: {name}": getattr(self.mesh, name) for name in MESH}
        mesh |= {f"springs: {name}": value for name, value in self.mesh.springs._asdict().items()}
        mesh |= {f"hinges: {name}": value for name, value in self.mesh.hinges._asdict().items()}
        np.savez_compressed(path, about=json.dumps(about), **arrays, **mesh)

    @staticmethod
    def load(path: str | Path) -> Recording:
        """Read what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a recording, or a broken one.
        """
        try:
            if not zipfile.is_zipfile(path) and Path(path).stat():  # a missing file raises here
                raise ValueError("not an npz file")
            with np.load(path, allow_pickle=False) as file:
                return _from_arrays(dict(file))
        except (KeyError, AttributeError, TypeError, IndexError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise ValueError(f"{str(path)!r} is no recording ({error}): give a file that the playground saved") from error


def _column(values: list[Any]) -> NDArray[np.float64]:
    """Numbers of successive frames, nan where there are none."""
    shape = np.shape(next(value for value in values if value is not None))
    return np.array([np.full(shape, np.nan) if value is None else value for value in values], np.float64)


def _from_arrays(arrays: dict[str, NDArray]) -> Recording:
    def fields_of(kind: str) -> dict[str, NDArray]:
        return {key.removeprefix(f"{kind}: "): value for key, value in arrays.items() if key.startswith(f"{kind}: ")}

    about = json.loads(str(arrays["about"]))
    sheet = {name: frozen(value) for name, value in fields_of("mesh").items()}
    mesh = ClothMesh(
        size=tuple(about["size"]),
        springs=Springs(**{name: frozen(value) for name, value in fields_of("springs").items()}),
        hinges=Hinges(**{name: frozen(value) for name, value in fields_of("hinges").items()}),
        shape=tuple(about["grid"]) if about["grid"] else None,
        **sheet,
    )
    positions, count = arrays["positions"], len(arrays["time"])
    if positions.ndim != 4 or positions.shape[::2] != (count, mesh.num_particles) or positions.shape[3] != 3 or not count:
        raise ValueError(f"positions have shape {positions.shape}, not ({count}, sheets, {mesh.num_particles}, 3)")
    for name, members in (("triangles", mesh.triangles), ("springs", mesh.springs.particles)):
        if members.size and (members.min() < 0 or members.max() >= mesh.num_particles):
            raise ValueError(f"{name} name particles that there are not")
    if len(about["labels"]) != positions.shape[1]:
        raise ValueError(f"it has {positions.shape[1]} sheets and names for {len(about['labels'])}")
    shapes = [_from_text(text) for text in about["shapes"]]
    solids: list[list[Drawn]] = [[] for _ in range(count)]
    for number, shape, *center in arrays["solids"].tolist():
        solids[int(number)].append(shapes[int(shape)].at(center))
    readings, terms = fields_of("readings"), fields_of("terms")
    frames = [
        Frame(
            time=float(arrays["time"][k]),
            positions=positions[k],
            stiffness=arrays["stiffness"][k],
            touching=arrays["touching"][k],
            solids=tuple(solids[k]),
            readings={name: values[k] for name, values in readings.items()},
            terms={name: float(values[k]) for name, values in terms.items() if np.isfinite(values[k])},
        )
        for k in range(count)
    ]
    camera = Camera(**about["camera"])
    return Recording(
        str(about["title"]), mesh, positive("time_step", about["time_step"]), camera, about["labels"], about["strained"], frames
    )


def _as_text(solid: Drawn) -> str:
    collider = solid.collider
    written = {"kind": solid.kind, "color": solid.color} | {item.name: getattr(collider, item.name) for item in fields(collider)}
    if isinstance(collider, MeshCollider):  # its file may be gone when it is read
        vertices, triangles = collider.surface
        written |= {"path": None, "scale": 1.0, "vertices": vertices, "triangles": triangles}
    return json.dumps(written, default=lambda value: value.tolist())


def _from_text(text: str) -> Drawn:
    given: dict[str, Any] = json.loads(text)
    kind = KINDS[given["kind"]]
    # in older files each solid has the sizes of all kinds, its own and others
    own = {item.name: _tuple(given[item.name]) for item in fields(kind) if item.name in given}
    return Drawn(kind(**own), _tuple(given["color"]))


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
