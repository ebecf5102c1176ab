"""A control step of a task without its physics: one kernel before it, ``apply_actions``, and one after it, ``finish_step``.

Both go through a batch one environment after the other.  What is the task's own in them are small kernels about ONE environment,
``Task.kernels``, with which both are compiled; their names are the placeholders below.

``own``, ``info``, ``terms`` and ``seen`` are the environment's records in ``Task.episode``, ``info``, ``terms`` and ``seen``, with
the fields that the task names; ``rules`` is the task's record of numbers that all environments share; ``move``: the action, within
[-1, 1], (attachments, numbers).

A task needs none of them: those of ``IN_NUMPY`` read what its methods have written in NumPy, see ``Task``.
"""

from __future__ import annotations

from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import callees_of, inlined, placeholder, specialize, uncounted
from clothgym.envs.episode import BEYOND, DIVERGED, EFFORT_PRICE, FAILURE_PENALTY, FINE, OUT_OF_BOUNDS, SUCCESS_BONUS, TORN, TWICE
from clothgym.envs.measures import CENTROID, FINITE, STRETCH2, SUMMARY, largest_strain, summarize
from clothgym.mesh import SHEAR, ClothMesh

potential = placeholder("potential", "of (own, rules, sheet): how far along it is, in [0, 1]; its change is the reward on the way")
evaluate = placeholder(
    "evaluate", "of (own, rules, sheet, info), at an episode's end: writes the evaluation, returns the normalized performance"
)
observe = placeholder("observe", "of (own, rules, sheet, seen): writes the observations other than points of the sheet")
act = placeholder("act", "of (own, rules, sheet, move, free): applies actions other than motion; free: set for anchors to release")
measure = placeholder(
    "measure", "of (own, rules, sheet): writes what the task measures itself, at an episode's start and after each step"
)
done = placeholder("done", "of (own, rules, sheet): whether the agent is done before its time is up")
account = placeholder(
    "account",
    "of (own, rules, sheet, info, terms, running, failure), at an episode's start, not running, and after each step: the rest of "
    "info, and the sum of the task's own reward terms",
)
fingers = placeholder("fingers", "of (move, wanted, acting): how far a gripper's fingers are to open, from 0 to 1")


# --- the kernels of a task that gives none ------------------------------------------------------------------------------------


@inlined
def _performance_written(own, rules, sheet):
    """What ``Task.performance`` has returned."""
    return own.performance


@inlined
def _evaluation_written(own, rules, sheet, info):
    """What ``Task.success`` and ``Task.performance`` have returned."""
    info.is_success = own.success
    return own.performance


@inlined
def _observed_already(own, rules, sheet, seen):
    """The functions of ``Task.observations`` have written it."""


@inlined
def _only_moves(own, rules, sheet, move, free):
    """An action only moves attachments."""


@inlined
def _measure_nothing(own, rules, sheet):
    """No measurements of the task's own."""


@inlined
def _never(own, rules, sheet):
    """The agent is done when its time is up."""
    return False


@inlined
def _done_written(own, rules, sheet):
    """What ``Task.done`` has returned."""
    return own.done


@inlined
def _no_more(own, rules, sheet, info, terms, running, failure):
    """Nothing more in info, and no reward terms of the task's own."""
    return 0.0


@inlined
def _no_fingers(move, wanted, acting):
    """An anchor has none."""
    return wanted


class Kernels(NamedTuple):
    """A task's own part of a step, see the module."""

    potential: Any
    evaluate: Any
    observe: Any
    act: Any = _only_moves
    measure: Any = _measure_nothing
    done: Any = _never
    account: Any = _no_more
    fingers: Any = _no_fingers


IN_NUMPY = Kernels(_performance_written, _evaluation_written, _observed_already, done=_done_written)


