"""LeRobot's configuration of our environments: ``--env.type=clothgym`` of its command line.  Needs LeRobot (0.6, Python 3.12)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig

from clothgym.adapters.lerobot import LeRobotVectorEnv, feature, make_env

KINDS = {"agent_pos": FeatureType.STATE, "environment_state": FeatureType.ENV, "pixels": FeatureType.VISUAL}


@EnvConfig.register_subclass("clothgym")
@dataclass
class ClothgymConfig(EnvConfig):
    """One of our ids, as ``lerobot-eval --env.task=ClothFold-v0 --env.obs_mode=rgb`` names it.

    Its features follow from the environment, which is made once for that.

    Attributes:
        task: the id.
        obs_mode: kind of the observations; "rgb" comes with the attachments' positions, "keypoints" with the state vector too.
        env_kwargs: further keyword arguments of the environment, ``{"image_size": 96}``.
    """

    task: str | None = "ClothDrape-v0"
    obs_mode: str = "rgb"
    env_kwargs: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        env = make_env(cfg=self)
        self.fps = env.unwrapped.metadata["render_fps"]
        shapes = {key: box.shape for key, box in env.single_observation_space.spaces.items()}  # type: ignore[attr-defined]
        self.features = {key: PolicyFeature(KINDS.get(key, FeatureType.STATE), shape) for key, shape in shapes.items()}
        self.features["action"] = PolicyFeature(FeatureType.ACTION, env.single_action_space.shape)
        self.features_map = {key: feature(key) for key in shapes} | {"action": "action"}
        env.close()

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"obs_mode": self.obs_mode, **self.env_kwargs}

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, LeRobotVectorEnv]]:
        """The batch, as the one task of a suite."""
        return {self.type: {0: make_env(n_envs, use_async_envs, self)}}
