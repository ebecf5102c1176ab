"""A control step of a task without its physics: one kernel before it, ``order``, and one after it, ``conclude``.

Both go through a batch one environment after the other.  What is the task's own in them are small kernels about ONE environment,
``Task.kernels``, with which both are compiled:

    potential(own, rules, sheet) -> float           how far along it is, in [0, 1]; its change is the reward on the way
    judge(own, rules, sheet, info) -> float         at an episode's end: writes the judgement, returns the normalized performance
    observe(own, rules, sheet, seen)                what is observed beside the points of the sheet
    act(own, rules, sheet, move, free)              what an action does beside moving; free: set for anchors that are to let go
    measure(own, rules, sheet)                      what the task measures itself, at an episode's start and after each step
    done(own, rules, sheet) -> bool                 whether the agent is done before its time is up
    account(own, rules, sheet, info, terms, running, failure) -> float    what else info tells; the sum of the task's own terms
    fingers(move, wanted, acting) -> float          how far a gripper's fingers are to open, from 0 to 1

``own``, ``info``, ``terms`` and ``seen`` are the environment's records in ``Task.episode``, ``info``, ``terms`` and ``seen``, with
the fields that the task names; ``rules`` is the task's record of figures that all environments share; ``move``: the action, within
[-1, 1], (hands, numbers).
"""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import inlined, specialize, uncounted
from clothgym.envs.episode import BEYOND, DIVERGED, EFFORT_PRICE, FAILURE_PENALTY, FINE, OUT_OF_BOUNDS, SUCCESS_BONUS, TORN, TWICE
from clothgym.envs.measures import CENTROID, FINITE, STRETCH2, SUMMARY, largest_strain, summarize
from clothgym.mesh import SHEAR, ClothMesh


@inlined
def _nothing(own, rules, sheet):
    """No measurements of the task's own."""


@inlined
def _only_moves(own, rules, sheet, move, free):
    """An action does nothing beside moving."""


@inlined
def _never(own, rules, sheet):
    """An agent is done when its time is up."""
    return False


@inlined
def _no_more(own, rules, sheet, info, terms, running, failure):
    """No more to tell, and no terms of the task's own."""
    return 0.0


@inlined
def _no_fingers(move, wanted, acting):
    """An anchor has none."""
    return wanted


class Kernels(NamedTuple):
    """A task's own part of a step, see the module."""

    potential: Any
    judge: Any
    observe: Any
    act: Any = _only_moves
    measure: Any = _nothing
    done: Any = _never
    account: Any = _no_more
    fingers: Any = _no_fingers


