"""Hand-made agents for the environments, and what comes of an agent's episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from semfov.envs.environment import GazeEnv
from semfov.envs.gazes import Gazes
from semfov.envs.vector import GazeVectorEnv
from semfov.errors import InputError, check
from semfov.experiments.search_protocol import Episode
from semfov.gaze.choice import Greedy, drawn_from

Cells = NDArray[np.int64]


class Agent(Protocol):
    """What acts in an environment: cells `(B,)` from its observations and infos."""

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Cells:
        """The next cell of every episode."""


class PolicyAgent:
    """A policy of semfov's as an agent: the one whose belief the environment keeps (`open_scenery`, `policy`).

    It breaks ties by the numbers that `eval.search` and `eval.explore` give the same episode, so that it makes the same
    fixations. It reads the belief from the environment, and of observations and infos nothing.

    Args:
        env: a `GazeEnv` or a `GazeVectorEnv`, wrapped or not.

    Example::

        env = gymnasium.make("semfov.envs:semfov/GazeSearch-v0", policy="predictive-calibrated")
        agent = PolicyAgent(env)
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(agent(observation, info))
    """

    def __init__(self, env: Any) -> None:
        inner = env.unwrapped
        if not isinstance(inner, GazeEnv | GazeVectorEnv):
            raise InputError(f"env: expected a GazeEnv or a GazeVectorEnv, got {type(inner).__name__}")
        self._one = isinstance(inner, GazeEnv)
        self._gazes: Gazes = inner.gazes
        self._noise: dict[int, tuple[Any, Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, observations: Any = None, infos: Any = None) -> Any:
        """The next cell, or that of every episode `(num_envs,)`."""
        gazes = self._gazes
        groups: dict[int, list[int]] = {}
        for row, episode in enumerate(gazes.episodes):
            groups.setdefault(episode.scene, []).append(row)
        cells = torch.zeros(len(gazes.episodes), dtype=torch.int64)
        for scene, members in groups.items():
            cells[members] = self._choose(scene, torch.tensor(members))
        return np.int64(cells[0]) if self._one else cells.numpy()

    def _choose(self, scene: int, rows: Tensor) -> Tensor:
        gazes, scenery = self._gazes, self._gazes.scenery
        grid, candidate = scenery.grid(scene), scenery.run.candidate(scenery.policy, scene)
        targets = gazes.targets[rows]
        acquisition = candidate.acquisition(targets if bool(targets.any()) else None, grid, gazes.cell[rows])
        visited = gazes.memory.visited[rows]
        values = acquisition(gazes.belief[rows], visited)
        # Ties of the n-th shift are broken by the n-th numbers; an episode that is over may have none left.
        noise = torch.stack([self._noise_of(row)[min(int(gazes.shift[row]), scenery.shifts)] for row in rows.tolist()])
        return Greedy(drawn_from(noise[:, None]))(0, torch.arange(len(rows)), values, visited, grid.centres)[1]

    def _noise_of(self, row: int) -> Tensor:
        episode = self._gazes.episodes[row]
        if row not in self._noise or self._noise[row][0] is not episode:
            self._noise[row] = episode, self._gazes.scenery.noise(episode)
        return self._noise[row][1]


class MaskedRandom:
    """Any cell that was not fixated, as the action mask has it.

    Args:
        seed: of the draws.
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Any:
        """The next cell, or that of every episode."""
        free = np.asarray(infos["action_mask"], dtype=bool)
        return np.int64(self._draw(free)) if free.ndim == 1 else np.array([self._draw(one) for one in free])

    def _draw(self, free: NDArray[np.bool_]) -> int:
        # Where all cells were fixated, any will do.
        return int(self._random.choice(np.flatnonzero(free) if free.any() else len(free)))


@dataclass(frozen=True)
class Ran:
    """What came of an episode.

    Attributes:
        cells: fixated, in order.
        found_at: the gaze shift that found the target, or -1.
        results: how far the task was done after each look: 1 where a search is on its target, or the map's success.
    """

    cells: tuple[int, ...]
    found_at: int
    results: tuple[float, ...]


def run_agent(envs: Any, agent: Agent, episodes: Sequence[Any]) -> list[Ran]:
    """Let an agent do episodes of the protocol, as many at a time as there are environments.

    Args:
        envs: a `GazeVectorEnv` whose episodes rest when they are over (`autoreset_mode="Disabled"`), wrapped or not.
        agent: what acts.
        episodes: of `Scenery.episodes`.
    """
    inner = envs.unwrapped
    check(isinstance(inner, GazeVectorEnv), "envs", "a GazeVectorEnv", type(inner).__name__)
    mode = inner.metadata["autoreset_mode"]
    check(mode == AutoresetMode.DISABLED, "envs", "autoreset_mode='Disabled'", mode.value)
    ran: list[Ran] = []
    for first in range(0, len(episodes), envs.num_envs):
        part = list(episodes[first : first + envs.num_envs])
        # The last part is filled up with one of its episodes.
        ran += _run(envs, agent, part + part[-1:] * (envs.num_envs - len(part)))[: len(part)]
    return ran


def _run(envs: Any, agent: Agent, episodes: list[Any]) -> list[Ran]:
    observations, infos = envs.reset(options={"episodes": episodes})
    cells, results = [[episode.start] for episode in episodes], [[float(r)] for r in infos["result"]]
    found, going = [-1] * len(episodes), np.ones(len(episodes), dtype=bool)
    while going.any():
        actions = np.asarray(agent(observations, infos))
        observations, _, terminated, truncated, infos = envs.step(actions)
        for row in np.flatnonzero(going):
            cells[row].append(int(actions[row]))
            results[row].append(float(infos["result"][row]))
            if terminated[row] and isinstance(episodes[row], Episode):
                found[row] = len(cells[row]) - 1
        going &= ~(terminated | truncated)
    return [Ran(tuple(path), at, tuple(each)) for path, at, each in zip(cells, found, results, strict=True)]
