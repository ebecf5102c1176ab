"""The episodes on which policies are compared: those of seeds that no training may use.

An episode is its environment's id, its keyword arguments and its seed: ``env.reset(seed=seed)``, and in a batch
``envs.reset(seed=list(seeds))``, begin the same one, with the same bits, on any machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from clothgym.registration import ENVIRONMENTS

FIRST_HELD_OUT = 1_000_000  # training uses seeds below

# seeds of the committed scores, by id; a score of fewer episodes takes the first
HELD_OUT: Mapping[str, range] = MappingProxyType(dict.fromkeys(ENVIRONMENTS, range(FIRST_HELD_OUT, FIRST_HELD_OUT + 500)))
