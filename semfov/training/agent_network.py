"""The network of a trained agent for Stable-Baselines3: convolutions over the cells of the belief."""

from typing import Any

import torch
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

__all__ = ["CellFeatures", "CellPolicy", "MaskablePPO", "Returns"]


class CellFeatures(BaseFeaturesExtractor):
    """Compute one number for every cell from the belief in its neighbourhood.

    Args:
        observation_space: Gymnasium's space of the belief planes, of shape `(C, Y, X)`.
        width: channels of the hidden layers.
    """

    def __init__(self, observation_space: Any, width: int = 16) -> None:
        planes, rows, columns = observation_space.shape
        super().__init__(observation_space, rows * columns)
        self.layers = nn.Sequential(
            nn.Conv2d(planes, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(width, 1, 1),
            nn.Flatten(),
        )

    def forward(self, observations: Tensor) -> Tensor:
        """Map belief planes `(B, C, Y, X)` to one number per cell, `(B, X·Y)`."""
        found: Tensor = self.layers(observations)
        return found


class CellPolicy(MaskableActorCriticPolicy):
    """A policy that uses the numbers of `CellFeatures` as the logits of the cells.

    The value function has its own copy of `CellFeatures`, followed by a hidden layer.

    Args:
        given: positional arguments of `MaskableActorCriticPolicy`.
        width: channels of the hidden layers of `CellFeatures`.
        options: keyword arguments of `MaskableActorCriticPolicy`.
    """

    def __init__(self, *given: Any, width: int = 16, **options: Any) -> None:
        features = {"features_extractor_class": CellFeatures, "features_extractor_kwargs": {"width": width}}
        layers = {"net_arch": {"pi": [], "vf": [64]}, "share_features_extractor": False}
        super().__init__(*given, **{**options, **features, **layers})

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        options: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **options)


class Returns(BaseCallback):
    """Record the mean return of the last episodes before each update."""

    def __init__(self) -> None:
        super().__init__()
        self.means: list[float] = []

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        last: Any = self.model.ep_info_buffer
        if last:
            self.means.append(float(torch.tensor([each["r"] for each in last]).mean()))
