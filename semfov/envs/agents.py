"""Agents without training for the environments, and how to run an agent on given episodes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray
from torch import Tensor

from semfov.envs.cells import CellGazes
from semfov.envs.environment import GazeEnv, ZoomEnv
from semfov.envs.vector import GazeVectorEnv
from semfov.envs.windows import action_of
from semfov.errors import InputError, check
from semfov.gaze.choice import Greedy, drawn_from
from semfov.runs.search_protocol import Trial
from semfov.zoom.glances import overview
from semfov.zoom.policy import best_find, best_hit

_Cells = NDArray[np.int64]


class Agent(Protocol):
    """Anything that chooses cells `(B,)` from the observations and infos of B episodes."""

    def __call__(self, observations: Any, infos: dict[str, Any]) -> _Cells:
        """Choose the next cell of every episode."""


class PolicyAgent:
    """A policy of semfov as an agent: the one whose belief the environment keeps (`policy` of `open_scenery`).

    It breaks ties by the random numbers that `eval.search` and `eval.explore` use for the same episode, so it makes the
    same fixations. It reads the belief from the environment, and ignores observations and infos.

    Args:
        env: a `GazeEnv` or a `GazeVectorEnv`, wrapped or not.

    Raises:
        InputError: the environment is of another kind.

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
        self._gazes: CellGazes = inner.gazes
        self._noise: dict[int, tuple[Any, Tensor]] = {}

    @torch.inference_mode()
    def __call__(self, observations: Any = None, infos: Any = None) -> Any:
        """Choose the next cell, or those of all episodes `(num_envs,)` in a `GazeVectorEnv`."""
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
        grid, candidate = scenery.grid(scene), scenery.candidate(scene)
        targets = gazes.targets[rows]
        acquisition = candidate.acquisition(targets if bool(targets.any()) else None, grid, gazes.cell[rows])
        visited = gazes.memory.visited[rows]
        values = acquisition(gazes.belief[rows], visited)
        # The n-th gaze shift uses the n-th random numbers. An episode that is over may have used all of them.
        noise = torch.stack([self._noise_of(row)[min(int(gazes.shift[row]), scenery.shifts)] for row in rows.tolist()])
        return Greedy(drawn_from(noise[:, None]))(0, torch.arange(len(rows)), values, visited, grid.centres)[1]

    def _noise_of(self, row: int) -> Tensor:
        episode = self._gazes.episodes[row]
        if row not in self._noise or self._noise[row][0] is not episode:
            self._noise[row] = episode, self._gazes.scenery.noise(episode)
        return self._noise[row][1]


class ZoomPolicyAgent:
    """The choice of windows of `semfov.zoom` as an agent.

    Args:
        env: a `ZoomEnv`, wrapped or not.

    Raises:
        InputError: the environment is of another kind.

    Example::

        env = gymnasium.make("semfov.envs:semfov/GazeSearch-v0", action="window")
        agent = ZoomPolicyAgent(env)
        observation, info = env.reset(seed=0)
        observation, reward, terminated, truncated, info = env.step(agent(observation, info))
    """

    def __init__(self, env: Any) -> None:
        inner = env.unwrapped
        if not isinstance(inner, ZoomEnv):
            raise InputError(f"env: expected a ZoomEnv, got {type(inner).__name__}")
        self._gaze = inner.gazes

    def __call__(self, observation: Any = None, info: Any = None) -> NDArray[np.float32]:
        """Choose the next action; the whole picture again where no other window is expected to show anything."""
        gaze, belief = self._gaze, self._gaze.belief
        searching = gaze.task == "search"
        choice = best_hit(belief, gaze.done) if searching else best_find(belief, gaze.done, belief.foresight)
        return action_of(gaze.glances.lattice, overview(gaze.glances.lattice) if choice is None else choice[0])


class MaskedRandom:
    """Choose any cell that was not fixated, by the action mask of the infos.

    Args:
        seed: of the generator.

    >>> agent = MaskedRandom(seed=0)
    >>> int(agent(None, {"action_mask": np.array([0, 1, 0], dtype=np.int8)}))
    1
    """

    def __init__(self, seed: int = 0) -> None:
        self._random = np.random.default_rng(seed)

    def __call__(self, observations: Any, infos: dict[str, Any]) -> Any:
        """Choose the next cell, or those of all episodes."""
        free = np.asarray(infos["action_mask"], dtype=bool)
        return np.int64(self._draw(free)) if free.ndim == 1 else np.array([self._draw(one) for one in free])

    def _draw(self, free: NDArray[np.bool_]) -> int:
        # Where all cells were fixated, choose any of them.
        return int(self._random.choice(np.flatnonzero(free) if free.any() else len(free)))


@dataclass(frozen=True)
class Ran:
    """The result of an episode.

    Attributes:
        cells: fixated cells in order.
        found_at: the gaze shift that found the target, or -1.
        results: result of the task after each look: in a search, 1 once the gaze is on the target; in an exploration,
            the success rate of the map.

    >>> Ran(cells=(0, 12), found_at=1, results=(0.0, 1.0)).found_at
    1
    """

    cells: tuple[int, ...]
    found_at: int
    results: tuple[float, ...]


def run_agent(envs: Any, agent: Agent, episodes: Sequence[Any]) -> list[Ran]:
    """Run an agent on given episodes of the protocol, as many at a time as there are environments.

    Args:
        envs: a `GazeVectorEnv` whose finished episodes wait for a reset (`autoreset_mode="Disabled"`), wrapped or not.
        agent: chooses the cells.
        episodes: episodes of `Scenery.episodes`.

    Returns:
        The result of each episode, in their order.

    Raises:
        InputError: `envs` is of another kind, or restarts episodes by itself.

    Example::

        scenery = open_scenery("search", count=2)
        envs = GazeVectorEnv("search", 8, scenery, autoreset_mode="Disabled")
        results = run_agent(envs, PolicyAgent(envs), scenery.episodes(0)[:16])
        print(sum(result.found_at for result in results) / len(results), "gaze shifts")
    """
    inner = envs.unwrapped
    check(isinstance(inner, GazeVectorEnv), "envs", "a GazeVectorEnv", type(inner).__name__)
    mode = inner.metadata["autoreset_mode"]
    check(mode == AutoresetMode.DISABLED, "envs", "autoreset_mode='Disabled'", mode.value)
    ran: list[Ran] = []
    for first in range(0, len(episodes), envs.num_envs):
        part = list(episodes[first : first + envs.num_envs])
        # The last part is filled up with copies of its last episode.
        ran += _run(envs, agent, part + part[-1:] * (envs.num_envs - len(part)))[: len(part)]
    return ran


def _run(envs: Any, agent: Agent, episodes: list[Any]) -> list[Ran]:
    observations, infos = envs.reset(options={"episodes": episodes})
    cells, results = [[episode.start] for episode in episodes], [[float(r)] for r in infos["result"]]
    found_at, going = [-1] * len(episodes), np.ones(len(episodes), dtype=bool)
    while going.any():
        actions = np.asarray(agent(observations, infos))
        observations, _, terminated, truncated, infos = envs.step(actions)
        for row in np.flatnonzero(going):
            cells[row].append(int(actions[row]))
            results[row].append(float(infos["result"][row]))
            if terminated[row] and isinstance(episodes[row], Trial):
                found_at[row] = len(cells[row]) - 1
        going &= ~(terminated | truncated)
    return [Ran(tuple(path), at, tuple(each)) for path, at, each in zip(cells, found_at, results, strict=True)]
