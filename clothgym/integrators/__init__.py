"""Floor 4: the table of integrators, one file each.  Wherever an integrator is expected, its name or an ``Integrator`` will do."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from clothgym.checks import known
from clothgym.integrators.base import Integrator
from clothgym.integrators.explicit_euler import EXPLICIT_EULER
from clothgym.integrators.implicit_euler import IMPLICIT_EULER
from clothgym.integrators.pbd import PBD
from clothgym.integrators.projective_dynamics import PROJECTIVE_DYNAMICS
from clothgym.integrators.rk4 import RK4
from clothgym.integrators.semi_implicit_euler import SEMI_IMPLICIT_EULER
from clothgym.integrators.verlet import VERLET
from clothgym.integrators.xpbd import XPBD
from clothgym.warning import warn_caller

INTEGRATORS: dict[str, Integrator] = {
    method.name: method
    for method in (EXPLICIT_EULER, SEMI_IMPLICIT_EULER, VERLET, RK4, IMPLICIT_EULER, PROJECTIVE_DYNAMICS, PBD, XPBD)
}


def get(integrator: str | Mapping[str, Any] | Integrator) -> Integrator:
    """The integrator of that name, with options as ``{"name": "xpbd", "iterations": 4}``, or the object itself.

    An option that only other integrators have is ignored, with a warning.

    Raises:
        ValueError: no such name or option; the message lists the right ones.
    """
    if isinstance(integrator, Integrator):
        return integrator
    if isinstance(integrator, Mapping):
        options = {key: value for key, value in integrator.items() if key != "name"}
        if "name" not in integrator:
            raise ValueError(f"integrator={dict(integrator)!r}: must have a 'name', one of {', '.join(INTEGRATORS)}")
        method = get(integrator["name"])
        # an option of another integrator is ignored; what no integrator has is an error, raised by with_options
        for name in set(options) - set(method.options):
            others = [other.name for other in INTEGRATORS.values() if name in other.options]
            if others:
                warn_caller(f"{method.name} has no option {name!r} ({', '.join(others)} has): it is ignored")
                del options[name]
        return method.with_options(**options)
    known("integrator", integrator, INTEGRATORS)
    return INTEGRATORS[integrator]


__all__ = ["INTEGRATORS", "Integrator", "get"]