@cache
def compiled(name: str, kernels: Kernels) -> tuple[Any, Any]:
    """``apply_actions`` and ``finish_step`` with the kernels of the task of that name."""
    parts = kernels._asdict()
    scoring = specialize(score, f"score_{name}", apart=True, **callees_of(score, parts))
    one = specialize(finish_one, f"finish_one_{name}", apart=True, score=scoring, **callees_of(finish_one, parts))
    applying = specialize(apply_actions, f"apply_actions_{name}", **callees_of(apply_actions, parts))
    return applying, specialize(finish_step, f"finish_{name}", finish_one=one)


# --- what the kernels see -----------------------------------------------------------------------------------------------------


class Mesh(NamedTuple):
    """What kernels must know of the sheet as it was made.

    particles: those that are observed.  triangles: (triangles, 3).  share: of the area, by particle.  ends, inverse2: structural
    springs, see ``measures.summarize``.
    """

    particles: NDArray
    triangles: NDArray
    share: NDArray
    ends: NDArray
    inverse2: NDArray


def mesh_arrays(mesh: ClothMesh, particles: NDArray) -> Mesh:
    """A mesh of which these particles are observed."""
    structural = mesh.springs.kind < SHEAR
    rest = mesh.springs.rest_length[structural].astype(np.float32)
    return Mesh(
        particles=np.array(particles, np.int64),
        triangles=np.array(mesh.triangles, np.int64),
        share=(mesh.area / mesh.area.sum()).astype(np.float32),
        ends=mesh.springs.particles[structural].T.astype(np.int64, order="C"),
        inverse2=1 / (rest * rest),
    )


class Sheet(NamedTuple):
    """One environment as a task's kernels see it, wherever it lies in memory.

    x, v: [m], [m/s], (3, particles), contiguous.  size: factor on the mesh's lengths.  unit: positions over the size, as of a sheet
    of the mesh's own lengths [m], (3, particles).  holder: which attachment holds each particle, or -1, (particles,).
    attachments: where the attachments are, anchors first, then grippers [m], (attachments, 3).  openings: of their fingers,
    (attachments,).  holds: particles that each holds, (attachments,).
    pulls: of the sheet at the attachments [N], (attachments, 3), for tasks that ask for them.  air: the wind of each step [m/s],
    (steps, 3).  summary: see ``measures.summarize``.
    """

    x: NDArray
    v: NDArray
    size: float
    unit: NDArray
    holder: NDArray
    attachments: NDArray
    openings: NDArray
    holds: NDArray
    pulls: NDArray
    air: NDArray
    summary: NDArray
    mesh: Mesh


# --- before the physics -------------------------------------------------------------------------------------------------------


def apply_actions(envs, actions, block, lane, rules, episode, air, outcome, targets, wanted, wind):
    """Set where attachments and fingers of environments are to be after a control step, and how the air moves in it.

    envs: those that take the step.  actions: (num_envs, numbers).  block, lane: of each environment, (num_envs,), see
    ``Layout.at``.  targets, wanted, wind: a simulation's, see ``state.Orders``.  Returns the place of an action that is not finite,
    or -1; then nothing has been changed.
    """
    rule = rules[0]
    # one action that is not finite stops the whole batch, before anything is changed
    for e in envs:
        for i in range(actions.shape[1]):
            if not np.isfinite(actions[e, i]):
                return e * actions.shape[1] + i
    for e in envs:
        b, l = block[e], lane[e]
        own, moves = episode[e], outcome[e].moves
        acting = not own.over and own.settling_since < 0
        for k in range(moves.shape[0]):
            # the action of this attachment, within its range
            move = moves[k]
            for i in range(move.shape[0]):
                move[i] = min(max(actions[e, k * move.shape[0] + i], -1.0), 1.0)
            # its target moves on by the velocity, and stays in the arena; the speed limit holds in every direction
            slow = np.sqrt(max(move[0] * move[0] + move[1] * move[1] + move[2] * move[2], 1.0))
            for c in range(3):
                if acting:
                    there = own.targets[k, c] + rule.reach * (move[c] / slow)
                    own.targets[k, c] = min(max(there, rule.low[c]), rule.high[c])
            for c in range(3):
                targets[b, k, c, l] = own.targets[k, c]
            wanted[b, k, l] = fingers(move, wanted[b, k, l], acting)
        # the wind that the episode has drawn for this step; its last one holds on
        for c in range(3 if air.shape[1] else 0):
            wind[b, c, l] = air[e, min(own.step, air.shape[1] - 1), c]
        # from here on this step counts
        own.step += not own.over
    return -1


