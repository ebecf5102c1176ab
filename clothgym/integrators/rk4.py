"""The classical Runge-Kutta method of order 4.

Hairer, Norsett and Wanner 1993, Solving Ordinary Differential Equations I, section II.1; for stability Hairer and Wanner 1996,
Solving Ordinary Differential Equations II, section IV.2.

Order 4.  Cost: four force passes per substep.  On an undamped oscillator of angular frequency w it is stable for h w <= 2 sqrt(2),
and its amplitude is multiplied by about ``1 - (h w)^6/144`` per substep.  A damped mode with eigenvalue lambda is stable where
``|1 + z + z^2/2 + z^3/6 + z^4/24| <= 1`` with z = h lambda.  Damping along springs and linear drag are part of the derivative.
"""

from __future__ import annotations

import numpy as np

from clothgym._jit import disjoint, kernel, merged, uncounted
from clothgym.bending import add_bend_forces
from clothgym.forces import Oscillators, frequency_bound, largest_frequency, set_spring_forces
from clothgym.integrators.base import Integrator, advance, copy_to


def _amplification(h: float, w: float, damping_time: float) -> float:
    """Largest growth of a damped mode of frequency w [rad/s] in a substep h [s]: ``|R(h lambda)|`` of both its eigenvalues."""
    rate = damping_time * w * w / 2
    root = np.sqrt(complex(rate * rate - w * w))
    return max(float(abs(np.polyval([1 / 24, 1 / 6, 1 / 2, 1, 1], h * (-rate + sign * root)))) for sign in (1, -1))


def _stable_substep(w: float, damping_time: float) -> float:
    """The substep [s] at which the amplification of the mode passes 1, by bisection below the bound of the undamped mode."""
    # up to the undamped bound, if damping does not lower it
    low, high = 0.0, 2 * np.sqrt(2) / w
    if _amplification(high, w, damping_time) <= 1 + 1e-9:
        return float(high)
    # bisection: stable at low, unstable at high
    while high - low > 1e-9 * high:
        middle = (low + high) / 2
        low, high = (middle, high) if _amplification(middle, w, damping_time) <= 1 else (low, middle)
    return float(low)


def largest_substep(o: Oscillators) -> tuple[float, str]:
    """The bound [s] at the sheet's largest frequency, and the reason for it."""
    return _stable_substep(largest_frequency(o), o.damping_time), "beyond it the stiffest mode of the sheet grows without bound"


def surely_allowed(o: Oscillators) -> float:
    """The bound [s] at a frequency that is certainly no smaller than the largest one."""
    return _stable_substep(frequency_bound(o), o.damping_time)


@disjoint
def _stage_of(x, v, w, f, g, drag, start_x, start_v, sum_x, sum_v, share, reach):
    """One component of ``_stage`` for one sheet: arrays (particles,); gravity g [m/s^2] and drag [1/s] are numbers."""
    zero = x.dtype.type(0)
    for p in range(x.shape[0]):
        a = f[p] * w[p] + g - drag * v[p]
        a = a if w[p] > zero else zero
        sum_x[p] += share * v[p]
        sum_v[p] += share * a
        x[p] = start_x[p] + reach * v[p]
        v[p] = start_v[p] + reach * a


@kernel
def _stage(x, v, w, f, gravity, drag_rate, start_x, start_v, sum_x, sum_v, share, reach):
    """One stage: ``sum <- sum + share k`` and ``(x, v) <- start + reach k``, with the derivative ``k = (v, M^-1 f + g - b v)``.

    The acceleration of a held particle is zero.  x, v, f, the starts and the sums: (3, particles, lanes).  share: weight of the
    stage.  reach: to the next stage [s].
    """
    zero = x.dtype.type(0)
    particles, lanes = x.shape[1], x.shape[2]
    for c in range(3):
        if lanes == 1:
            _stage_of(
                merged(x[c]), merged(v[c]), merged(w), merged(f[c]), gravity[c, 0],
                drag_rate[0], merged(start_x[c]), merged(start_v[c]), merged(sum_x[c]),
                merged(sum_v[c]), share, reach,
            )  # fmt: skip
            continue
        for p in range(particles):
            wp, xc, vc, fc, gc = w[p], x[c, p], v[c, p], f[c, p], gravity[c]
            xs, vs, dx, dv = start_x[c, p], start_v[c, p], sum_x[c, p], sum_v[c, p]
            for l in range(lanes):
                a = fc[l] * wp[l] + gc[l] - drag_rate[l] * vc[l]
                a = a if wp[l] > 0 else zero
                dx[l] += share * vc[l]
                dv[l] += share * a
                xc[l] = xs[l] + reach * vc[l]
                vc[l] = vs[l] + reach * a


@uncounted
def substep(x, v, w, elements, elastic, drag_rate, gravity, push, h, options, plan, work):
    """``y_1 = y_0 + h/6 (k_1 + 2 k_2 + 2 k_3 + k_4)`` with y = (x, v) and its derivative ``k = (v, M^-1 f(x, v) + g - b v)``.

    k_1 is taken at y_0, k_2 at ``y_0 + h/2 k_1``, k_3 at ``y_0 + h/2 k_2`` and k_4 at ``y_0 + h k_3``; b is the drag's rate.
    Arguments, shapes and units are those of ``integrators.base``.
    """
    t = x.dtype.type
    start_x, start_v, sum_x, sum_v, f = work.fields[0], work.fields[1], work.fields[2], work.fields[3], work.fields[4]
    # y_0, and the weighted sum of the derivatives
    copy_to(start_x, x)
    copy_to(start_v, v)
    sum_x[:] = 0
    sum_v[:] = 0
    for stage in range(4):
        # the forces at this stage
        set_spring_forces(x, v, push, f, elements, elastic, work.scratch)
        add_bend_forces(x, v, f, elements, elastic, work.scratch)
        # add the derivative with its weight, and go on to the next stage; where the last one goes is overwritten below
        share = t(1) if stage == 0 or stage == 3 else t(2)
        reach = h if stage == 2 else t(0.5) * h
        _stage(x, v, w, f, gravity, drag_rate, start_x, start_v, sum_x, sum_v, share, reach)
    # y_1 from y_0 and the sum
    copy_to(x, start_x)
    copy_to(v, start_v)
    advance(x, sum_x, work.remainders[0], h / t(6))
    advance(v, sum_v, work.remainders[1], h / t(6))


RK4 = Integrator(
    "rk4",
    color="#7b4fa3",
    order=4,
    cost="four force passes",
    damping="as a part of the derivative, at full order",
    substep=substep,
    largest_substep=largest_substep,
    surely_allowed=surely_allowed,
    any_order=True,
    safety=0.8,
    lead=0.5,
    fields=5,
)