@cache
def compiled(name: str, kernels: Kernels) -> tuple[Any, Any]:
    """``order`` and ``conclude`` with the kernels of the task of that name."""
    # where this folder is linked into the package, its files have no part in the name of the cache's folder
    sources = b"".join(path.read_bytes() for path in sorted(Path(__file__).parent.glob("*.py")))
    name, parts = f"{name}_{hashlib.sha256(sources).hexdigest()[:12]}", kernels._asdict()
    scoring = specialize(score, f"score_{name}", apart=True, **parts)
    one = specialize(conclude_one, f"conclude_one_{name}", apart=True, score=scoring, **parts)
    return specialize(order, f"order_{name}", **parts), specialize(conclude, f"conclude_{name}", conclude_one=one)


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

    x, v: [m], [m/s], (3, particles), contiguous.  holder: which hand holds each particle, or -1, (particles,).
    hands: where they are [m], (hands, 3).  openings: of their fingers, (hands,).  holds: particles that each holds, (hands,).
    pulls: of the sheet at the hands [N], (hands, 3), for tasks that ask for them.  air: the wind of each step [m/s], (steps, 3).
    summary: see ``measures.summarize``.
    """

    x: NDArray
    v: NDArray
    holder: NDArray
    hands: NDArray
    openings: NDArray
    holds: NDArray
    pulls: NDArray
    air: NDArray
    summary: NDArray
    mesh: Mesh


def order(actions, lanes, rules, episode, air, outcome, targets, wanted, wind):
    """Tell hands and air of all environments what the actions of a control step, (num_envs, numbers), want of them.

    targets, wanted, wind: a simulation's, see ``state.Orders``.  Returns the place of an action that is not finite, or -1; then
    nothing has been told to anyone.
    """
    rule = rules[0]
    for e in range(episode.shape[0]):
        for i in range(actions.shape[1]):
            if not np.isfinite(actions[e, i]):
                return e * actions.shape[1] + i
    for e in range(episode.shape[0]):
        b, l = e // lanes, e % lanes
        own, moves = episode[e], outcome[e].moves
        acting = not own.over and own.settling_since < 0
        for k in range(moves.shape[0]):
            move = moves[k]
            for i in range(move.shape[0]):
                move[i] = min(max(actions[e, k * move.shape[0] + i], -1.0), 1.0)
            # the speed limit holds in every direction
            slow = np.sqrt(max(move[0] * move[0] + move[1] * move[1] + move[2] * move[2], 1.0))
            for c in range(3):
                if acting:
                    there = own.targets[k, c] + rule.reach * (move[c] / slow)
                    own.targets[k, c] = min(max(there, rule.low[c]), rule.high[c])
                targets[b, k, c, l] = own.targets[k, c]
            wanted[b, k, l] = fingers(move, wanted[b, k, l], acting)  # noqa: F821
        for c in range(3 if air.shape[1] else 0):
            wind[b, c, l] = air[e, min(own.step, air.shape[1] - 1), c]
    return -1


def conclude(
    first, last, envs, begins, lanes, x, v, holder, hands, openings, pulls, mesh, rules, episode, air, outcome, info, terms,
    seen, more, bound, observation,
):  # fmt: skip
    """What a control step has brought environments ``envs[first:last]``; or what their episodes begin with, if it ``begins``.

    x, v, holder, hands, openings: a simulation's, see ``state.View``.  pulls: (len(envs), hands, 3).  more: ``seen`` as numbers.
    """
    points, summary = np.empty((2, 3, holder.shape[1]), x.dtype), np.empty(SUMMARY, x.dtype)
    holds = np.empty(hands.shape[1], np.int64)
    for i in range(first, last):
        conclude_one(
            envs[i], begins, lanes, x, v, holder, hands, openings, pulls[i], mesh, rules, episode, air, outcome, info, terms, seen,
            more, bound, observation, points, summary, holds,
        )  # fmt: skip


@uncounted
def conclude_one(
    e, begins, lanes, x, v, holder, hands, openings, pulls, mesh, rules, episode, air, outcome, info, terms, seen, more, bound,
    observation, points, summary, holds,
):  # fmt: skip
    """The same for one environment; points, summary, holds: room for its ``Sheet``."""
    b, l = e // lanes, e % lanes
    own, rule = episode[e], rules[0]
    copy_points(x, v, b, l, points)
    count_held(holder[b, :, l], holds)
    summarize(points[0], points[1], mesh.share, mesh.ends, mesh.inverse2, summary)
    held = holder[b, :, l], hands[b, :, :, l], openings[b, :, l], holds
    sheet = Sheet(points[0], points[1], *held, pulls, air[e], summary, mesh)
    if begins:
        own.step, own.settling_since, own.over = 0, -1, False
        for k in range(hands.shape[1]):
            for c in range(3):
                own.targets[k, c] = sheet.hands[k, c]
        measure(own, rule, sheet)  # noqa: F821
        own.potential = potential(own, rule, sheet)  # noqa: F821
        changed = True
    else:
        changed = score(own, rule, sheet, outcome[e], info[e], terms[e])
    if changed:
        observe(own, rule, sheet, seen[e])  # noqa: F821
        show(points, mesh.particles, own.origin, rule.per_side, more[e], bound, observation[e])


@uncounted
def score(own, rule, sheet, out, told, terms):
    """Score a step of one environment; whether it is to be observed anew."""
    running = not own.over
    acting = running and own.settling_since < 0
    own.step += running
    for k in range(out.free.shape[0]):
        out.free[k] = 0
    if acting:
        act(own, rule, sheet, out.moves, out.free)  # noqa: F821
    measure(own, rule, sheet)  # noqa: F821

    failure = failure_of(sheet.summary, rule.low, rule.high) if running else FINE
    if acting and (own.step >= rule.acting_steps or done(own, rule, sheet)):  # noqa: F821
        own.settling_since = own.step
    settled = own.settling_since >= 0 and own.step - own.settling_since >= rule.settling_steps
    judged = running and settled and failure == FINE
    out.failure, out.terminated = failure, judged or failure != FINE
    own.over = own.over or out.terminated

    told.strain_max = told.strain_before_limiting = largest_strain(sheet.summary)
    told.settling = own.settling_since >= 0
    price = account(own, rule, sheet, told, terms, running, failure)  # noqa: F821
    before = own.potential
    if judged:
        told.normalized_performance = own.potential = judge(own, rule, sheet, told)  # noqa: F821
    elif failure != FINE:
        own.potential = 0.0
    elif running:
        own.potential = potential(own, rule, sheet)  # noqa: F821
    if rule.sparse:
        terms.progress, terms.effort, terms.success, terms.failure = told.normalized_performance, 0.0, 0.0, 0.0
    else:
        terms.progress = own.potential - before
        terms.effort = -EFFORT_PRICE * effort_of(out.moves) if acting else 0.0
        terms.success = SUCCESS_BONUS if told.is_success else 0.0
        terms.failure = -FAILURE_PENALTY if failure != FINE else 0.0
    out.reward = terms.progress + terms.effort + terms.success + terms.failure + price
    # those that have diverged go out with what was last seen of them
    return running and failure != DIVERGED


@uncounted
def copy_points(x, v, b, l, points):
    """Positions and velocities of one environment, in its block and lane, to (2, 3, particles)."""
    for p in range(points.shape[2]):
        for c in range(3):
            points[0, c, p], points[1, c, p] = x[b, c, p, l], v[b, c, p, l]


@inlined
def count_held(holder, holds):
    """Particles that each hand holds."""
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
    """Sum of the squares of what the hands are told to do, as velocities."""
    total = 0.0
    for k in range(moves.shape[0]):
        total += moves[k, 0] ** 2 + moves[k, 1] ** 2 + moves[k, 2] ** 2
    return total


@uncounted
def show(points, particles, origin, per_side, more, bound, observation):
    """Points of the sheet relative to the origin, in sides, their velocities [m/s], and more; within the bounds."""
    count = particles.shape[0]
    for k in range(count):
        for c in range(3):
            observation[3 * k + c] = (points[0, c, particles[k]] - origin[c]) * per_side
            observation[3 * (count + k) + c] = points[1, c, particles[k]]
    for i in range(more.shape[0]):
        observation[6 * count + i] = more[i]
    for i in range(bound.shape[0]):
        observation[i] = min(max(observation[i], -bound[i]), bound[i])
