"""Recordings: frames that can be shown again, saved to a file and loaded."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym import files
from clothgym.checks import finite, members, positive
from clothgym.collisions import MeshCollider
from clothgym.material import spring_stiffness
from clothgym.mesh import NUM_KINDS, SHEAR, ClothMesh, Hinges, Springs, frozen
from clothgym.parameters import PROPERTIES
from clothgym.render import Camera, Drawn
from clothgym.render.solids import KINDS, check_color
from clothgym.simulation import Simulation

TOUCHING = 1e-3  # distance from where it would rest within which a particle touches a solid [m]
VERSION = 1  # of the format of files
MOST_SOLIDS, MOST_TEXT, FINEST = 10_000, 2**24, 128  # shapes of solids in a file, characters and cells of one
# arrays of a file: the kind of their numbers, and their shape by the sizes of the recording
ARRAYS: dict[str, tuple[str, tuple[int | str, ...]]] = {
    "time": ("f", ("frames",)),
    "positions": ("f", ("frames", "sheets", "particles", 3)),
    "stiffness": ("f", ("frames", "sheets", NUM_KINDS)),
    "touching": ("b", ("frames", "sheets", "particles")),
    "solids": ("f", ("rows", 5)),
    "mesh: rest_positions": ("f", ("particles", 3)),
    "mesh: triangles": ("i", ("triangles", 3)),
    "mesh: area": ("f", ("particles",)),
    "springs: particles": ("i", ("springs", 2)),
    "springs: rest_length": ("f", ("springs",)),
    "springs: kind": ("i", ("springs",)),
    "springs: weight": ("f", ("springs",)),
    "hinges: particles": ("i", ("hinges", 4)),
    "hinges: weight": ("f", ("hinges",)),
    "hinges: rest_angle": ("f", ("hinges",)),
    "hinges: slopes": ("f", ("hinges", 4)),
}
MESH = tuple(name.removeprefix("mesh: ") for name in ARRAYS if name.startswith("mesh: "))


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
        """Write as ``npz`` without pickle, whole or not at all.

        Raises:
            ValueError: there are no frames.
            OSError: the disk is full, or the folder cannot be written.
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
            "time": np.array([frame.time for frame in frames], np.float64),
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
        files.write_arrays(path, "recording", VERSION, {"about": np.array(json.dumps(about)), **arrays, **mesh}, compressed=True)

    @staticmethod
    def load(path: str | Path) -> Recording:
        """Read what ``save`` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is not a recording, is damaged, or is of another version.
        """
        advice = "give a file that the playground saved"
        arrays = files.read_arrays(path, "recording", VERSION, advice)
        with files.naming(path, "recording", advice):
            return _from_arrays(arrays)


def _column(values: list[Any]) -> NDArray[np.float64]:
    """Numbers of successive frames, nan where there are none."""
    shape = np.shape(next(value for value in values if value is not None))
    return np.array([np.full(shape, np.nan) if value is None else value for value in values], np.float64)


def _from_arrays(arrays: dict[str, NDArray]) -> Recording:
    def fields_of(kind: str) -> dict[str, NDArray]:
        return {key.removeprefix(f"{kind}: "): value for key, value in arrays.items() if key.startswith(f"{kind}: ")}

    about = json.loads(str(arrays.pop("about")))
    members("labels", about["labels"], str, "names of the sheets")
    _check_arrays(arrays, len(about["labels"]))
    sheet = {name: frozen(value) for name, value in fields_of("mesh").items()}
    mesh = ClothMesh(
        size=tuple(positive("size", side) for side in about["size"]),  # type: ignore[arg-type]
        springs=Springs(**{name: frozen(value) for name, value in fields_of("springs").items()}),
        hinges=Hinges(**{name: frozen(value) for name, value in fields_of("hinges").items()}),
        shape=tuple(about["grid"]) if about["grid"] else None,
        **sheet,  # type: ignore[arg-type]
    )
    if mesh.shape is not None and (len(mesh.shape) != 2 or min(mesh.shape) < 2 or np.prod(mesh.shape) != mesh.num_particles):
        raise ValueError(f"a grid of {mesh.shape} has not {mesh.num_particles} particles")
    if len(about["shapes"]) > MOST_SOLIDS:
        raise ValueError(f"it has {len(about['shapes']):,} shapes of solids, at most {MOST_SOLIDS:,} are read")
    positions, count = arrays["positions"], len(arrays["time"])
    shapes = [_from_text(text) for text in about["shapes"]]
    solids: list[list[Drawn]] = [[] for _ in range(count)]
    for number, shape, *center in arrays["solids"].tolist():
        solids[_place(number, count)].append(shapes[_place(shape, len(shapes))].at(center))
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
    time_step, strained = (positive(name, about[name]) for name in ("time_step", "strained"))
    return Recording(str(about["title"]), mesh, time_step, Camera(**about["camera"]), about["labels"], strained, frames)


