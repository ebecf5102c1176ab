"""What somebody does first who has installed clothgym: run it where there is no repository.  Needs nothing but the core."""

import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path

began = time.perf_counter()
import clothgym  # noqa: E402

assert not {"numba", "scipy", "torch"} & set(sys.modules), "import clothgym is not light"
import gymnasium as gym  # noqa: E402

assert Path(clothgym.__file__).is_relative_to(sys.prefix), f"not the installed one: {clothgym.__file__}"
assert clothgym.__version__ == version("clothgym")


def say(what: str) -> None:
    print(f"{time.perf_counter() - began:7.1f} s  {what}", flush=True)


listed = subprocess.run([sys.executable, "-m", "clothgym", "list"], check=True, capture_output=True, text=True).stdout
assert all(name in listed for name in ("ClothDrape-v0", "xpbd", "denim"))
say("python -m clothgym list")

env = gym.make("clothgym:ClothReach-v0", render_mode="rgb_array")
env.reset(seed=0)
for _ in range(5):
    env.step(env.action_space.sample())
say("five steps of ClothReach-v0")
assert env.render().std() > 10, "the picture is empty"
say("a picture")

policy = clothgym.policies.load("ClothReach-v0")
env, terminated = policy.make(), False
observation, _ = env.reset(seed=0)
while not terminated:
    observation, _, terminated, _, info = env.step(policy(observation))
assert info["is_success"], info
say(f"the learned policy's episode: {info['normalized_performance']:.3f}")

batch = gym.make_vec("ClothReach-v0", num_envs=8)
batch.reset(seed=0)
assert batch.step(batch.action_space.sample())[1].shape == (8,)
say("a step of a batch")

print(
    "Python", sys.version.split()[0], *(f"{name} {version(name)}" for name in ("clothgym", "numba", "numpy", "scipy", "gymnasium"))
)
