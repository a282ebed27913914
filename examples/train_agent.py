"""Train an agent by reinforcement learning: Stable-Baselines3's PPO in the environment `semfov/GazeSearch-v0`.

The agent observes the belief alone: the probability of the target in every cell, the cells that it has fixated, and the
position of its gaze. A small convolutional network computes a logit for every cell. The reward is 1 for finding the
target, minus a price for every look; that probable cells are good choices, the agent has to learn.

It needs Stable-Baselines3: pip install "semfov[agents]"

Run it from a checkout: python -m examples.train_agent
"""

import argparse
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.policies import MaskableActorCriticPolicy
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import DummyVecEnv
from torch import Tensor, nn

from semfov.envs import GazeSearch, open_scenery
from semfov.envs.scenery import Scenery

Agent = Callable[[Any, Any], Any]
"""Chooses a cell from the planes `(C, Y, X)` of the belief and the mask `(X·Y,)` of the free cells."""


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


def belief_only(scenery: Scenery) -> gymnasium.Env[Any, Any]:
    """Make an environment whose observation is the belief alone."""
    env = GazeSearch(scenery, belief=True)
    return gymnasium.wrappers.TransformObservation(env, lambda each: each["belief"], env.observation_space["belief"])


def gaze_shifts(env: gymnasium.Env[Any, Any], agent: Agent, episodes: Sequence[Any]) -> list[int]:
    """Return the gaze shift that finds the target of each episode, or 0."""
    found = []
    for episode in episodes:
        belief, info = env.reset(options={"episode": episode})
        terminated = truncated = False
        while not (terminated or truncated):
            belief, _, terminated, truncated, info = env.step(agent(belief, info["action_mask"].astype(bool)))
        found.append(int(terminated) * (info["passes"] - 1))
    return found


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
    envs = DummyVecEnv([lambda: belief_only(training)] * 32)
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

    random = np.random.default_rng(0)
    agents: dict[str, Agent] = {
        "random": lambda belief, free: random.choice(np.flatnonzero(free)),
        "hand-made": lambda belief, free: belief[0].argmax(),
        "trained": lambda belief, free: int(model.predict(belief, action_masks=free, deterministic=True)[0]),
    }
    env, episodes = belief_only(test), [episode for scene in test.scenes for episode in test.episodes(scene)]
    for name, agent in agents.items():
        shifts = np.array(gaze_shifts(env, agent, episodes))
        shares = ", ".join(f"{100 * ((shifts > 0) & (shifts <= n)).mean():.0f} % within {n}" for n in (1, 3, 10))
        print(f"{name}: of {len(shifts)} targets in other scenes, gaze shifts find {shares}")


if __name__ == "__main__":
    main()
