"""A policy of Stable-Baselines3 that sees depth pictures, with a critic that knows the numbers behind them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import torch
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

CHANNELS, FEATURES = 32, 64
LAYER = 0.004  # height [m] whose saturating value is a half: two layers of a thin sheet


class DepthEncoder(BaseFeaturesExtractor):
    """Pictures of depth, (batch, 1, size, size) [m], to features, (batch, 64).

    Heights h above the camera's target, also as h / (abs(h) + LAYER), where a sheet on the floor stands out if the camera looks
    straight down at the floor, as it does by default.  Two convolutions follow; then where each of their channels is strongest, as
    a spatial soft-argmax (Finn et al. 2016, "Deep spatial autoencoders for visuomotor learning"), and the mean over the picture.
    The number of weights does not depend on ``image_size``.
    """

    def __init__(self, observation_space: gym.spaces.Dict) -> None:
        super().__init__(observation_space, FEATURES)
        picture: Any = observation_space["observation"]
        # the sky's depth is twice that of the camera's target
        self.middle = float(picture.high.max()) / 2
        self.convolutions = nn.Sequential(
            nn.Conv2d(4, 16, 8, stride=4, padding=2), nn.ReLU(), nn.Conv2d(16, CHANNELS, 3, padding=1), nn.ReLU()
        )
        self.linear = nn.Sequential(nn.Linear(3 * CHANNELS, FEATURES), nn.Tanh())

    def forward(self, observations: dict[str, torch.Tensor] | torch.Tensor) -> torch.Tensor:
        pictures = observations["observation"] if isinstance(observations, dict) else observations
        return self.encode(self.middle - pictures.float())

    def encode(self, heights: torch.Tensor) -> torch.Tensor:
        """heights: above the camera's target, along its axis, (batch, 1, size, size) [m]."""
        heights = heights.float()
        scales = 4 * heights / self.middle, heights / (heights.abs() + LAYER)
        seen = self.convolutions(torch.cat([*scales, _coordinates(heights).expand(len(heights), -1, -1, -1)], dim=1))
        places = torch.softmax(seen.flatten(2), dim=2) @ _coordinates(seen).flatten(2)[0].T
        return self.linear(torch.cat([places.flatten(1), seen.mean(dim=(2, 3))], dim=1))


class DepthActor(nn.Module):
    """A policy net of a picture and of numbers of the state beside it, such as those of a robot's joints; there may be none.

    encoder: of the picture.  head: from its features, followed by those numbers.  felt: where the numbers are in the state.
    """

    felt: torch.Tensor

    def __init__(self, encoder: DepthEncoder, head: nn.Module, felt: Sequence[int]) -> None:
        super().__init__()
        self.encoder, self.head = encoder, head
        self.register_buffer("felt", torch.tensor(felt, dtype=torch.long), persistent=False)

    def forward(self, seen: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """seen: heights as ``DepthEncoder.encode`` takes them, and states, (batch, numbers)."""
        heights, states = seen
        return self.head(torch.cat([self.encoder.encode(heights), states[:, self.felt]], dim=1))


def _coordinates(pictures: torch.Tensor) -> torch.Tensor:
    """Columns and rows of pixels from -1 to 1, (1, 2, rows, columns)."""
    y, x = (torch.linspace(-1, 1, size, dtype=pictures.dtype, device=pictures.device) for size in pictures.shape[-2:])
    return torch.stack([x.expand(len(y), -1), y[:, None].expand(-1, len(x))])[None]


class StateEncoder(BaseFeaturesExtractor):
    """Encode the state vector that accompanies an image, (batch, numbers), to features, (batch, 64)."""

    def __init__(self, observation_space: gym.spaces.Dict) -> None:
        super().__init__(observation_space, FEATURES)
        self.layer = nn.Sequential(nn.Linear(gym.spaces.flatdim(observation_space["state"]), FEATURES), nn.Tanh())

    def forward(self, observations: dict[str, torch.Tensor]) -> torch.Tensor:
        return self.layer(observations["state"].float())


class DepthPolicy(MultiInputActorCriticPolicy):
    """For ``obs_mode="depth", privileged=True``: the actor sees the picture alone, and the critic the state alone
    (Pinto et al. 2018, "Asymmetric actor critic for image-based robot learning").

    Takes what SB3's ``MultiInputPolicy`` takes but the features' extractors: ``PPO(DepthPolicy, env, ...)``.

    Raises:
        ValueError: an environment without both.
    """

    def __init__(self, observation_space: gym.Space, *args: Any, **kwargs: Any) -> None:
        if not isinstance(observation_space, gym.spaces.Dict) or {"observation", "state"} - observation_space.spaces.keys():
            raise ValueError(
                "DepthPolicy takes images together with a state: make the environment with obs_mode='depth', privileged=True"
            )
        kwargs |= {"share_features_extractor": False, "normalize_images": False}
        super().__init__(observation_space, *args, **kwargs)

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        # SB3 asks for the actor's first, then for the critic's
        made = StateEncoder if hasattr(self, "pi_features_extractor") else DepthEncoder
        return made(self.observation_space)  # type: ignore[arg-type]
