"""Train an agent by reinforcement learning: Stable-Baselines3's PPO in the environment `semfov/GazeSearch-v0`.

The agent observes the belief alone: the probability of the target in every cell, the cells that it has fixated, and the
position of its gaze. A small convolutional network computes a logit for every cell. The reward is 1 for finding the
target, minus a price for every look; that probable cells are good choices, the agent has to learn.

It needs Stable-Baselines3: pip install "semfov[agents]"

Run it from a checkout: python -m examples.train_agent
"""

import argparse
from collections.abc import Callable, Sequence
from itertools import chain
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
        arguments: positional arguments of `MaskableActorCriticPolicy`.
        options: keyword arguments of `MaskableActorCriticPolicy`.
    """

    def __init__(self, *arguments: Any, **options: Any) -> None:
        options["features_extractor_class"] = CellFeatures
        options["share_features_extractor"] = False
        options["net_arch"] = {"pi": [], "vf": [64]}
        super().__init__(*arguments, **options)

    def _build(self, lr_schedule: Any) -> None:
        super()._build(lr_schedule)
        self.action_net = nn.Identity()
        options: dict[str, Any] = {"lr": lr_schedule(1), **self.optimizer_kwargs}
        self.optimizer = self.optimizer_class(self.parameters(), **options)


def belief_only(scenery: Scenery) -> gymnasium.Env[Any, Any]:
    """Make an environment whose observation is the belief alone."""
    env = GazeSearch(scenery, belief=True)
    return gymnasium.wrappers.TransformObservation(
        env, lambda planes: planes["belief"], env.observation_space["belief"]
    )


def gaze_shifts(env: gymnasium.Env[Any, Any], agent: Agent, episodes: Sequence[Any]) -> list[int]:
    """Return the gaze shift that finds the target of each episode, or 0."""
    found = []
    for episode in episodes:
        belief, info = env.reset(options={"episode": episode})
        terminated = truncated = False
        while not (terminated or truncated):
            cell = agent(belief, info["action_mask"].astype(bool))
            belief, _, terminated, truncated, info = env.step(cell)
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
    training = open_scenery("search", **common, seed=0, starts=100)
    test = open_scenery("search", **common, seed=1000, starts=10)
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
    env = belief_only(test)
    episodes = list(chain.from_iterable(map(test.episodes, test.scenes)))
    for name, agent in agents.items():
        shifts = np.array(gaze_shifts(env, agent, episodes))
        shares = []
        for most in (1, 3, 10):
            is_found = (shifts > 0) & (shifts <= most)
            shares.append(f"{100 * is_found.mean():.0f} % within {most}")
        print(f"{name}: of {len(shifts)} targets in other scenes, gaze shifts find {', '.join(shares)}")


if __name__ == "__main__":
    main()