def _check_arrays(arrays: Mapping[str, NDArray], sheets: int) -> None:
    """Refuse arrays that do not fit together, or that hold what no recording can.

    Raises:
        ValueError: the array, and what is wrong with it.
    """
    sizes: dict[str | int, int] = {"sheets": sheets}
    if lacking := sorted(set(ARRAYS) - set(arrays)):
        raise ValueError(f"it lacks {', '.join(lacking)}")
    for name, (kind, shape) in ARRAYS.items():
        array = arrays[name]
        for axis, length in zip(shape, array.shape):
            sizes.setdefault(axis, axis if isinstance(axis, int) else length)
        if array.dtype.kind != kind or array.shape != tuple(sizes.get(axis, -1) for axis in shape):
            raise ValueError(f"{name} have shape {array.shape} and kind {array.dtype}, not {shape}")
        if kind == "f":
            finite(name, array)
    if min(sizes["frames"], sizes["sheets"]) == 0:
        raise ValueError("it has no frames")
    # what is named is there
    for name, end in (("mesh: triangles", "particles"), ("springs: particles", "particles"), ("hinges: particles", "particles")):
        if arrays[name].size and (arrays[name].min() < 0 or arrays[name].max() >= sizes[end]):
            raise ValueError(f"{name} name particles that there are not")
    kinds, lengths = arrays["springs: kind"], arrays["springs: rest_length"]
    if np.any((kinds < 0) | (kinds >= NUM_KINDS)) or np.any(lengths <= 0):
        raise ValueError("springs have a kind that there is not, or no length")
    # readings of every frame; nan where there were none, and anything where a sheet has burst
    for name in sorted(set(arrays) - set(ARRAYS)):
        each = {"readings": (sizes["frames"], sizes["sheets"]), "terms": (sizes["frames"],)}
        if arrays[name].shape != each.get(name.partition(": ")[0]) or arrays[name].dtype.kind != "f":
            raise ValueError(f"{name} is no reading of its frames")


def _place(value: float, end: int) -> int:
    """A place in a list of that length."""
    if not (value == int(value) and 0 <= value < end):
        raise ValueError(f"solids name frame or shape {value:g}, of {end}")
    return int(value)


def _as_text(solid: Drawn) -> str:
    collider = solid.collider
    written = {"kind": solid.kind, "color": solid.color} | {item.name: getattr(collider, item.name) for item in fields(collider)}
    if isinstance(collider, MeshCollider):  # its file may be gone when it is read
        vertices, triangles = collider.surface
        written |= {"path": None, "scale": 1.0, "vertices": vertices, "triangles": triangles}
    return json.dumps(written, default=lambda value: value.tolist())


def _from_text(text: str) -> Drawn:
    if not isinstance(text, str) or len(text) > MOST_TEXT:
        raise ValueError("the description of a solid is no text, or too long")
    given: dict[str, Any] = json.loads(text)
    kind = KINDS[given["kind"]]
    own = {item.name: _tuple(given[item.name]) for item in fields(kind)}
    if own.get("path") is not None or own.get("resolution", 0) > FINEST:
        raise ValueError("a mesh must be in the recording itself, and be no finer than those that are saved")
    check_color("color", given["color"])
    return Drawn(kind(**own), _tuple(given["color"]))


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
