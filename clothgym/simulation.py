"""Floor 5: the main loop.

``advance`` is all that happens in a control step; the rest of the file is the door through which people reach it.
"""

from __future__ import annotations

import difflib
import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import _jit, integrators
from clothgym._jit import specialize
from clothgym.checks import count, finite, indices, positive, spread, vector
from clothgym.collisions import ROWS, Collider, Contacts, resolve, signed_distances
from clothgym.forces import Energy, energy
from clothgym.integrators import Integrator
from clothgym.material import Material, spring_stiffness
from clothgym.mesh import BEND_X, SHEAR, ClothMesh
from clothgym.state import Fabric, Layout, SpringArrays, State, spring_arrays

GRAVITY = 9.81
FIGURES = ("density", "stretch_stiffness", "shear_stiffness", "bend_rigidity", "damping_time", "air_drag")


def advance(first, last, x, v, w, springs, fabric, kinds, colliders, h, substeps):
    """One control step of blocks ``first`` to ``last``: a block does all its substeps before the next, and stays in cache."""
    stiffness, damping_time, drag_rate, gravity, wind = fabric
    for b in range(first, last):
        work = np.empty((x.shape[1] + 1, 3, x.shape[3]), x.dtype)
        contact = np.empty((4, x.shape[3]), x.dtype)
        for _ in range(substeps):
            substep(  # noqa: F821 - the integrator's, bound by specialize
                x[b], v[b], w[b], springs, stiffness[b], damping_time[b], drag_rate[b], gravity[b], wind[b], h, work
            )
            resolve(x[b], v[b], w[b], kinds, colliders[b], h, contact)


@cache
def _compiled(integrator: Integrator) -> Any:
    return specialize(advance, f"advance_{integrator.name}", substep=integrator.substep)


class View(NamedTuple):
    """The live memory of a simulation, for kernels that read it: see ``state`` for its layout."""

    x: NDArray
    v: NDArray
    springs: SpringArrays


