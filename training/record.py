"""Record a data set: episodes of a policy, for imitation learning and offline learning.

    python training/record.py --env ClothFold-v0 --policy expert --episodes 100 --format lerobot
    python training/record.py --env ClothFold-v0 --policy runs/ClothFold-v0_0 --obs-mode rgb --failed drop --format minari
    python training/record.py --verify data/ClothFold-v0_expert_lerobot      # runs each episode again, and compares

Episode ``i`` is the one that seed ``seed + i`` gives.  After a crash, the same command goes on with those that had not ended.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import formats
import policies
import tyro
from endings import refused, stopped
from scoring import HELD_OUT
from tqdm import tqdm

from clothgym.folders import expand_paths
from clothgym.registration import checked_id


@dataclass
class Args:
    """What to record, and how."""

    env: str = "ClothDrape-v0"
    """Id of the environment."""
    policy: Annotated[str, tyro.conf.arg(metavar="{noop,random,expert,careless,learned,PATH}")] = "expert"
    """Policy: noop, random, expert, careless (of ClothStrain-v0); learned, the committed one, or learned:LEARNER; or the path of a
    run's folder or of a policy.npz."""
    episodes: int = 100
    """Episodes in the set."""
    seed: int = 0
    """Seed of the first episode; seeds of a million and more are for evaluation."""
    format: Literal["lerobot", "minari", "robomimic"] = "lerobot"
    """Format of the set."""
    obs_mode: Literal["keypoints", "particles", "heightmap", "pointcloud", "rgb", "depth", "rgbd"] = "keypoints"
    """Kind of the observations."""
    env_kwargs: str = "{}"
    """Further keyword arguments of the environment, as JSON: '{"image_size": 96, "privileged": true}'."""
    out: Path | None = None
    """Folder of the set, which must not exist; by default data/ENV_POLICY_FORMAT."""
    failed: Literal["keep", "drop"] = "keep"
    """Whether failed episodes stay in the set, marked, or are left out and replaced by further ones."""
    noise: float = 0.0
    """Largest standard deviation of a disturbance of the actions; each episode draws its own.  Disturbed actions are recorded."""
    pictures: Literal["png", "video"] = "png"
    """For lerobot with rgb: pictures as they are, or as films, which are smaller and change them."""
    num_envs: int = 64
    """Environments that run at once; the set is the same with any number."""
    threads: int | None = None
    """Threads of the environments, which change nothing in the set; all processors by default."""
    max_gb: float = 20.0
    """Gigabytes that the folders may take while the set is made."""
    verify: Path | None = None
    """A finished set: run each of its episodes again from its first state, and compare actions, rewards and observations."""

    def __post_init__(self) -> None:
        """Everything is checked here; errors look like those of a wrong flag."""
        expand_paths(self)
        self.env = checked_id(self.env)
        for name, least in (("episodes", 1), ("num_envs", 1), ("seed", 0)):
            if getattr(self, name) < least:
                raise ValueError(f"--{name.replace('_', '-')} {getattr(self, name)}: must be at least {least}")
        if self.threads is not None and self.threads < 1:
            raise ValueError(f"--threads {self.threads}: must be at least 1")
        if self.seed < HELD_OUT <= self.seed + self.episodes:
            raise ValueError(f"--seed {self.seed}: its episodes reach {HELD_OUT}, from where on seeds are for evaluation")
        if not 0 <= self.noise <= 1:
            raise ValueError(f"--noise {self.noise}: must be from 0 to 1")
        if self.noise and self.policy == "random":
            raise ValueError(f"--noise {self.noise}: the actions of --policy random are noise already")
        if not self.max_gb > 0:
            raise ValueError(f"--max-gb {self.max_gb}: must be positive")
        if self.pictures == "video" and (self.format, self.obs_mode) != ("lerobot", "rgb"):
            raise ValueError("--pictures video: is for --format lerobot with --obs-mode rgb")
        policies.parsed_kwargs(self.env_kwargs)
        if self.verify is None:
            policies.checked(self.policy, self.env)
        if self.out is None:
            self.out = Path("data") / f"{self.env}_{Path(self.policy).stem}_{self.format}"


def arguments(args: Args) -> dict[str, Any]:
    """What decides the content of the set, as JSON."""
    names = ("env", "policy", "episodes", "seed", "format", "obs_mode", "failed", "noise", "pictures")
    own, given = policies.env_kwargs(args.policy, args.env), policies.parsed_kwargs(args.env_kwargs)
    if "obs_mode" in given:
        raise ValueError("--env-kwargs: obs_mode is the flag --obs-mode")
    kwargs = {name: value for name, value in (own | given).items() if name != "obs_mode"}
    lossy = ["observation.image"] if args.pictures == "video" else []
    return {name: getattr(args, name) for name in names} | {"env_kwargs": kwargs, "lossy_features": lossy}


def acting(args: Args) -> policies.Policy | None:
    """The policy, None for random actions.  One that was trained on state vectors gets these also while pictures are recorded.

    Raises:
        ValueError: it needs other observations than those that are recorded.
    """
    if args.policy == "random":
        return None
    policy = policies.named(args.policy, args.env, args.seed)
    needs = policies.env_kwargs(args.policy, args.env).get("obs_mode", "keypoints")
    if args.policy in policies.SCRIPTED or needs == args.obs_mode:
        return policy
    if needs != "keypoints" or args.obs_mode == "particles":
        raise ValueError(f"--obs-mode {args.obs_mode}: {args.policy} observes {needs}; record with --obs-mode {needs}")

    def from_states(env: Any, observations: Any) -> Any:
        task = env.unwrapped.task
        return policy(env, task.returned(task.observation.copy(), slice(None)))

    return from_states


def record(args: Args) -> None:
    import recordings

    assert args.out is not None
    chosen = formats.named(args.format)
    about = arguments(args)
    env = recordings.make_batch(about, min(args.num_envs, args.episodes), args.threads)
    about = recordings.describe(about | {"name": "cloth/" + re.sub(r"[^\w.-]", "_", args.out.name)}, env)
    journal = recordings.Journal(args.out, about, args.max_gb * 1e9)
    policy = acting(args)
    with tqdm(total=args.episodes, initial=sum(journal.ended.values()), unit="episode", disable=None) as bar:
        seeds = recordings.record(env, policy, journal, about, bar)
    env.close()
    recordings.finish(journal, about, seeds, chosen.write, args.out)
    print(f"{args.episodes} episodes in {args.out}")


def verify(folder: Path) -> None:
    import recordings

    about = recordings.read_about(folder)
    episodes = formats.named(about["format"]).read(folder, about)
    failed = []
    for index, episode in enumerate(tqdm(episodes, total=about["episodes"], unit="episode", leave=False, disable=None)):
        if not recordings.replays(folder, index, episode):
            failed.append(index)
    if failed:
        raise ValueError(
            f"{folder}: episodes {failed} do not replay: they are damaged, or of another version of clothgym or processor"
        )
    print(f"{about['episodes']} of {about['episodes']} episodes replay to the bit")


def main(args: Args) -> None:
    with refused():
        verify(args.verify) if args.verify else record(args)


if __name__ == "__main__":
    given = tyro.cli(Args)
    with stopped(lambda: "; the same command continues"):
        main(given)
