"""``randomize=``: each episode draws its fabric, size and friction, delay and noise of actions and observations, and its camera.

Policies meet delay and noise outside of a simulation (Peng et al. 2018, "Sim-to-real transfer of robotic control with dynamics
randomization").  They are drawn from the environment's own generator, so an episode is the same in any batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import finite, shown
from clothgym.envs.episode import DIVERGED, Fields
from clothgym.envs.observing import CAMERA, PICTURES
from clothgym.envs.physics import checked_ranges
from clothgym.parameters import PROPERTIES, SIZES

if TYPE_CHECKING:
    from clothgym.envs.task import Task

# least and greatest end of each range; those of pictures are explained in ``views``.  Depths end at twice the camera's own distance
OF_CAMERAS: dict[str, tuple[float, float]] = {
    "camera_yaw": (-180, 180), "camera_tilt": (-90, 90), "camera_distance": (0.5, 1.5),
}  # fmt: skip
OF_COLORS: dict[str, tuple[float, float]] = {"brightness": (0, 4), "hue": (-180, 180)}
LIMITS: dict[str, tuple[float, float]] = {
    "size": SIZES, "friction": (0, 10), "action_delay": (0, 100), "action_noise": (0, 10), "observation_noise": (0, 10),
    **OF_CAMERAS, **OF_COLORS,
}  # fmt: skip
PREFIX = "randomization/"  # of the keys in info


class Disturbances:
    """Size of the sheets, friction of the solids, delay and noise of actions, noise, camera and colors of observations, of a batch.

    Attributes:
        ranges: of those of ``LIMITS`` that are drawn: ``size``, a factor on all lengths of the sheet; the coefficient ``friction``
            of all solids; ``action_delay``, in control steps; and standard deviations of normal noise: ``action_noise``, in each
            number of an action and control step, and ``observation_noise``, in each number of the state vector, in its unit; and
            those of pictures, see ``views``.
        max_delay: the longest delay that can be drawn, in control steps.
    """

    def __init__(self, ranges: Mapping[str, Sequence[float]]) -> None:
        self.ranges: dict[str, tuple[float, float]] = {}
        for name, bounds in ranges.items():
            pair = finite(f"randomize: {name}", bounds)
            least, most = LIMITS[name]
            if pair.shape != (2,) or not least <= pair[0] <= pair[1] <= most:
                raise ValueError(f"randomize: {name}={shown(bounds)} must be a range [low, high] from {least:g} to {most:g}")
            if name == "action_delay" and (pair != np.rint(pair)).any():
                raise ValueError(f"randomize: {name}={shown(bounds)} must be a range of whole control steps")
            self.ranges[name] = pair[0].item(), pair[1].item()
        self.max_delay = int(self.ranges.get("action_delay", (0, 0))[1])

    def check_observed(self, obs_mode: str) -> None:
        """Refuse noise of observations that are not the state vector, and a camera and colors of those that have none."""
        if "observation_noise" in self.ranges and obs_mode in PICTURES:
            raise ValueError(f"randomize: no observation_noise with obs_mode={obs_mode!r}: only the state vector has noise")
        for names, modes in ((OF_CAMERAS, CAMERA), (OF_COLORS, ("rgb", "rgbd"))):
            if obs_mode not in modes and (name := next((name for name in names if name in self.ranges), None)):
                raise ValueError(f"randomize: no {name} with obs_mode={obs_mode!r}; it is for {', '.join(modes)}")

    def remembers(self, actions: int) -> Fields:
        """Fields of an episode: what it has drawn, and its last actions, of control step t in row ``t mod (max_delay + 1)``."""
        drawn: Fields = [(name, float) for name in self.ranges]
        return [*drawn, ("last_actions", float, (self.max_delay + 1, actions))] if self.max_delay else drawn

    @property
    def smallest(self) -> float:
        """The smallest size that can be drawn."""
        return self.ranges.get("size", (1.0, 1.0))[0]

    def draw_size(self, own: Any, generator: np.random.Generator) -> None:
        """Draw the size of an episode's sheet, from which its start follows, into its record."""
        if "size" in self.ranges:
            own["size"] = generator.uniform(*self.ranges["size"])

    def draw(self, own: Any, generator: np.random.Generator) -> None:
        """Draw everything else of an episode into its record."""
        for name, (low, high) in self.ranges.items():
            if name != "size":
                own[name] = generator.integers(int(low), int(high) + 1) if name == "action_delay" else generator.uniform(low, high)

    def applied(self, task: Task, actions: NDArray, envs: NDArray) -> NDArray:
        """What reaches the attachments in a control step: noisy actions of some steps ago, zeros in the first steps.

        actions: (num_envs, numbers), float64; returned as they are where they are not finite, to be refused.
        """
        if not self.ranges.keys() & {"action_delay", "action_noise"} or not np.isfinite(actions).all():
            return actions
        applied = actions.copy()
        for env in envs.tolist():
            own = task.episode[env]
            if "action_noise" in self.ranges:
                noise = task.generators[env].normal(size=actions.shape[1])
                applied[env] = np.clip(applied[env], -1, 1) + own["action_noise"] * noise
            if self.max_delay:
                step, delay, rows = int(own["step"]), int(own["action_delay"]), self.max_delay + 1
                own["last_actions"][step % rows] = applied[env]
                applied[env] = own["last_actions"][(step - delay) % rows] if step >= delay else 0
        return applied

    def observed(self, task: Task, envs: NDArray) -> None:
        """Add noise to the observations of environments, within the observation's bounds.

        Goals have none: rewards are computed from them.  Nor has the last observation of a sheet that has diverged.
        """
        if "observation_noise" not in self.ranges:
            return
        exact = [task.observation_slices[name] for name in task.goals]
        for env in envs[task.outcome["failure"][envs] != DIVERGED].tolist():
            seen = task.observation[env]
            noise = task.episode["observation_noise"][env] * task.generators[env].normal(size=seen.size)
            for part in exact:
                noise[part] = 0
            seen[:] = np.clip(seen + noise, -task.state_bound, task.state_bound)


def checked(ranges: Any) -> tuple[dict[str, tuple[float, float]], Disturbances]:
    """Ranges of the fabric's properties, and the rest.

    Raises:
        ValueError: an unknown name, or a range that it cannot have.
    """
    if not isinstance(ranges, Mapping):
        raise ValueError(f"randomize={shown(ranges)}: must be a dict of ranges, for instance {{'density': [0.1, 0.2]}}")
    for name in ranges:
        if name not in (*PROPERTIES, *LIMITS):
            raise ValueError(f"randomize: no parameter {name!r} (there are: {', '.join((*PROPERTIES, *LIMITS))})")
    fabric = {name: bounds for name, bounds in ranges.items() if name in PROPERTIES}
    return checked_ranges(fabric), Disturbances({name: ranges[name] for name in LIMITS if name in ranges})


def told(task: Task) -> dict[str, NDArray]:
    """What the present episodes have drawn by ``randomize``, by its key in info, (num_envs,)."""
    fabric = {PREFIX + name: task.episode["material"][:, PROPERTIES.index(name)].copy() for name in task.randomize}
    return fabric | {PREFIX + name: task.episode[name].copy() for name in task.disturbances.ranges}
