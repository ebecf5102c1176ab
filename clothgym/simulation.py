"""Floor 5: a batch of sheets, each in a world of its own: the door through which people reach the main loop (``main_loop``)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clothgym import _jit, ahead, checks, guards, integrators
from clothgym.attachments import Attachments, Gripper, Grippers
from clothgym.checks import (
    check_memory,
    count,
    finite,
    indices,
    members,
    not_negative,
    number,
    one_of,
    positive,
    sheets,
    shown,
    spread,
    vector,
)
from clothgym.collisions import Collider, Contacts, SelfCollision, SelfContacts, Solids
from clothgym.collisions.self.owner import options_of
from clothgym.collisions.solids.sheet_contact import needed
from clothgym.elements import digest_of, element_arrays, is_regular, surface_arrays, topology_of
from clothgym.exclusive import CallGuard, exclusive
from clothgym.forces import Energy, Oscillators, energy, structural_strain
from clothgym.geometry.intersections import count_intersections
from clothgym.integrators import Integrator
from clothgym.integrators.base import Preparation
from clothgym.layout import Layout
from clothgym.limiting import Limiting, checked_limit
from clothgym.main_loop import MainLoop, Motion, Outcome, Schedule, compiled
from clothgym.material import Material
from clothgym.mesh import ClothMesh
from clothgym.parameters import AIR_DENSITY, changed, check_properties, checked_size, fabric_rows, inverse_masses, of_material
from clothgym.state import Fabric, Orders, State, View, at_rest, check_fits

GRAVITY = 9.81
SURFACE_INTERVAL = 3e-3  # longest interval between searches for contacts of triangles with solids [s]
AIR_INTERVAL = 2e-3  # shortest interval between updates of the air's force, which is slow compared with the springs' [s]


class Simulation:
    """A batch of sheets of one mesh, each in a world of its own.

    Args:
        mesh: the sheet, for instance ``grid(17, 17, 0.6, 0.6)``; it starts at its rest positions, at rest.
        material: the fabric; ``set_parameters`` changes it by environment.
        num_envs: environments in the batch.
        integrator: a name of ``INTEGRATORS``, one with options, ``{"name": "xpbd", "iterations": 4}``, or an ``Integrator``.
        time_step: control step [s].
        substeps: substeps of a control step; "auto" takes them from the integrator's bound for this mesh and material.
        gravity: [m/s^2], (3,).
        wind: velocity of the air [m/s], (3,); ``set_wind`` changes it.
        air_density: [kg/m^3]; 0 takes drag and lift away.
        colliders: solids, the same for all environments until ``set_collider``.
        anchors: particles that can be held, or patches of them, the first of which is where the anchor is; attached at first.
        anchor_speed: largest speed of an anchor [m/s].
        grippers: what can pick up the cloth; open and at home at first.  ``simulation.grippers`` moves them.
        bending: what resists it: "springs" (no rigidity in the flat state), "hinge" or "quadratic", see ``bending``.  One fabric
            drapes to about 60 % with the first, 25 % with the others.  "auto": springs, or hinges if it is not flat at rest.
        contact: "sheet": solids touch the whole sheet; or "particles": they touch particles only.
        self_collision: False, "fast" or "strict", or a dict with mode, thickness [m] and friction, see ``collisions``.
        strain_limit: largest strain of yarns and diagonals, see ``limiting``; None for none.
        on_divergence: "warn" or "raise" when an environment diverges, or "ignore"; ``diverged`` tells which.
        dtype: "float32", or "float64" for reference runs.
        size: factor on all lengths of the mesh at rest; ``set_parameters`` changes it by environment.
        threads: threads to use; all processors by default.  The outcome does not depend on it.

    Raises:
        ValueError: a value that makes no sense; the message names it and what would do.
    """

    def __init__(
        self,
        mesh: ClothMesh,
        material: Material | None = None,
        num_envs: int = 1,
        integrator: str | Mapping[str, Any] | Integrator = "semi_implicit_euler",
        time_step: float = 1 / 60,
        substeps: int | Literal["auto"] = "auto",
        gravity: ArrayLike = (0.0, 0.0, -GRAVITY),
        wind: ArrayLike = (0.0, 0.0, 0.0),
        air_density: float = AIR_DENSITY,
        colliders: Sequence[Collider] = (),
        anchors: Sequence[int | Sequence[int]] = (),
        anchor_speed: float = 10.0,
        grippers: Sequence[Gripper] = (),
        bending: str = "auto",
        contact: str = "sheet",
        self_collision: bool | str | Mapping[str, Any] = False,
        strain_limit: float | None = None,
        on_divergence: Literal["warn", "raise", "ignore"] = "warn",
        dtype: str = "float32",
        size: float = 1.0,
        threads: int | None = None,
    ) -> None:
        # what was asked for, checked before anything is made
        if not isinstance(mesh, ClothMesh):
            raise ValueError(f"mesh={shown(mesh)}: must be a ClothMesh, for instance clothgym.grid(17, 17, 0.6, 0.6)")
        if not isinstance(material, Material | None):
            raise ValueError(f"material={shown(material)}: must be a Material, for instance Material.preset('cotton')")
        members("colliders", colliders, Collider, "Plane, Sphere, Capsule, Box or MeshCollider")
        members("grippers", grippers, Gripper, "Gripper")
        self.num_envs = count("num_envs", num_envs)
        check_memory(f"num_envs={num_envs}", self.num_envs * mesh.num_particles)
        self.turn = CallGuard("simulation")
        one_of("dtype", dtype, "float32", "float64")
        one_of("on_divergence", on_divergence, "warn", "raise", "ignore")
        one_of("contact", contact, "sheet", "particles")
        self.contact = contact
        self.threads = count("threads", threads) if threads is not None else _jit.default_threads()
        self.strain_limit = checked_limit(strain_limit)
        self.on_divergence = on_divergence
        self.bending = guards.bending_of(bending, mesh)
        self.mesh = mesh
        self.material = material if material is not None else Material.preset("penava_cotton")
        self.integrator = integrators.get(integrator)
        self.time_step = positive("time_step", time_step)
        self.air_density = not_negative("air_density", air_density)
        self.dtype = np.dtype(dtype)
        scale = float(checked_size(np.array([number("size", size)]))[0])
        guards.refuse_sizes(self.integrator, np.array(scale))
        # how the batch lies in memory
        self.layout = Layout.choose(self.num_envs, self.threads, self.integrator.any_order, is_regular(mesh))
        # what holds the sheet
        if not isinstance(anchors, Sequence | np.ndarray) or (isinstance(anchors, np.ndarray) and not anchors.ndim):
            raise ValueError(f"anchors={shown(anchors)}: must be a sequence of particles, or of patches of them; () for none")
        patches = [indices("anchors", patch, mesh.num_particles, "particles of this mesh") for patch in anchors]
        self._attachments = Attachments(
            self.layout, patches, positive("anchor_speed", anchor_speed), grippers, self.time_step, self.dtype
        )
        self.anchors = self._attachments.anchors
        self.grippers = Grippers(self._attachments)
        # contact: with solids, and self-collision
        self._solids = Solids(self.layout, colliders, self.time_step, self.dtype)
        self.colliders = self._solids.colliders
        self._compile(options_of(self_collision) is not None)
        self._contact = SelfCollision(self.layout, mesh, self_collision, self.dtype)
        # what its forces go over, and in float64 for the bounds of substeps
        self._elements = element_arrays(mesh, self.dtype, self.bending.hinged, self.integrator.any_order)
        self._exact_elements = element_arrays(mesh, np.dtype(np.float64), self.bending.hinged, any_order=False)
        own = f"{self._contact.options} {self._contact.thickness}"
        self._surface, self._sheet = surface_arrays(mesh, self.dtype), digest_of(mesh, self.bending.hinged, own)
        self._topology = topology_of(mesh, self._elements, self._surface, self.bending.name, self.layout.kind == "grid")
        # a state at rest, with masses and stiffness of the material
        self._parameters: NDArray
        self._plan: tuple[NDArray, ...] = ()
        self._planned_substeps = 0
        self._go_on(
            at_rest(
                mesh,
                self.num_envs,
                anchors=self._attachments.members,
                attachments=self._attachments.count,
                parameters=of_material(self.material),
                size=scale,
                gravity=vector("gravity", gravity),
                wind=vector("wind", wind),
                colliders=self._solids.described(),
                contact=self._contact.blank(),
                sheet=self._sheet,
            )
        )
        self._apply_parameters(np.arange(self.num_envs))
        self.reset()
        # how many substeps
        if isinstance(substeps, str) and substeps == "auto":
            self.substeps = guards.automatic_substeps(self.integrator, self._oscillators(0), self.time_step)
            return
        self.substeps = count("substeps", substeps, "'auto' or ", most=guards.MOST_SUBSTEPS)
        self._warn_if_beyond_bound(np.arange(1))

    def _compile(self, collides: bool) -> None:
        """Compose the main loop from the kernels of the present options; collides: whether the sheet collides with itself."""
        touched, method, dtype = needed(self.contact, self._solids.shapes.kinds), self.integrator, self.dtype.name
        parts = self.bending, self.layout.kind, self.strain_limit is not None, collides, touched
        self._advance = MainLoop(*compiled(method.substep, method.name, *parts))
        # on a cold start another process compiles everything except self-contact, which takes about as long
        if collides and method == integrators.INTEGRATORS.get(method.name) and not _jit.is_kept(self._advance.kernel):
            kinds = self._solids.shapes.kinds
            ahead.start(
                {
                    "grid": bool(is_regular(self.mesh)), "integrator": method.name, "bending": self.bending.name, "dtype": dtype,
                    "contact": self.contact, "strain_limit": self.strain_limit, "anchors": len(self.anchors) > 0,
                    "grippers": len(self.grippers) > 0, "solids": bool(kinds.any()) if len(kinds) else None,
                }
            )  # fmt: skip

    def __getstate__(self) -> dict[str, Any]:
        """What a copy or a pickle holds: all but compiled code and its scratch."""
        return {name: value for name, value in vars(self).items() if name != "_advance"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._compile(self._contact.options is not None)

    # --- time -----------------------------------------------------------------------------------------------------------

    @exclusive
    def step(self, n: int = 1, envs: ArrayLike | None = None) -> None:
        """Advance all environments, or those that are named, by ``n`` control steps; attachments move at a bounded speed.

        Raises:
            RuntimeError: a step was interrupted, and not all environments have been reset since; or another thread is in a call.
            ValueError: environments that share their memory with others, see ``layout.Layout``, cannot be advanced alone.
        """
        count("n", n)
        self.turn.check_consistent()
        chosen = None if envs is None else self.layout.alone(envs, self.integrator.name)
        self._prepare()
        schedule, solids = self._schedule, self._solids.solid
        sheet, lag = self._contact.sheet_with(solids), self._contact.lag
        motion, outcome = Motion(self._x, self._v, self._w, self._remainders), Outcome(self._limited, self._diverged)

        def work(first: int, last: int) -> None:
            blocks = slice(first, last)
            held = self._attachments.holder[blocks].copy() if len(self.grippers) else None
            if self._contact.strict:
                memory = self._contact.sheet.memory
                self._attachments.take_up_lag(first, last, memory.lag, memory.behind, self._w, self._free_w)
            self._attachments.steer(first, last, self._x, self._v, self._w, self._free_w, self._solids, lag)
            if held is not None:
                self._contact.let_go(held, self._attachments.holder[blocks], blocks)
            self._advance(first, last, motion, self._topology, self._fabric, solids, sheet, schedule, outcome)

        def work_on(first: int, last: int) -> None:
            for span in [(first, last)] if chosen is None else [(block, block + 1) for block in chosen[first:last]]:
                work(*span)

        stepped: Any = slice(None) if chosen is None else chosen
        for _ in range(n):
            self.turn.unfinished = range(self.num_envs) if chosen is None else chosen
            _jit.run_spans(work_on, self.layout.blocks if chosen is None else len(chosen), self.threads)
            self._solids.end_step(stepped)
            if self._attachments.can_slip:
                held = self._attachments.holder.copy()
                self._attachments.slip(self._pulls(chosen), chosen, self._w, self._free_w)
                self._contact.let_go(held, self._attachments.holder)
            self._steps[stepped] += 1
            self.turn.unfinished = ()
            self._contact.warn(self._steps)
            if self.on_divergence != "ignore" and self._diverged.any():
                new = self.diverged & ~self._reported
                self._reported |= new
                guards.report_divergence(new, self._steps, self.integrator, self.substeps, self.on_divergence == "raise")

    def _prepare(self) -> None:
        """Renew the integrator's plan and the main loop's schedule where properties or substeps have changed."""
        if self._planned_substeps == self.substeps:
            return
        self._planned_substeps = self.substeps
        method, h = self.integrator, self.time_step / self.substeps
        if method.prepare is not None:
            holdable = np.arange(self.mesh.num_particles) if len(self.grippers) else self._attachments.members
            plan = method.prepare(Preparation(self._oscillators(0), h, holdable, self.layout.kind == "grid"))
            self._plan = tuple(part.astype(self.dtype) if part.dtype.kind == "f" else part.astype(np.int64) for part in plan)
        # a share of a substep more, or rounding would make three of them two
        look_every, air_every = (
            int(min(max(1, interval / h + 1e-3), checks.MOST)) for interval in (SURFACE_INTERVAL, AIR_INTERVAL)
        )
        self._schedule = Schedule(
            h=self.dtype.type(h),
            lead=self.dtype.type(h * method.lead),
            substeps=self.substeps,
            air_every=air_every if self._fabric.resistance[:, :2].any() else 0,
            look_every=look_every,
            options=tuple(method.options.values()),
            plan=self._plan,
            work_shape=method.work_shape(len(self._elements.springs.weight), len(self._elements.bends.weight)),
            limit=float(self.strain_limit or 0),
        )

    def _warn_if_beyond_bound(self, envs: NDArray) -> None:
        guards.warn_if_beyond(self.integrator, map(self._oscillators, envs.tolist()), self.time_step, self.substeps)

    # --- what can be done -----------------------------------------------------------------------------------------------

    @exclusive
    def move_anchors(self, targets: ArrayLike) -> None:
        """Where the anchors are to be at the end of the next step [m], (num_envs, anchors, 3), as far as their speed allows."""
        shape = (self.num_envs, self.anchors.size, 3)
        self._attachments.move(slice(0, self.anchors.size), spread("targets", finite("targets", targets), shape))

    @exclusive
    def release(self, envs: ArrayLike | None = None, anchors: ArrayLike | None = None) -> None:
        """Let go: pairs of environment and anchor (its place in ``anchors``), or all anchors, or all environments."""
        block, lane, which = self._pairs(envs, anchors)
        held = self._attachments.holder.copy()
        self._attachments.let_go(block, which, lane)
        self._contact.let_go(held, self._attachments.holder)
        self._apply_masses(block, lane)

    @exclusive
    def attach(self, envs: ArrayLike | None = None, anchors: ArrayLike | None = None) -> None:
        """Take hold again, where the particle now is; arguments as for ``release``."""
        block, lane, which = self._pairs(envs, anchors)
        self._attachments.hold(block, which, lane, self._x)
        self._apply_masses(block, lane)

    def _pairs(self, envs: ArrayLike | None, anchors: ArrayLike | None) -> tuple[NDArray, NDArray, NDArray]:
        """Block, lane and anchor of each pair."""
        env, count = self.layout.chosen(envs, once=anchors is None), self.anchors.size
        if anchors is None:
            return (*self.layout.at(np.repeat(env, count)), np.tile(np.arange(count), len(env)))
        which = spread("anchors", indices("anchors", anchors, count, "this simulation's anchors"), env.shape)
        return (*self.layout.at(env), which)

    @exclusive
    def set_wind(self, wind: ArrayLike, envs: ArrayLike | None = None) -> None:
        """Velocity of the air from now on [m/s], (len(envs), 3) or (3,)."""
        env = self.layout.chosen(envs)
        block, lane = self.layout.at(env)
        self._fabric.wind[block, :, lane] = spread("wind", finite("wind", wind), (len(env), 3))

    @exclusive
    def reset(self, envs: ArrayLike | None = None, positions: ArrayLike | None = None, velocities: ArrayLike | None = None) -> None:
        """Put environments back: rest positions or those given [m], at rest or as given [m/s], all anchors attached, grippers
        open and at home, solids that have moved where they began.

        positions, velocities: (len(envs), particles, 3), or one sheet for all, (particles, 3).  What cannot be changes nothing.
        """
        self.begin(*self.checked_start(envs, positions, velocities))

    def checked_start(self, envs: Any, positions: Any = None, velocities: Any = None) -> tuple[NDArray, NDArray, NDArray]:
        """What ``reset`` is given, checked, for ``begin``."""
        env = self.layout.chosen(envs)
        shape = (len(env), self.mesh.num_particles, 3)
        rest = self.size[env, None, None] * self.mesh.rest_positions
        x = rest if positions is None else sheets("positions", positions, shape)
        v = np.zeros(3) if velocities is None else sheets("velocities", velocities, shape, (3,))
        guards.warn_if_far(x, self.mesh, self.dtype)
        if positions is not None:
            self._contact.check(x, env)
        return env, np.broadcast_to(x, shape), np.broadcast_to(v, shape)

    @exclusive
    def begin(self, env: NDArray, x: NDArray, v: NDArray) -> None:
        """Put environments back, see ``reset``, to what ``checked_start`` has returned."""
        self.turn.begin(env.tolist())
        block, lane = self.layout.at(env)
        self._x[block, :, :, lane], self._v[block, :, :, lane] = np.swapaxes(x, 1, 2), np.swapaxes(v, 1, 2)
        self._remainders[block, ..., lane] = 0
        self._solids.begin(block, lane)
        self._attachments.begin(block, lane, x)
        self._steps[env] = 0
        self._diverged[block, lane], self._limited[block, :, lane] = False, 0
        self._reported[env] = False
        self._apply_masses(block, lane)
        self._contact.begin(block, lane, self._x)
        self.turn.finish(env.tolist())

    @exclusive
    def set_parameters(self, envs: ArrayLike | None = None, warn: bool = True, **properties: ArrayLike) -> None:
        """Change material properties (see ``Material``), ``size``, ``gravity`` or ``wind`` of some environments, by value or array.

        The size is a factor on all lengths of the mesh at rest, from 0.8 to 1.25; positions stay as they are until a reset.

        With ``warn``, properties that need more substeps than there are warn with the number that would do.

        Raises:
            ValueError: an unknown name, or a value that ``Material`` would not take; nothing is changed then.
        """
        env, warn = self.layout.chosen(envs), checks.flag("warn", warn)
        block, lane = self.layout.at(env)
        after = self._parameters.copy()
        after[env], fields = changed(self.material, after[env], properties)
        size = fields.pop("size", self.size[env])
        self._rows(after[env], size)
        guards.refuse_properties(self.integrator, self.mesh, self._parameters, after)
        guards.refuse_sizes(self.integrator, size)
        self._parameters, self._fabric.size[block, lane] = after, size
        for name, value in fields.items():
            getattr(self._fabric, name)[block, :, lane] = value
        if len(fields) < len(properties):
            self._apply_parameters(env)
            if warn:
                _, first = np.unique(np.column_stack([after[env], size]), axis=0, return_index=True)
                self._warn_if_beyond_bound(env[first])

    @exclusive
    def set_collider(self, index: int, colliders: Sequence[Collider], envs: ArrayLike | None = None) -> None:
        """Put other solids of the same family (a plane, the same mesh, or any other) in place of collider ``index``, one an
        environment."""
        self._solids.replace(index, colliders, *self.layout.at(self.layout.chosen(envs)))

    @exclusive
    def move_colliders(
        self, index: int, targets: ArrayLike | None = None, velocities: ArrayLike | None = None, envs: ArrayLike | None = None
    ) -> None:
        """Move collider ``index``; it drags the cloth.

        With ``targets``, where its center, or a plane's point, is to be at the end of the next step [m], (len(envs), 3): it goes
        there evenly, and then on with ``velocities``, or rests.  With ``velocities`` alone, from now on [m/s], (len(envs), 3).

        Raises:
            ValueError: no such collider, neither of both, a wrong shape, or a value that is not finite; nothing is changed then.
        """
        self._solids.move(index, targets, velocities, self.layout.chosen(envs))

    # --- state ----------------------------------------------------------------------------------------------------------

    @exclusive
    def get_state(self) -> State:
        """All that is needed to go on bit for bit, as fresh copies; refused while a step is unfinished, as ``step`` is."""
        self.turn.check_consistent()
        return self._state()

    def _state(self) -> State:
        """The same, whether whole or not."""
        public = self.layout.to_public
        return State(
            positions=self.positions,
            velocities=self.velocities,
            remainders=public(self._remainders),
            free_inverse_mass=public(self._free_w),
            **self._attachments.public(),
            **{name: public(value) for name, value in self._fabric._asdict().items()},
            parameters=self._parameters.copy(),
            **self._solids.public(),
            self_contact=self._contact.public(),
            steps=self._steps.copy(),
            diverged=self.diverged,
            sheet=self._sheet,
        )

    @exclusive
    def set_state(self, state: State) -> None:
        """Go on from a state of a simulation with the same mesh, anchors, colliders and number of environments.

        Raises:
            ValueError: the state does not fit; nothing is changed then.
        """
        check_fits(state, self._state())
        check_properties(self.material, state.parameters)
        self._rows(state.parameters, state.size)
        guards.refuse_properties(self.integrator, self.mesh, state.parameters, state.parameters)
        guards.refuse_sizes(self.integrator, state.size)
        self._attachments.check(state)
        self._solids.check(state)
        self._contact.check_memory(state)
        sound = np.flatnonzero(~state.diverged)
        self._contact.check_apart(state.positions[sound], sound)
        self._go_on(state)

    def _go_on(self, state: State) -> None:
        """Take over what a state holds."""
        self.turn.unfinished = range(self.num_envs)
        blocks, dtype = self.layout.to_blocks, self.dtype
        self._x = self.layout.vectors_to_blocks(state.positions, dtype)
        self._v = self.layout.vectors_to_blocks(state.velocities, dtype)
        self._remainders, self._free_w = blocks(state.remainders, dtype), blocks(state.free_inverse_mass, dtype)
        self._attachments.restore(state)
        self._solids.restore(state)
        self._fabric = Fabric(*(blocks(getattr(state, name), dtype) for name in Fabric._fields))
        self._parameters = np.array(state.parameters, np.float64)
        self._steps = np.array(state.steps, np.int64)
        self._w = self._free_w.copy()
        self._planned_substeps = 0
        self._limited = np.zeros((self.layout.blocks, 3, self.layout.lanes), dtype)
        self._diverged = blocks(state.diverged, np.dtype(bool))
        self._reported = self.diverged
        self._apply_masses(*self.layout.at(np.arange(self.num_envs)))
        self._contact.restore(state, self._x)
        self.turn.unfinished = ()

    def _rows(self, parameters: NDArray, size: NDArray) -> dict[str, NDArray]:
        """``fabric_rows`` on this mesh."""
        return fabric_rows(self.mesh, parameters, size, self.bending.hinged, self.bending.isotropic, self.air_density)

    def _apply_parameters(self, env: NDArray) -> None:
        """Write spring constants, dampers, drag and masses of environments from their material properties."""
        (block, lane), self._planned_substeps = self.layout.at(env), 0
        size = self.size[env].astype(np.float64)
        for name, rows in self._rows(self._parameters[env], size).items():
            array = getattr(self._fabric, name)
            array[(block, slice(None), lane) if rows.ndim == 2 else (block, lane)] = rows
        self._free_w[block, :, lane] = inverse_masses(self.mesh, self._parameters[env], size)
        self._apply_masses(block, lane)

    def _apply_masses(self, block: NDArray, lane: NDArray) -> None:
        """A held particle has no inverse mass: nothing but its attachment moves it."""
        self._w[block, :, lane] = np.where(self._attachments.holder[block, :, lane] >= 0, 0, self._free_w[block, :, lane])

    # --- what can be read: fresh copies, but for the view and the orders -----------------------------------------------

    @property
    def positions(self) -> NDArray:
        """Positions of the particles [m], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._x)

    @property
    def velocities(self) -> NDArray:
        """Velocities of the particles [m/s], (num_envs, particles, 3); a fresh copy."""
        return self.layout.vectors_to_public(self._v)

    @property
    def view(self) -> View:
        """Positions, velocities, springs and attachments in the memory of the kernels.  It is not a copy, and is read only."""
        attachments = self._attachments
        held = attachments.x, attachments.opening, attachments.blocked, attachments.holder
        return View(self._x, self._v, self._fabric.size, self._elements.springs, *held)

    @property
    def orders(self) -> Orders:
        """Targets of attachments and fingers, and the wind, in the memory of the kernels.

        ``move_anchors``, ``grippers.move`` and ``set_wind`` write to them after checking their arguments.
        """
        return Orders(self._attachments.targets, self._attachments.wanted, self._fabric.wind)

    @property
    def parameters(self) -> NDArray:
        """Material properties in the order of ``parameters.PROPERTIES``, (num_envs, properties); a fresh copy."""
        return self._parameters.copy()

    @property
    def size(self) -> NDArray:
        """Factor on the mesh's lengths at rest, (num_envs,); a fresh copy."""
        return self.layout.to_public(self._fabric.size)

    @property
    def diverged(self) -> NDArray:
        """Whether an environment has diverged since its reset, (num_envs,): a position was not finite, or a speed above 10 km/s."""
        return self.layout.to_public(self._diverged)

    @property
    def limiting(self) -> Limiting | None:
        """The strains that strain limiting met and left in the last control step; None without a ``strain_limit``."""
        return None if self.strain_limit is None else Limiting(*self.layout.to_public(self._limited).T)

    @property
    def attached(self) -> NDArray:
        """Whether each anchor holds its particle, (num_envs, anchors); a fresh copy."""
        return self._attachments.attached()

    @property
    def attachment_positions(self) -> NDArray:
        """Positions of the attachments, anchors and then grippers [m], (num_envs, attachments, 3); a fresh copy."""
        return self.layout.to_public(self._attachments.x)

    @property
    def blocked(self) -> NDArray:
        """Whether solids stopped or deflected an attachment in the last control step, (num_envs, attachments)."""
        return self.layout.to_public(self._attachments.blocked)

    def pulls(self, envs: ArrayLike | None = None) -> NDArray:
        """Force of the cloth on each attachment, anchors and then grippers [N], (len(envs), attachments, 3).

        It is the sum of the forces of springs, bending, weight and air on the particles that it holds, without their inertia.
        """
        if envs is None:
            return self.layout.to_public(self._pulls())
        chosen = self.layout.chosen(envs)
        return self.layout.to_public(self._pulls(self.layout.at(chosen)[0].tolist()))[chosen]

    def _pulls(self, blocks: list[int] | None = None) -> NDArray:
        return self._attachments.pulls(
            self._x, self._v, self._free_w, self._topology, self.bending, self._fabric, self.threads, blocks
        )

    def largest_substep(self, env: int = 0) -> tuple[float, str]:
        """Largest substep [s] that the integrator should be used with in that environment, and why; zero if there is none."""
        return self.integrator.largest_substep(self._oscillators(count("env", env, least=0, most=self.layout.num_envs - 1)))

    def _oscillators(self, env: int) -> Oscillators:
        """What decides on an environment's substep."""
        sheet = self.mesh, self._exact_elements, self.bending
        return guards.oscillators(*sheet, self._fabric, self._free_w, *self.layout.at(env))

    def strain(self) -> NDArray:
        """Length over rest length, minus one, of the structural springs or edges, (num_envs, those springs)."""
        return structural_strain(self.mesh, self.positions, self.size)

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy of each environment [J], (num_envs,) each, in float64."""
        return energy(self._exact_elements, self.bending, self.get_state())

    def contacts(self) -> Contacts:
        """Signed distance of each particle to the nearest collider, which is negative inside."""
        return self._solids.contacts(self._x)

    @property
    def collider_positions(self) -> NDArray:
        """Centers of the colliders, or a plane's point [m], (num_envs, colliders, 3); a fresh copy."""
        return self._solids.positions()

    def penetration(self) -> NDArray:
        """Depth of the sheet's deepest point below the surface of a collider [m], (num_envs,).

        The point may lie anywhere on the triangles.  It is 0 outside all colliders, and NaN where positions are not finite.  The
        thickness that contact keeps is not part of a collider.
        """
        depth = self._solids.penetration(self._x, self._surface)
        return np.where(np.isfinite(self.positions).all(axis=(1, 2)), depth, np.nan)

    @property
    def self_collision(self) -> str | None:
        """How the sheet collides with itself, "fast" or "strict", or None."""
        return None if self._contact.options is None else self._contact.options.mode

    @property
    def self_contacts(self) -> SelfContacts | None:
        """Contacts of each sheet with itself in the last control step; None without ``self_collision``."""
        return self._contact.report()

    def intersections(self) -> NDArray:
        """Number of pairs of triangles that intersect, (num_envs,); -1 where positions are not finite.

        The count is exact, and shares no code with self-collision.
        """
        x = self.positions
        counts, finite = np.full(len(x), -1), np.isfinite(x).all(axis=(1, 2))
        counts[finite] = count_intersections(self.mesh.triangles, x[finite])
        return counts
