"""Train an agent by reinforcement learning: Stable-Baselines3's PPO in the environment `semfov/GazeSearch-v0`.

The agent observes the belief alone: the probability of the target in every cell, the cells that it has fixated, and the
position of its gaze. A small convolutional network computes a logit for every cell. The reward is 1 for finding the
target, minus a price for every look; that probable cells are good choices, the agent has to learn.

It needs Stable-Baselines3: pip install "semfov[agents]"

Run it from a checkout: python -m examples.train_agent
"""

import argparse
from typing import Any

import numpy as np
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import Tensor, nn

from semfov.envs import GazeVectorEnv, MaskedRandom, PolicyAgent, open_scenery, run_agent
from semfov.envs.agents import Agent
from semfov.envs.stable_baselines3 import StableVecEnv


class CellFeatures(BaseFeaturesExtractor):
    """One number for every cell, from the belief in its neighbourhood.

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
        numbers: Tensor = self.layers(observations)
        return numbers


class CellPolicy(MaskableActorCriticPolicy):
    """A policy that uses the numbers of `CellFeatures` as the logits of the cells.

    The value function has its own copy of `CellFeatures`, followed by a hidden layer.

    Args:
        given: positional arguments of `MaskableActorCriticPolicy`.
        options: keyword arguments of `MaskableActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        layers = {"net_arch": {"pi": [], "vf": [64]}, "share_features_extractor": False}
        super().__init__(*arguments, **{**options, "features_extractor_class": CellFeatures, **layers})

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        options: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **options)


class TrainedAgent:
    """A trained model as an agent that takes the most probable action.

    Args:
        model: a model of Stable-Baselines3 that was trained on the belief alone.
    """

    def __init__(self, model: Any) -> None:
        self._model = model

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Any:
        """Choose the next cell of every episode."""
        masks = infos["action_mask"].astype(bool)
        # When an episode is over, all of its cells may have been fixated, but the model needs one allowed action.
        masks |= ~masks.any(-1, keepdims=True)
        return self._model.predict(observations["belief"], action_masks=masks, deterministic=True)[0]


def main() -> None:
    """Train in some embedded scenes, and compare with random gaze and the agent's own policy in others."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=8, help="training scenes, and as many test scenes (default: 8)")
    parser.add_argument("--steps", type=int, default=30_000, help="gaze shifts to learn from (default: 30,000)")
    parser.add_argument("--grid", type=int, nargs=2, default=(10, 10), help="columns and rows (default: 10 10)")
    parser.add_argument("--shifts", type=int, default=30, help="most gaze shifts in a search (default: 30)")
    parser.add_argument("--cache", help="folder for stored looks (default: the user's cache)")
    arguments = parser.parse_args()
    columns, rows = arguments.grid
    common: dict[str, Any] = {
        "count": arguments.scenes,
        "grid": (columns, rows),
        "shifts": arguments.shifts,
        "cache": arguments.cache,
    }
    training, test = (
        open_scenery("search", **common, seed=seed, starts=starts) for seed, starts in ((0, 100), (1000, 10))
    )
    together = GazeVectorEnv("search", 32, training, belief=True, detections=False, autoreset_mode="SameStep")
    envs = StableVecEnv(together, key="belief")
    envs.seed(0)
    model = MaskablePPO(
        CellPolicy,
        envs,
        learning_rate=1e-3,
        n_steps=32,
        batch_size=256,
        n_epochs=4,
        gamma=0.95,
        seed=0,
        device="cpu",
    )
    model.learn(arguments.steps)

    judged = GazeVectorEnv("search", 64, test, belief=True, autoreset_mode="Disabled")
    episodes = [episode for scene in test.scenes for episode in test.episodes(scene)]
    agents: dict[str, Agent] = {
        "random": MaskedRandom(0),
        "hand-made": PolicyAgent(judged),
        "trained": TrainedAgent(model),
    }
    for name, agent in agents.items():
        shifts = np.array([each.found_at for each in run_agent(judged, agent, episodes)])
        shares = ", ".join(f"{100 * ((shifts > 0) & (shifts <= n)).mean():.0f} % within {n}" for n in (1, 3, 10))
        print(f"{name}: of {len(shifts)} targets in other scenes, gaze shifts find {shares}")


if __name__ == "__main__":
    main()
