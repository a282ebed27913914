"""Vectorised environments: many episodes on the batched loop."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from semfov.envs.cells import CellGazes
from semfov.envs.environment import PRICES, check_dictionary, scenery_or_open
from semfov.envs.gazes import Arrays
from semfov.envs.scenery import Scenery, open_scenery
from semfov.errors import check, check_whole, lookup


class GazeVectorEnv(VectorEnv[Arrays, NDArray[np.int64], NDArray[Any]], EzPickle):
    """Many episodes side by side, each in a scene of its own; a step of all is one step of the batched loop.

    With seed s, environment i does the same as a `GazeEnv` with seed s + i. With `together`, the default, learned
    beliefs of all episodes are computed at once. This is faster, but the rounding then depends on the batch.

    Args:
        task: `search` or `exploration`.
        num_envs: number of episodes.
        scenery: scenes, looks and belief, which several environments may share; None opens one.
        price: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete map.
        belief: whether observations contain the belief.
        glimpse: side in pixels of the foveated image that observations contain; None leaves it out.
        detections: whether infos contain the detections.
        together: whether learned beliefs of all episodes are computed at once.
        autoreset_mode: when finished episodes restart: in the next step (`NextStep`, Gymnasium's default), in the same
            step (`SameStep`), or when a reset names them (`Disabled`).
        options: options of `open_scenery`, where no scenery is given.

    Raises:
        InputError: an argument is out of range, or both a scenery and options are given.
        DataError: the scenes or the weights of the detector cannot be read.

    Example::

        envs = GazeVectorEnv("search", 64, count=8, belief=True)
        observations, infos = envs.reset(seed=0)
        print(observations["belief"].shape)  # (64, 3, 10, 10)
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        scenery: Scenery | None = None,
        *,
        price: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        detections: bool = True,
        together: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        check_whole(num_envs, "num_envs", 1, 1_000_000)
        known, name = [mode.value for mode in AutoresetMode], getattr(autoreset_mode, "value", autoreset_mode)
        mode = AutoresetMode(lookup(str(name), known, "autoreset_mode"))
        self.metadata = {"render_modes": [], "autoreset_mode": mode}
        self.num_envs, self.task = num_envs, lookup(task, PRICES, "task")
        self.scenery = scenery_or_open(scenery, open_scenery, options, task)
        # A copy is a new environment of the same settings and scenes, which begins with a reset.
        rewards: dict[str, Any] = {"price": price, "find": find, "belief": belief, "glimpse": glimpse}
        modes = {"detections": detections, "together": together, "autoreset_mode": mode}
        EzPickle.__init__(self, task, num_envs, self.scenery, **rewards, **modes)
        self.gazes = CellGazes(
            self.scenery,
            task,
            num_envs,
            price=PRICES[task] if price is None else price,
            find=find,
            belief=belief,
            glimpse=glimpse,
            together=together,
        )
        self.single_observation_space = self.gazes.observation_space
        self.single_action_space = self.gazes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._detections = detections
        self._rows = torch.arange(num_envs)
        # Whether each episode was terminated, and whether it was truncated, in an earlier step.
        self._ended = torch.zeros(2, num_envs, dtype=torch.bool)
        self._randoms: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Arrays, Arrays]:
        """Start an episode in every environment, or in some of them.

        Args:
            seed: s, for the seeds s, s + 1, … of the environments; or one seed for each environment.
            options: `reset_mask`, a boolean for each environment, to reset only some; `episodes`, an episode of the
                protocol (`Scenery.episodes`) for each environment that is reset; or the options of `GazeEnv.reset`.

        Returns:
            The observations and infos of all environments. Each info has a mask of the environments that it applies to,
            as in Gymnasium.

        Raises:
            InputError: there are too few or too many seeds or episodes, or an option is unknown.
        """
        if seed is not None:
            seeds = (
                [int(seed) + row for row in range(self.num_envs)] if isinstance(seed, int | np.integer) else list(seed)
            )
            check(len(seeds) == self.num_envs, "seed", f"{self.num_envs} seeds, one for each environment", len(seeds))
            for row, one in enumerate(seeds):
                if one is not None:
                    self._randoms[row] = seeding.np_random(one)[0]
        check_dictionary(options)
        remaining = dict(options or {})
        mask = remaining.pop("reset_mask", None)
        if mask is not None:
            flags = np.asarray(mask)
            fits = flags.shape == (self.num_envs,) and flags.dtype == np.bool_ and flags.any()
            expected = f"{self.num_envs} booleans, one for each environment, at least one of them true"
            check(bool(fits), "reset_mask", expected, repr(mask))
        rows = self._rows if mask is None else torch.from_numpy(np.flatnonzero(mask))
        episodes = remaining.pop("episodes", None)
        if episodes is None:
            episodes = [self.gazes.choose(self._randoms[row], remaining) for row in rows.tolist()]
        expected = f"{len(rows)} episodes, one for each environment that is reset"
        check(len(episodes) == len(rows), "episodes", expected, len(episodes))
        episodes = [self.gazes.choose(self._randoms[0], {"episode": each}) for each in episodes]
        self.gazes.begin(rows, episodes)
        self._ended[:, rows] = False
        return self._observed()

    def step(self, actions: NDArray[np.int64]) -> tuple[Arrays, NDArray[Any], NDArray[Any], NDArray[Any], Arrays]:
        """Move the gaze of every episode, and look.

        Args:
            actions: `(num_envs,)`, cells.

        Returns:
            Observations, rewards, terminated, truncated and infos, each for all environments. What a finished episode
            does depends on `autoreset_mode`.

        Raises:
            InputError: the actions are not `num_envs` cells.
        """
        cells = int(self.gazes.action_space.n)
        inside = self.action_space.contains(np.asarray(actions))
        check(inside, "actions", f"{self.num_envs} cells from 0 to {cells - 1}", repr(actions))
        chosen = torch.as_tensor(np.asarray(actions), dtype=torch.int64)
        mode, over = self.metadata["autoreset_mode"], self._ended.any(0)
        reward, last = torch.zeros(self.num_envs, dtype=torch.float64), {}
        going, resting = (~over).nonzero()[:, 0], over.nonzero()[:, 0]
        if len(going):
            score = self.gazes.move(going, chosen[going])
            reward[going], self._ended[:, going] = score.reward, torch.stack([score.terminated, score.truncated])
        if mode == AutoresetMode.NEXT_STEP:
            self._restart(resting)
            self._ended[:, resting] = False
        terminated, truncated = self._ended.numpy().copy()
        if mode == AutoresetMode.SAME_STEP:
            ended = self._ended.any(0).nonzero()[:, 0]
            if len(ended):
                last = self._last(ended)
                self._restart(ended)
                self._ended[:] = False
        observation, info = self._observed()
        return observation, reward.numpy(), terminated, truncated, info | last

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated.

        Returns:
            `(num_envs, X·Y)`, boolean.
        """
        return self.gazes.mask(self._rows)

    def _restart(self, rows: Tensor) -> None:
        if len(rows):
            self.gazes.begin(rows, [self.gazes.choose(self._randoms[row], {}) for row in rows.tolist()])

    def _last(self, rows: Tensor) -> Arrays:
        """Last observations and infos of finished episodes, which Gymnasium keeps where a reset follows at once."""
        ended = np.zeros(self.num_envs, dtype=bool)
        ended[rows.numpy()] = True
        observations = self.gazes.observe(rows)
        each = np.full(self.num_envs, None, dtype=object)
        for number, row in enumerate(rows.tolist()):
            each[row] = {name: value[number] for name, value in observations.items()}
        infos = self.gazes.infos(self._rows, detections=self._detections)
        return {
            "final_obs": each,
            "_final_obs": ended,
            "final_info": _marked(infos, ended),
            "_final_info": ended.copy(),
        }

    def _observed(self) -> tuple[Arrays, Arrays]:
        infos = self.gazes.infos(self._rows, detections=self._detections)
        return self.gazes.observe(self._rows), _marked(infos, np.ones(self.num_envs, dtype=bool))


def _marked(infos: Arrays, which: NDArray[np.bool_]) -> Arrays:
    """Infos, each with a mask of the environments that it applies to."""
    marked: Arrays = {}
    for name, value in infos.items():
        marked[name] = _marked(value, which) if isinstance(value, dict) else value
        marked[f"_{name}"] = which.copy()
    return marked
