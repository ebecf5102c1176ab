"""The strain task worked out in float64, from positions and the manual page alone: what its tests compare with."""

import gymnasium as gym
import numpy as np

from clothgym import grid

STRAIN = "clothgym:ClothStrain-v0"
STEPS, STEP, SPEED = 150, 1 / 30, 1.0
SIDE, ROWS = 0.3, 13
CELL = SIDE / (ROWS - 1)
# the knit of the manual page: 178.2 g/m2, Young's and the shear modulus times thickness [N/m], rigidity [N m], damping [s]
DENSITY, YOUNG, SHEAR, RIGIDITY, DAMPING = 0.1782, 24.93, 11.64, 2.25e-7, 1e-3
RHO, CD, CF, G = 1.2, 1.2, 0.02, 9.81
WEIGHT = DENSITY * SIDE**2 * G
INDEX = np.arange(ROWS * ROWS).reshape(ROWS, ROWS)
LEFT, RIGHT = INDEX[-1, 0], INDEX[-1, -1]
CLIPS = (INDEX[-2:, :3].ravel(), INDEX[-2:, -3:].ravel())
WIDTH = np.where((np.arange(ROWS) % (ROWS - 1)) == 0, 0.5, 1.0)  # of the strip that a row stands for, in cells
APART = np.array([0, 1, 0, 0, -1, 0.0])


def start(seed=3, options=None, **kwargs):
    env = gym.make(STRAIN, **kwargs).unwrapped
    observation, _ = env.reset(seed=seed, options=options)
    return env, observation


def batch(num_envs, seed=0, **kwargs):
    env = gym.make_vec(STRAIN, num_envs=num_envs, autoreset_mode="Disabled", **kwargs)
    env.reset(seed=seed)
    return env


def positions(env):
    return env.unwrapped.task.simulation.positions.astype(float)


def strains(x):
    """Of the threads between neighbors, in float64 from positions alone, (..., threads)."""
    x = x.reshape(*x.shape[:-2], ROWS, ROWS, 3)
    across, down = (np.linalg.norm(np.diff(x, axis=axis), axis=-1) / CELL - 1 for axis in (-2, -3))
    return np.concatenate([across.reshape(*x.shape[:-3], -1), down.reshape(*x.shape[:-3], -1)], axis=-1)


def p95(values):
    """The least value, at least 0, that at most 5 % of the others exceed."""
    ordered = np.sort(values)
    allowed = int(0.05 * len(values))
    assert np.sum(values > ordered[-1 - allowed]) <= 0.05 * len(values) < np.sum(values > ordered[-2 - allowed])
    return max(ordered[-1 - allowed], 0.0)


def to_places(env, waypoint):
    """Distance of each clip's corner from its place [m]."""
    places = env.unwrapped.task.episode["places"][0, waypoint]
    return np.linalg.norm(places - positions(env)[0, [LEFT, RIGHT]], axis=1)


def potential(env, way):
    """Share of the way that lies behind the clips, as the manual page has it."""
    episode = env.unwrapped.task.episode
    following, places = int(episode["next"][0]), episode["places"][0]
    left = to_places(env, following).mean()
    left += sum(np.linalg.norm(places[k + 1] - places[k], axis=1).mean() for k in range(following, 2))
    return float(np.clip(1 - left / way, 0, 1))


def whole_way(env):
    """Of the clips from where they are, by all waypoints [m]."""
    points = np.concatenate([positions(env)[0, [LEFT, RIGHT]][None], env.unwrapped.task.episode["places"][0]])
    return np.linalg.norm(np.diff(points, axis=0), axis=2).mean(axis=1).sum()


def careless(env):
    return env.unwrapped.task.careless_actions()


def springs():
    """Ends, rest lengths and constants of all springs, family by family, from the moduli."""
    k_bend = 64 * RIGIDITY / CELL**2
    c11 = (YOUNG + np.sqrt(YOUNG**2 + 4 * SHEAR**2)) / 2
    k_thread = c11 - SHEAR - 4 * k_bend
    ones = np.ones((ROWS, ROWS))
    families = [
        (INDEX[:, :-1], INDEX[:, 1:], CELL, k_thread * WIDTH[:, None] * ones[:, 1:]),
        (INDEX[:-1], INDEX[1:], CELL, k_thread * WIDTH * ones[1:]),
        (INDEX[:-1, :-1], INDEX[1:, 1:], CELL * np.sqrt(2), SHEAR * ones[1:, 1:]),
        (INDEX[:-1, 1:], INDEX[1:, :-1], CELL * np.sqrt(2), SHEAR * ones[1:, 1:]),
        (INDEX[:, :-2], INDEX[:, 2:], 2 * CELL, k_bend * WIDTH[:, None] * ones[:, 2:]),
        (INDEX[:-2], INDEX[2:], 2 * CELL, k_bend * WIDTH * ones[2:]),
    ]
    return [np.concatenate([np.broadcast_to(f[c], f[0].shape).ravel() for f in families]) for c in range(4)]


def forces(x, v, wind):
    """Of springs, weight and air on each particle [N], in float64."""
    f = np.zeros_like(x)
    i, j, rest, k = springs()
    d, u = x[j] - x[i], v[j] - v[i]
    length = np.linalg.norm(d, axis=1)
    pull = (k * (length - rest + DAMPING * np.sum(u * d, axis=1) / length) / length)[:, None] * d
    np.add.at(f, i, pull)
    np.add.at(f, j, -pull)
    area = CELL**2 * np.outer(WIDTH, WIDTH).ravel()
    f[:, 2] -= DENSITY * area * G
    triangles = grid(ROWS, ROWS, SIDE, SIDE).triangles
    share = (area / np.bincount(triangles.ravel()))[triangles]
    share /= share.sum(axis=1, keepdims=True)
    for t, s in zip(triangles, share):
        doubled = np.cross(x[t[1]] - x[t[0]], x[t[2]] - x[t[0]])
        size, n = np.linalg.norm(doubled) / 2, doubled / np.linalg.norm(doubled)
        air = wind - s @ v[t]
        across = (air @ n) * n
        f[t] += np.outer(s, RHO / 2 * size * np.linalg.norm(air) * (CD * across + CF * (air - across)))
    return f


def clip_forces(env):
    """Sum over each clip's particles [N], (2, 3)."""
    state = env.task.get_state().simulation
    f = forces(*(getattr(state, name)[0].astype(float) for name in ("positions", "velocities", "wind")))
    return np.array([f[clip].sum(axis=0) for clip in CLIPS])


def play(policy, num_envs=20, seed=100):
    """What the last step of each episode says, and its length, as arrays."""
    env = batch(num_envs, seed)
    last, over, steps = {}, np.zeros(num_envs, bool), np.zeros(num_envs, int)
    while not over.all():
        *_, terminated, _, info = env.step(policy(env))
        last = {k: np.where(terminated, v, last.get(k, v)) for k, v in info.items() if isinstance(v, np.ndarray)}
        steps += ~over
        over |= terminated
    return last | {"steps": steps}
