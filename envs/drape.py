"""ClothDrape-v0: lay a hanging sheet over a target and release it; the evaluation follows when it has settled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clothgym.envs import draping
from clothgym.envs.draping import DrapingTask
from clothgym.envs.experts import as_actions
from clothgym.envs.observing import View
from clothgym.envs.scoring import holds_nothing
from clothgym.envs.single import ClothEnv
from clothgym.envs.stepping import Kernels

# the scripted expert's path, in sides: distance beyond the target, height above it on the way, depth below its top at the end
EXPERT_BEYOND, EXPERT_LIFT, EXPERT_DROP = 0.3, 0.55, 0.25


class DrapeTask(DrapingTask):
    """The task of ``ClothDrape-v0``, see ``ClothDrapeEnv``."""

    physics = replace(draping.PHYSICS, anchors=draping.upper_corners)
    kernels = Kernels(
        draping.covering, draping.evaluate_cover, draping.observe_target, act=draping.let_go,
        done=holds_nothing, account=draping.account_reference,
    )  # fmt: skip
    seen_from = View((1.6, -1.3, 1.05), (0.0, -0.19, 0.27), 33.0)
    acting_steps = 60
    settling_steps = 85
    actions_per_attachment = 4
    observations = draping.observations(2, "whether each corner is held")
    guide_reach = 0.15

    def begin(self, env: int, rng: np.random.Generator, options: Mapping[str, Any]) -> NDArray:
        target, mesh, side = self.draw_target(env, rng, options.get("target", {})), self.physics.mesh, self.physics.side
        distance = side * float(rng.uniform(0.75, 0.9))
        sideways = side * float(rng.uniform(-0.1, 0.1))
        clearance = side * float(rng.uniform(0.1, 0.25))
        ripple = rng.normal(scale=1e-3, size=mesh.num_particles)
        # the sheet hangs in a plane perpendicular to the direction of the target, its held edge up
        rest = mesh.rest_positions
        x = target.center[0] + sideways + rest[:, 0]
        y = target.center[1] - distance + ripple
        z = clearance + side / 2 + rest[:, 1]
        return np.stack([x, y, z], axis=1)

    def expert_actions(self) -> NDArray:
        """Move over the target in a straight line, three tenths of a side beyond it, then down, and release.

        The expert has no memory: the positions of the anchors determine the phase.
        """
        tops, side = self.episode["top"], self.physics.side
        middle = self.episode["targets"].mean(axis=1)
        beyond = tops[:, 1] + EXPERT_BEYOND * side
        arrived = np.abs(middle[:, 1] - beyond) < 0.02
        low = np.maximum(tops[:, 2] - EXPERT_DROP * side, 0.02)
        goal = np.stack([tops[:, 0], beyond, np.where(arrived, low, tops[:, 2] + EXPERT_LIFT * side)], axis=1)
        release = np.where(arrived & (np.abs(middle[:, 2] - low) < 0.02), 1.0, -1.0)
        # half of the remaining distance in each step, the same for both
        each = np.ones((1, self.num_attachments))
        return as_actions(self, (goal - middle)[:, None] / 2 * each[..., None], release[:, None] * each)


class ClothDrapeEnv(ClothEnv):
    """Lay a hanging sheet over a target and release it.

    ## Description
    A square sheet of side L = 0.6 m (17 x 17 particles) hangs from two held corners, 0.75 to 0.9 L in front of a target
    that stands on the floor: a sphere (radius 0.2 to 0.3 L), a box (side 0.3 to 0.5 L) or a round-topped post (radius 0.1 to
    0.15 L, height 0.4 to 0.6 L).  The agent moves both corners and may release each.  When it holds none, or after 60
    steps, the sheet settles for 85 steps, in which actions are ignored; then it is evaluated.

    $physics

    The fabric is the median of 618 measured fabrics; its linear drag comes from filmed cloth.  The settling time is long because a
    corner that hangs from a thin post swings for two seconds.

    ## Action Space
    $actions corner

    ## Rewards
    $rewards

    During the episode the potential is the mean of two terms: the nearness of the sheet to 32 points of the target's upper surface,
    ``1/(1 + (d/0.15 L)^2)``, and the centering of its center of area, ``1/(1 + (e/0.2 L)^2)``.  The return is therefore the score
    minus the potential at the start, plus the small terms.

    ## Evaluation
    The evaluation casts rays along the outward normals of 256 points, spread evenly over the part of the target's surface with a
    slope of at most 60 degrees.  A point is covered if there is cloth within 0.05 L, and it does not stick out of the cloth by more
    than 2 mm.  Coverage C is the share of covered points; C_ref is that of a fine (49 x 49) sheet lowered flat and centered onto
    the same target (``benchmarks/drape_reference.py``; for another fabric it is simulated on first use).  Spread S is the share of
    the covered points with one layer of cloth within 0.1 L: 1 for a flat sheet, 0 for a doubled one.  e is the horizontal distance
    of the sheet's center of area from the target's axis.

    ``info["normalized_performance"]`` = min(C / C_ref, 1) S / (1 + (e / 0.2 L)^2) / (1 + (v / 0.1 m/s)^2), with the rms speed v:
    0 for a sheet that does not touch the target's top, 1 for one that lies flat, centered and at rest.
    ``info["is_success"]``: C >= 0.9 C_ref, S >= 0.9, e <= 0.1 L and v under 0.02 m/s.  ``info`` also has ``coverage``,
    ``coverage_reference``, ``spread``, ``off_center`` (e / L), ``rms_speed`` [m/s], ``strain_max``, ``strain_before_limiting``,
    ``settling``, ``failure`` and the ``reward/...`` terms.  Entries of the evaluation are 0 until then.

    ## Starting State
    The sheet hangs at rest, its lower edge 0.1 to 0.25 L above the floor, up to 0.1 L to the side, with a ripple of a
    millimeter; the target's axis is within 0.25 L of the origin; a box is turned by up to 45 degrees.

    ## Vectorized environment
    ``gym.make_vec("clothgym:ClothDrape-v0", num_envs=256)``; environment ``i`` seeded ``s`` equals a single one seeded
    ``s + i``, bit for bit.
    """

    task_class = DrapeTask
