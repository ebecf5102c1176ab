"""Floor 4: the table of integrators.  One file each; a name or an ``Integrator`` is accepted wherever one is asked for."""

from __future__ import annotations

import difflib

from clothgym.integrators import semi_implicit_euler, xpbd
from clothgym.integrators.base import Integrator

INTEGRATORS: dict[str, Integrator] = {method.name: method for method in (semi_implicit_euler.SEMI_IMPLICIT_EULER, xpbd.XPBD)}


def get(integrator: str | Integrator) -> Integrator:
    """The integrator of that name, or the object itself.

    Raises:
        ValueError: no such name; the message lists the right ones.
    """
    if isinstance(integrator, Integrator):
        return integrator
    if integrator not in INTEGRATORS:
        near = difflib.get_close_matches(str(integrator), INTEGRATORS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"no integrator {integrator!r}{hint} (there are: {', '.join(INTEGRATORS)})")
    return INTEGRATORS[integrator]


__all__ = ["INTEGRATORS", "Integrator", "get"]
