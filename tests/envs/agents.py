"""Agents for the tests of the environments: any free cell at random, and the policies by which the evaluation looks."""

from dataclasses import dataclass, field

import numpy as np
import torch

from semfov.envs import EpisodeEnv, GazeVectorEnv
from semfov.envs.windows import _action_of
from semfov.gaze.choice import Greedy, drawn_from
from semfov.runs.protocols import Trial
from semfov.runs.seeds import noise_for
from semfov.zoom.looks import Window
from semfov.zoom.policy import best_find


class MaskedRandom:
    """Any cell that was not fixated, by the action mask of the infos."""

    def __init__(self, seed=0):
        self.random = np.random.default_rng(seed)

    def __call__(self, info):
        cells = [self.random.choice(np.flatnonzero(free) if free.any() else free.size)
                 for free in np.atleast_2d(info["action_mask"])]  # fmt: skip
        return np.array(cells) if info["action_mask"].ndim > 1 else cells[0]


class PolicyAgent:
    """The policy whose belief an environment keeps; ties are broken by the random numbers of the evaluation."""

    def __init__(self, env):
        self.gazes, self.one = env.unwrapped.gazes, isinstance(env.unwrapped, EpisodeEnv)

    @torch.inference_mode()
    def __call__(self, info):
        cells = [int(self.choose(torch.tensor([row]))) for row in range(len(self.gazes.episodes))]
        return cells[0] if self.one else np.array(cells)

    def choose(self, row):
        """The next cell of the episode in a row, by its own scene and target."""
        gazes, scenery, episode = self.gazes, self.gazes.scenery, self.gazes.episodes[int(row)]
        grid, policy = scenery.grid(episode.scene), scenery._looking.strategies[scenery.policy].policy
        targets = gazes.targets[row] if isinstance(episode, Trial) else None
        visited = gazes.memory.visited[row]
        values = policy(targets, grid)(gazes.memory.belief[row], visited)
        target = episode.target if isinstance(episode, Trial) else None
        scene = scenery.pictures.ids[episode.scene]
        noise = noise_for(scenery.protocol, len(grid), scene, target, episode.repetition)
        # The n-th gaze shift uses the n-th random numbers. An episode that is over may have used all of them.
        noise = noise[min(int(gazes.shift[row]), scenery.shifts)]
        return Greedy(drawn_from(noise[None, None]))(0, torch.tensor([0]), values, visited, grid.centres)[1]


class WindowAgent:
    """The choice of windows of `semfov.zoom`; the whole picture where no window is expected to show anything."""

    def __init__(self, env):
        self.gaze = env.gazes

    def __call__(self):
        gaze, belief, lattice = self.gaze, self.gaze.looking.session.belief, self.gaze.source.lattice
        choice = best_find(belief, gaze.done, belief.foresight)
        return _action_of(lattice, Window.overview(lattice) if choice is None else choice[0])


@dataclass
class Ran:
    """An episode that has run: its cells, the shift that found the target or -1, and the result after each look."""

    cells: list[int]
    results: list[float]
    found_at: int = -1
    over: bool = field(default=False, repr=False)


def run_agent(envs: GazeVectorEnv, agent, episodes):
    """The results of episodes, as many at a time as there are environments, which do not restart by themselves."""
    done = []
    for first in range(0, len(episodes), envs.num_envs):
        part = episodes[first : first + envs.num_envs]
        # The last part is filled up with copies of its last episode.
        part = part + part[-1:] * (envs.num_envs - len(part))
        _, infos = envs.reset(options={"episodes": part})
        ran = [Ran([each.start], [float(result)]) for each, result in zip(part, infos["result"], strict=True)]
        while not all(each.over for each in ran):
            actions = agent(infos)
            _, _, terminated, truncated, infos = envs.step(actions)
            for row, each in enumerate(ran):
                if each.over:
                    continue
                each.cells.append(int(actions[row]))
                each.results.append(float(infos["result"][row]))
                each.over = bool(terminated[row] or truncated[row])
                if terminated[row] and isinstance(part[row], Trial):
                    each.found_at = len(each.cells) - 1
        done += ran[: len(episodes) - first]
    return done
