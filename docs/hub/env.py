"""LeRobot's EnvHub: this file, and a requirements.txt that names clothgym, make a repository of the hub.

lerobot.envs.make_env("USER/REPOSITORY", n_envs=16, trust_remote_code=True)
"""

from typing import Any

from clothgym.adapters import lerobot


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> lerobot.LeRobotVectorEnv:
    return lerobot.make_env(n_envs, use_async_envs, cfg, env_id="ClothFold-v0", obs_mode="rgb")