# --- after the physics --------------------------------------------------------------------------------------------------------


def finish_step(
    first, last, envs, block, lane, begins, x, v, size, holder, attachments, openings, blocked, pulls, mesh, rules, episode, air,
    outcome, info, terms, seen, more, bound, observation,
):  # fmt: skip
    """Score and observe environments ``envs[first:last]`` after a control step; or as their episodes begin, if it ``begins``.

    block, lane: of each of ``envs``, see ``Layout.at``.  x, v, size, holder, attachments, openings, blocked: a simulation's, see
    ``state.View``.
    pulls: (len(envs), attachments, 3).  more: ``seen`` as numbers.
    """
    # room for one environment's ``Sheet``, used for one after the other
    points, summary = np.empty((3, 3, holder.shape[1]), x.dtype), np.empty(SUMMARY, x.dtype)
    holds = np.empty(attachments.shape[1], np.int64)
    for i in range(first, last):
        finish_one(
            envs[i], block[i], lane[i], begins, x, v, size, holder, attachments, openings, blocked, pulls[i], mesh, rules, episode,
            air, outcome, info, terms, seen, more, bound, observation, points, summary, holds,
        )  # fmt: skip


@uncounted
def finish_one(
    e, b, l, begins, x, v, size, holder, attachments, openings, blocked, pulls, mesh, rules, episode, air, outcome, info, terms,
    seen, more, bound, observation, points, summary, holds,
):  # fmt: skip
    """The same for environment ``e`` in block ``b`` and lane ``l``; points, summary, holds: room for its ``Sheet``."""
    own, rule = episode[e], rules[0]
    # the sheet, gathered from wherever it lies in memory, and its summary
    copy_points(x, v, size[b, l], b, l, points)
    count_holds(holder[b, :, l], holds)
    summarize(points[0], points[1], mesh.share, mesh.ends, mesh.inverse2, summary)
    summary[STRETCH2] /= size[b, l] * size[b, l]
    held = holder[b, :, l], attachments[b, :, :, l], openings[b, :, l], holds
    sheet = Sheet(points[0], points[1], size[b, l], points[2], *held, pulls, air[e], summary, mesh)
    # attachments stay where they are as an episode starts, and go on from where a solid has stopped them
    for k in range(attachments.shape[1]):
        if begins or blocked[b, k, l]:
            for c in range(3):
                own.targets[k, c] = sheet.attachments[k, c]
    if begins:
        # the potential has its first value
        measure(own, rule, sheet)
        own.potential = potential(own, rule, sheet)
        # info is of the sheet as it starts
        info[e].strain_max = info[e].strain_before_limiting = largest_strain(sheet.summary)
        account(own, rule, sheet, info[e], terms[e], False, FINE)
        changed = True
    else:
        changed = score(own, rule, sheet, outcome[e], info[e], terms[e])
    # an environment that is over, or has diverged, keeps its last observation
    if changed:
        observe(own, rule, sheet, seen[e])
        write_observation(points, mesh.particles, own.origin, rule.per_side, more[e], bound, observation[e])