class Simulation:
    """A batch of sheets of one mesh, each in a world of its own.

    Args:
        mesh: the sheet, for instance ``grid(17, 17, 0.6, 0.6)``; it starts at its rest positions, at rest.
        material: the fabric; ``set_parameters`` changes it by environment.
        num_envs: environments in the batch.
        integrator: a name of ``INTEGRATORS`` or an ``Integrator``.
        time_step: control step [s].
        substeps: substeps of a control step; "auto" takes them from the integrator's bound for this mesh and material.
        gravity: [m/s^2], (3,).
        wind: velocity of the air [m/s], (3,).
        colliders: solids, the same for all environments until ``set_collider``.
        anchors: particles that can be held; all are attached at first and stay where they are until ``move_anchors``.
        anchor_speed: largest speed of an anchor [m/s].
        dtype: "float32", or "float64" for reference runs.
        threads: threads to use; all processors by default.  The outcome does not depend on it.

    Raises:
        ValueError: a value that makes no sense; the message names it and what would do.
    """

    def __init__(
        self,
        mesh: ClothMesh,
        material: Material | None = None,
        num_envs: int = 1,
        integrator: str | Integrator = "semi_implicit_euler",
        time_step: float = 1 / 60,
        substeps: int | Literal["auto"] = "auto",
        gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
        wind: ArrayLike = (0.0, 0.0, 0.0),
        colliders: Sequence[Collider] = (),
        anchors: Sequence[int] = (),
        anchor_speed: float = 10.0,
        dtype: str = "float32",
        threads: int | None = None,
    ) -> None:
        if not isinstance(mesh, ClothMesh):
            raise ValueError(f"mesh={mesh!r}: must be a ClothMesh, for instance clothgym.grid(17, 17, 0.6, 0.6)")
        if material is not None and not isinstance(material, Material):
            raise ValueError(f"material={material!r}: must be a Material, for instance Material.preset('cotton')")
        if isinstance(colliders, Collider) or not all(isinstance(c, Collider) for c in colliders):
            raise ValueError(f"colliders={colliders!r}: must be a sequence of Plane, Sphere, Capsule or Box")
        count("num_envs", num_envs)
        if dtype not in ("float32", "float64"):
            raise ValueError(f"dtype={dtype!r}: must be 'float32' or 'float64'")
        if threads is not None:
            count("threads", threads)
        self.mesh = mesh
        self.material = material if material is not None else Material.preset("cotton")
        self.integrator = integrators.get(integrator)
        self.time_step = positive("time_step", time_step)
        self.anchor_speed = positive("anchor_speed", anchor_speed)
        self.dtype = np.dtype(dtype)
        self.threads = threads if threads is not None else _jit.default_threads()
        self.layout = Layout.choose(int(num_envs), self.threads)
        self.anchors = indices("anchors", anchors, mesh.num_particles, "particles of this mesh")
        if len(set(self.anchors.tolist())) < self.anchors.size:
            raise ValueError(f"anchors={list(anchors)!r}: a particle is named twice")
        self.colliders = tuple(colliders)
        self._kinds = np.array([c.kind for c in self.colliders], np.int64)
        self._springs = spring_arrays(mesh, self.dtype, self.integrator.springs_by_particle)
        self._advance = _compiled(self.integrator)

        everyone = (self.num_envs,)
        rows = np.array([c.rows() for c in self.colliders]).reshape(-1, ROWS)
        solids = np.broadcast_to(rows, (*everyone, *rows.shape))
        state = State(
            positions=np.broadcast_to(mesh.rest_positions, (*everyone, mesh.num_particles, 3)),
            velocities=np.zeros((*everyone, mesh.num_particles, 3)),
            free_inverse_mass=np.zeros((*everyone, mesh.num_particles)),
            anchors=np.broadcast_to(self.anchors, (*everyone, self.anchors.size)),
            attached=np.ones((*everyone, self.anchors.size), bool),
            anchor_targets=np.broadcast_to(mesh.rest_positions[self.anchors], (*everyone, self.anchors.size, 3)),
            stiffness=np.zeros((*everyone, BEND_X + 2)),
            damping_time=np.zeros(everyone),
            drag_rate=np.zeros(everyone),
            gravity=np.broadcast_to(vector("gravity", gravity), (*everyone, 3)),
            wind=np.broadcast_to(vector("wind", wind), (*everyone, 3)),
            parameters=np.broadcast_to([getattr(self.material, name) for name in FIGURES], (*everyone, len(FIGURES))),
            colliders=solids,
            collider_homes=solids,
            steps=np.zeros(everyone, np.int64),
        )
        self.set_state(state)
        self._apply_parameters(np.arange(self.num_envs))
        self.substeps = self._choose_substeps(substeps)

    # --- time -----------------------------------------------------------------------------------------------------------

    def step(self, n: int = 1) -> None:
        """Advance all environments by ``n`` control steps; anchors move towards their targets at a bounded speed."""
        count("n", n)
        h = self.dtype.type(self.time_step / self.substeps)

        def work(first: int, last: int) -> None:
            self._advance(
                first, last, self._x, self._v, self._w, self._springs, self._fabric, self._kinds, self._colliders, h, self.substeps
            )

        for _ in range(n):
            self._steer_anchors()
            _jit.run_spans(work, self.layout.blocks, self.threads)
            self._steps += 1

    def _steer_anchors(self) -> None:
        """Give each held particle the velocity that brings it to its target in one control step, if the limit allows."""
        for a, particle in enumerate(self.anchors):
            away = self._targets[:, a] - self._x[:, particle]
            speed = np.sqrt(away[:, 0] ** 2 + away[:, 1] ** 2 + away[:, 2] ** 2) / self.dtype.type(self.time_step)
            slow = np.maximum(speed / self.dtype.type(self.anchor_speed), self.dtype.type(1)) * self.dtype.type(self.time_step)
            held = self._attached[:, a][:, None]
            self._v[:, particle] = np.where(held, away / slow[:, None], self._v[:, particle])

    def _choose_substeps(self, substeps: int | str) -> int:
        if substeps == "auto":
            return self.integrator.automatic_substeps(self.time_step, self.largest_substep()[0])
        self.substeps = count("substeps", substeps, "'auto' or ")
        self._warn_if_beyond_bound(np.arange(1))
        return self.substeps

    def largest_substep(self, env: int = 0) -> tuple[float, str]:
        """Largest substep [s] that the integrator should be used with in that environment, and why."""
        return self.integrator.largest_substep(*self._oscillators(env))

    def _oscillators(self, env: int) -> tuple[ClothMesh, NDArray, float, NDArray]:
        """What decides on an environment's substep: mesh, spring constants, damping time and inverse masses."""
        block, lane = divmod(env, self.layout.lanes)
        stiffness = self._fabric.stiffness[block, :, lane].astype(np.float64)
        damping_time = float(self._fabric.damping_time[block, lane])
        return self.mesh, stiffness, damping_time, self._free_w[block, :, lane].astype(np.float64)

    def _warn_if_beyond_bound(self, envs: NDArray) -> None:
        h = self.time_step / self.substeps
        for env in envs.tolist():
            # the sharp bound needs an eigenvalue: only for those that a quick one does not clear
            if h <= self.integrator.surely_allowed(*self._oscillators(env)):
                continue
            largest, why = self.largest_substep(env)
            if h > largest:
                need = self.integrator.automatic_substeps(self.time_step, largest)
                warnings.warn(
                    f"{self.substeps} substeps of {h:.3g} s are too few for {self.integrator.name}: its bound here is "
                    f"{largest:.3g} s, {why}. Use substeps={need} or substeps='auto'.",
                    stacklevel=4,
                )
                return

    # --- what can be seen -----------------------------------------------------------------------------------------------

    @property
    def num_envs(self) -> int:
        return self.layout.num_envs

    @property
    def positions(self) -> NDArray:
        """[m], (num_envs, particles, 3); a fresh copy."""
        return self.layout.to_public(self._x)

    @property
    def velocities(self) -> NDArray:
        """[m/s], (num_envs, particles, 3); a fresh copy."""
        return self.layout.to_public(self._v)

    @property
    def view(self) -> View:
        """Positions, velocities and springs as the kernels see them; not a copy, and not to be written to."""
        return View(self._x, self._v, self._springs)

    @property
    def parameters(self) -> NDArray:
        """Material figures of each environment, in the order of ``FIGURES``, (num_envs, figures); a fresh copy."""
        return self._parameters.copy()

    @property
    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors); a fresh copy."""
        return self.layout.to_public(self._attached)

    def strain(self) -> NDArray:
        """Stretch over rest length, minus one, of the structural springs, (num_envs, structural springs)."""
        structural = self.mesh.springs.kind < SHEAR
        lengths = self._lengths()[:, structural]
        return lengths / self.mesh.springs.rest_length[structural].astype(self.dtype) - 1

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy [J], in float64."""
        return energy(self.mesh, self.get_state())

    def contacts(self) -> Contacts:
        """Signed distance of each particle to the nearest collider; negative would be inside."""
        if not self.colliders:
            shape = (self.num_envs, self.mesh.num_particles)
            return Contacts(np.full(shape, np.inf, self.dtype), np.full(shape, -1))
        out = np.empty((self.layout.blocks, len(self.colliders), self.mesh.num_particles, self.layout.lanes), self.dtype)
        signed_distances(0, self.layout.blocks, self._x, self._kinds, self._colliders, out)
        distances = self.layout.to_public(out)
        return Contacts(distances.min(axis=1), distances.argmin(axis=1))

    def _lengths(self) -> NDArray:
        x = self.positions
        ends = self.mesh.springs.particles
        return np.linalg.norm(x[:, ends[:, 1]] - x[:, ends[:, 0]], axis=2)

    # --- what can be done -----------------------------------------------------------------------------------------------

    def move_anchors(self, targets: ArrayLike) -> None:
        """Where the anchors are to be at the end of the next step [m], (num_envs, anchors, 3), as far as their speed allows."""
        self._targets[:] = self.layout.to_blocks(self._checked("targets", targets, (self.anchors.size, 3)), self.dtype)

    def release(self, envs: ArrayLike | None = None, anchors: ArrayLike | None = None) -> None:
        """Let go: pairs of environment and anchor (its place in ``anchors``), or all anchors, or all environments."""
        self._hold(envs, anchors, False)

    def attach(self, envs: ArrayLike | None = None, anchors: ArrayLike | None = None) -> None:
        """Take hold again, where the particle now is; arguments as for ``release``."""
        self._hold(envs, anchors, True)

    def _hold(self, envs: ArrayLike | None, anchors: ArrayLike | None, hold: bool) -> None:
        env = self._env_indices(envs)
        if anchors is None:
            which = np.tile(np.arange(self.anchors.size), len(env))
            env = np.repeat(env, self.anchors.size)
        else:
            which = spread("anchors", indices("anchors", anchors, self.anchors.size, "this simulation's anchors"), env.shape)
        block, lane = self.layout.place(env)
        particle = self.anchors[which]
        newly = self._attached[block, which, lane] != hold
        self._attached[block, which, lane] = hold
        if hold:
            b, a, p, l = block[newly], which[newly], particle[newly], lane[newly]
            self._targets[b, a, :, l] = self._x[b, p, :, l]
        self._apply_masses()

    def reset(self, envs: ArrayLike | None = None, positions: ArrayLike | None = None, velocities: ArrayLike | None = None) -> None:
        """Put environments back: rest positions or those given [m], at rest or as given [m/s], all anchors attached, solids
        that have moved where they began.

        positions, velocities: (len(envs), particles, 3), or one sheet for all, (particles, 3).
        """
        env = self._env_indices(envs)
        shape = (len(env), self.mesh.num_particles, 3)
        x = self.mesh.rest_positions if positions is None else finite("positions", positions)
        v = np.zeros(3) if velocities is None else finite("velocities", velocities)
        for name, value in (("positions", x), ("velocities", v)):
            if value.shape not in (shape, shape[1:], (3,)) or (name == "positions" and value.ndim < 2):
                raise ValueError(f"{name} has shape {value.shape}: must be {shape} or {shape[1:]}")
        block, lane = self.layout.place(env)
        self._x[block, :, :, lane] = np.broadcast_to(x, shape)
        self._v[block, :, :, lane] = np.broadcast_to(v, shape)
        self._colliders[block, :, :, lane] = self._collider_homes[block, :, :, lane]
        self._attached[block, :, lane] = True
        self._targets[block, :, :, lane] = self._x[block, :, :, lane][:, self.anchors]
        self._steps[env] = 0
        self._apply_masses()

    def set_parameters(self, envs: ArrayLike | None = None, warn: bool = True, **figures: ArrayLike) -> None:
        """Change material figures (see ``Material``), ``gravity`` or ``wind`` of some environments, by value or array.

        With ``warn``, figures that need more substeps than there are warn with the number that would do.

        Raises:
            ValueError: an unknown name, or a value that ``Material`` would not take; nothing is changed then.
        """
        env = self._env_indices(envs)
        block, lane = self.layout.place(env)
        parameters = self._parameters[env]
        fields: dict[str, NDArray] = {}
        for name, value in figures.items():
            if name in FIGURES:
                values = spread(name, finite(name, value), env.shape)
                for one in np.unique(values):
                    replace(self.material, **{name: float(one)})  # type: ignore[arg-type]
                parameters[:, FIGURES.index(name)] = values
            elif name in ("gravity", "wind"):
                fields[name] = spread(name, finite(name, value), (len(env), 3))
            else:
                known = (*FIGURES, "gravity", "wind")
                near = difflib.get_close_matches(name, known, n=1)
                hint = f"; did you mean {near[0]!r}?" if near else ""
                raise ValueError(f"no parameter {name!r}{hint} (there are: {', '.join(known)})")
        self._spring_constants(parameters)
        self._parameters[env] = parameters
        for name, value in fields.items():
            getattr(self._fabric, name)[block, :, lane] = value
        if any(name in FIGURES for name in figures):
            self._apply_parameters(env)
        if warn and any(name in FIGURES for name in figures):
            _, first = np.unique(parameters, axis=0, return_index=True)
            self._warn_if_beyond_bound(env[first])

    def set_collider(self, index: int, colliders: Sequence[Collider], envs: ArrayLike | None = None) -> None:
        """Put other solids of the same family (a plane, or any other) in place of collider ``index``, one an environment."""
        env = self._env_indices(envs)
        if not 0 <= index < len(self.colliders):
            raise ValueError(f"index={index!r}: this simulation has {len(self.colliders)} colliders")
        if isinstance(colliders, Collider) or len(colliders) != len(env):
            raise ValueError(f"colliders={colliders!r}: give a sequence of {len(env)}, one for each environment")
        for collider in colliders:
            if collider.kind != self._kinds[index]:
                here, there = type(self.colliders[index]).__name__, type(collider).__name__
                raise ValueError(f"collider {index} is a {here}: a {there} cannot take its place")
        block, lane = self.layout.place(env)
        self._colliders[block, index, :, lane] = self._collider_homes[block, index, :, lane] = np.array(
            [c.rows() for c in colliders]
        )

    # --- state ----------------------------------------------------------------------------------------------------------

    def get_state(self) -> State:
        """All that is needed to go on bit for bit, as fresh copies."""
        public = self.layout.to_public
        return State(
            positions=self.positions,
            velocities=self.velocities,
            free_inverse_mass=public(self._free_w),
            anchors=np.repeat(self.anchors[None], self.num_envs, axis=0),
            attached=public(self._attached),
            anchor_targets=public(self._targets),
            **{name: public(value) for name, value in self._fabric._asdict().items()},
            parameters=self._parameters.copy(),
            colliders=public(self._colliders),
            collider_homes=public(self._collider_homes),
            steps=self._steps.copy(),
        )

    def set_state(self, state: State) -> None:
        """Go on from a state of a simulation with the same mesh, anchors, colliders and number of environments.

        Raises:
            ValueError: the state does not fit; nothing is changed then.
        """
        if state.positions.shape != (self.num_envs, self.mesh.num_particles, 3):
            raise ValueError(
                f"the state holds positions of shape {state.positions.shape}, this simulation (num_envs, particles, 3) = "
                f"{(self.num_envs, self.mesh.num_particles, 3)}"
            )
        if not np.array_equal(state.anchors, np.broadcast_to(self.anchors, (self.num_envs, self.anchors.size))):
            raise ValueError(f"the state has anchors {state.anchors[0].tolist()}, this simulation {self.anchors.tolist()}")
        if state.colliders.shape[1] != len(self.colliders):
            raise ValueError(f"the state has {state.colliders.shape[1]} colliders, this simulation {len(self.colliders)}")
        blocks, dtype = self.layout.to_blocks, self.dtype
        self._x = blocks(state.positions, dtype)
        self._v = blocks(state.velocities, dtype)
        self._free_w = blocks(state.free_inverse_mass, dtype)
        self._attached = blocks(state.attached, np.dtype(bool))
        self._targets = blocks(state.anchor_targets, dtype)
        self._fabric = Fabric(*(blocks(getattr(state, name), dtype) for name in Fabric._fields))
        self._parameters = np.array(state.parameters, np.float64)
        self._colliders = blocks(state.colliders, dtype)
        self._collider_homes = blocks(state.collider_homes, dtype)
        self._steps = np.array(state.steps, np.int64)
        self._w = self._free_w.copy()
        self._apply_masses()

    # --- from descriptions to rows --------------------------------------------------------------------------------------

    def _spring_constants(self, parameters: NDArray) -> NDArray:
        """Spring constants of environments, (envs, kinds), from their material figures, (envs, figures)."""
        _, stretch, shear, bend, _, _ = parameters.T
        return spring_stiffness(self.mesh, stretch, shear, bend).T

    def _apply_parameters(self, env: NDArray) -> None:
        """Write spring constants, dampers, drag and masses of environments from their material figures."""
        block, lane = self.layout.place(env)
        density, _, _, _, damping_time, air_drag = self._parameters[env].T
        self._fabric.stiffness[block, :, lane] = self._spring_constants(self._parameters[env])
        self._fabric.damping_time[block, lane] = damping_time
        self._fabric.drag_rate[block, lane] = air_drag / density
        self._free_w[block, :, lane] = self._w[block, :, lane] = 1 / (density[:, None] * self.mesh.area)
        self._apply_masses()

    def _apply_masses(self) -> None:
        """A held particle has no inverse mass: nothing but its anchor moves it."""
        self._w[:, self.anchors] = np.where(self._attached, 0, self._free_w[:, self.anchors])

    def _env_indices(self, envs: ArrayLike | None) -> NDArray:
        if envs is None:
            return np.arange(self.num_envs)
        index = np.atleast_1d(np.asarray(envs))
        if index.dtype == bool:
            if index.shape != (self.num_envs,):
                raise ValueError(f"a mask of environments must have shape {(self.num_envs,)}, not {index.shape}")
            return np.flatnonzero(index)
        return indices("envs", envs, self.num_envs, "this batch's environments")

    def _checked(self, name: str, value: ArrayLike, shape: tuple[int, ...]) -> NDArray:
        array = finite(name, value)
        if array.shape != (self.num_envs, *shape):
            raise ValueError(f"{name} has shape {array.shape}: must be {(self.num_envs, *shape)}")
        return array
