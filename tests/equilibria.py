"""Rest shapes and moduli worked out in float64 by scipy, from the laws alone: what the tests of statics compare with."""

from typing import NamedTuple

import numpy as np
from scipy.integrate import solve_bvp
from scipy.optimize import brentq, minimize

G = 9.81


# --- springs under gravity ------------------------------------------------------------------------------------------------


class Network(NamedTuple):
    """Springs between particles: ends, (springs, 2), rest lengths [m] and constants [N/m], (springs,)."""

    ends: np.ndarray
    rest: np.ndarray
    k: np.ndarray


def sheet_network(rows, spacing, structural, shear, bend):
    """Provot's springs on a square sheet of rows x rows particles, each of the constant of its family [N/m]."""
    index = np.arange(rows * rows).reshape(rows, rows)
    families = [
        (index[:, :-1], index[:, 1:], 1.0, structural),
        (index[:-1], index[1:], 1.0, structural),
        (index[:-1, :-1], index[1:, 1:], np.sqrt(2), shear),
        (index[:-1, 1:], index[1:, :-1], np.sqrt(2), shear),
        (index[:, :-2], index[:, 2:], 2.0, bend),
        (index[:-2], index[2:], 2.0, bend),
    ]
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b, _, _ in families])
    rest = np.concatenate([np.full(a.size, spacing * reach) for a, _, reach, _ in families])
    return Network(ends, rest, np.concatenate([np.full(a.size, k) for a, _, _, k in families]))


def strains(network, x):
    return np.linalg.norm(x[network.ends[:, 1]] - x[network.ends[:, 0]], axis=1) / network.rest - 1


def potential(network, mass, gravity, x):
    """Energy of springs and weight [J], and its gradient [N], (particles, 3)."""
    i, j = network.ends.T
    d = x[j] - x[i]
    length = np.linalg.norm(d, axis=1)
    stretch = length - network.rest
    pull = (network.k * stretch / length)[:, None] * d
    gradient = -mass[:, None] * gravity
    for c in range(3):
        gradient[:, c] += np.bincount(j, pull[:, c], len(x)) - np.bincount(i, pull[:, c], len(x))
    return np.sum(network.k * stretch**2) / 2 - np.sum(mass * (x @ gravity)), gradient


def hessian(network, x):
    """Of the springs' energy [N/m], (3 particles, 3 particles)."""
    (i, j), n = network.ends.T, len(x)
    d = x[j] - x[i]
    length = np.linalg.norm(d, axis=1)
    along = d[:, :, None] * d[:, None, :] / (length**2)[:, None, None]
    across = (1 - network.rest / length)[:, None, None] * (np.eye(3) - along)
    block = network.k[:, None, None] * (along + across)
    out = np.zeros((n, n, 3, 3))
    for a, b, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
        np.add.at(out, (a, b), sign * block)
    return out.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n)


def rest_shape(network, mass, gravity, start, held):
    """The minimum of the potential near ``start`` [m], and the least eigenvalue of its Hessian there [N/m]."""
    free = np.repeat(~np.isin(np.arange(len(start)), held), 3)
    gravity = np.asarray(gravity, float)

    def whole(q):
        x = start.astype(float).ravel()
        x[free] = q
        return x.reshape(-1, 3)

    def value(q):
        energy, gradient = potential(network, mass, gravity, whole(q))
        return energy, gradient.ravel()[free]

    q = start.ravel()[free].astype(float)
    q = minimize(value, q, jac=True, method="L-BFGS-B", options={"maxiter": 20000, "maxfun": 40000, "ftol": 0, "gtol": 1e-7}).x
    for _ in range(4):  # to rounding
        q = q - np.linalg.solve(hessian(network, whole(q))[np.ix_(free, free)], value(q)[1])
    return whole(q), np.linalg.eigvalsh(hessian(network, whole(q))[np.ix_(free, free)])[0]


# --- catenary -------------------------------------------------------------------------------------------------------------


class Catenary(NamedTuple):
    """Of a cable of weight 1 on supports at the same height and a distance of 1: H, the sag, and the tension at the ends."""

    horizontal: float
    sag: float
    end_tension: float


def catenary(length, softness):
    """The elastic cable, ``x(s) = H s/EA + H/w (asinh(V/H) - asinh((V - w s)/H))``; softness: its weight over EA."""

    def half_span(h):
        return h * softness * length / 2 + h * length * np.arcsinh(0.5 / h)

    h = brentq(lambda h: half_span(h) - 0.5, 1e-6, 1e6, xtol=1e-15)
    sag = length * (softness / 8 + np.hypot(h, 0.5) - h)
    return Catenary(h, sag, np.hypot(h, 0.5))


def lumped_catenary(length, softness, links):
    """The same cable as links of equal length with masses at their ends, half a mass on each support: each link is straight,
    and stretched by its own tension."""
    vertical = 0.5 - (np.arange(links) + 0.5) / links

    def span(h):
        tension = np.hypot(h, vertical)
        return np.sum(length / links * (1 + softness * tension) * h / tension)

    h = brentq(lambda h: span(h) - 1, 1e-6, 1e6, xtol=1e-15)
    tension = np.hypot(h, vertical)
    drops = length / links * (1 + softness * tension) * vertical / tension
    return Catenary(h, np.sum(drops[: links // 2]), np.hypot(h, 0.5))


# --- heavy elastica -------------------------------------------------------------------------------------------------------


class Elastica(NamedTuple):
    """Of a strip of length 1: reach and droop of its end, and the angles of the chord and of the end [deg]."""

    reach: float
    droop: float
    chord: float
    tip: float


def heavy_elastica(gravity):
    """``theta'' = -G (1 - s) cos(theta)``, clamped level, free at the end; G the weight per area times length^3 over B."""

    def slope(s, y):
        theta, turn = y[:2]
        return np.stack([turn, -gravity * (1 - s) * np.cos(theta), np.cos(theta), np.sin(theta)])

    def ends(a, b):
        return np.array([a[0], b[1], a[2], a[3]])

    s = np.linspace(0, 1, 201)
    guess = np.stack([gravity / (6 + gravity) * s, 0 * s, s, 0 * s])
    found = solve_bvp(slope, ends, s, guess, tol=1e-8, max_nodes=100000)
    assert found.success
    theta, _, reach, droop = found.y[:, -1]
    return Elastica(reach, droop, np.degrees(np.arctan2(droop, reach)), np.degrees(theta))