@uncounted
def score(own, rule, sheet, out, info, terms):
    """Score one environment's step; returns whether it is to be observed."""
    running = not own.over
    acting = running and own.settling_since < 0
    # actions other than motion, and the task's measurements
    for k in range(out.free.shape[0]):
        out.free[k] = 0
    if acting:
        act(own, rule, sheet, out.moves, out.free)
    measure(own, rule, sheet)

    # where the episode is: failed, at the beginning of its settling, or to be evaluated
    failure = failure_of(sheet.summary, rule.low, rule.high) if running else FINE
    if acting and (own.step >= rule.acting_steps or done(own, rule, sheet)):
        own.settling_since = own.step
    settled = own.settling_since >= 0 and own.step - own.settling_since >= rule.settling_steps
    evaluated = running and settled and failure == FINE
    out.failure, out.terminated = failure, evaluated or failure != FINE
    own.over = own.over or out.terminated

    # info of this step, and the potential after it: the performance at the end, zero at a failure
    info.strain_max = info.strain_before_limiting = largest_strain(sheet.summary)
    info.settling = own.settling_since >= 0
    price = account(own, rule, sheet, info, terms, running, failure)
    before = own.potential
    if evaluated:
        info.normalized_performance = own.potential = evaluate(own, rule, sheet, info)
    elif failure != FINE:
        own.potential = 0.0
    elif running:
        own.potential = potential(own, rule, sheet)

    # the reward and its terms
    if rule.sparse:
        terms.progress, terms.effort, terms.success, terms.failure = info.normalized_performance, 0.0, 0.0, 0.0
    else:
        terms.progress = own.potential - before
        terms.effort = -EFFORT_PRICE * effort_of(out.moves) if acting else 0.0
        terms.success = SUCCESS_BONUS if info.is_success else 0.0
        terms.failure = -FAILURE_PENALTY if failure != FINE else 0.0
    out.reward = terms.progress + terms.effort + terms.success + terms.failure + price
    # those that have diverged go out with what was last seen of them
    return running and failure != DIVERGED


@uncounted
def copy_points(x, v, size, b, l, points):
    """Positions, velocities, and positions over the size, of one environment, in its block and lane, to (3, 3, particles)."""
    for p in range(points.shape[2]):
        for c in range(3):
            points[0, c, p], points[1, c, p], points[2, c, p] = x[b, c, p, l], v[b, c, p, l], x[b, c, p, l] / size


@inlined
def count_holds(holder, holds):
    """Particles that each attachment holds."""
    for k in range(holds.shape[0]):
        holds[k] = 0
    for p in range(holder.shape[0]):
        if holder[p] >= 0:
            holds[holder[p]] += 1


@inlined
def failure_of(summary, low, high):
    """Place in FAILURES of what has gone wrong with a sheet; low, high: the arena's corners [m]."""
    if not summary[FINITE] > 0:
        return DIVERGED
    if summary[STRETCH2] > TWICE * TWICE:
        return TORN
    for c in range(3):
        if summary[CENTROID + c] < low[c] - BEYOND or summary[CENTROID + c] > high[c] + BEYOND:
            return OUT_OF_BOUNDS
    return FINE


@inlined
def effort_of(moves):
    """Sum of the squares of the velocities that the action asks for."""
    total = 0.0
    for k in range(moves.shape[0]):
        total += moves[k, 0] ** 2 + moves[k, 1] ** 2 + moves[k, 2] ** 2
    return total


@uncounted
def write_observation(points, particles, origin, per_side, more, bound, observation):
    """Write an observation: points of the sheet relative to the origin, in sides, their velocities [m/s], and more."""
    # positions and velocities of the observed particles
    count = particles.shape[0]
    for k in range(count):
        for c in range(3):
            observation[3 * k + c] = (points[0, c, particles[k]] - origin[c]) * per_side
            observation[3 * (count + k) + c] = points[1, c, particles[k]]
    # what the task declares
    for i in range(more.shape[0]):
        observation[6 * count + i] = more[i]
    # all within the bounds of the space
    for i in range(bound.shape[0]):
        observation[i] = min(max(observation[i], -bound[i]), bound[i])
