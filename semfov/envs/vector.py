"""Many episodes side by side for `gymnasium.make_vec`, with cells as actions."""

import copy
from collections.abc import Collection, Mapping, Sequence
from typing import get_args

import numpy as np
import torch
from gymnasium.utils import EzPickle, seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray
from torch import Tensor

from semfov.envs.cells import CellGazes
from semfov.envs.gazes import Arrays, GazeSettings, check_options_of_reset
from semfov.envs.scenery import Scenery, open_scenery, scenery_or_open
from semfov.envs.state import EnvState, check_state
from semfov.errors import InputError, check, check_whole, former_keywords, lookup
from semfov.gaze.acquisition.base import Task

_KIND = "GazeVectorEnv"


class GazeVectorEnv(VectorEnv[Arrays, NDArray[np.int64], NDArray[np.generic]], EzPickle):
    """Many episodes side by side, each in a scene of its own; a step of all is one step of the batched loop.

    With seed s, environment i does the same as a `GazeEnv` with seed s + i.

    Invariant: `_terminated` and `_truncated` `(num_envs,)` say how each episode has ended. Both are false while it goes
    on, that is from its start to the step that ends it. `_randoms` has a generator for each environment.

    Args:
        task: `search` or `exploration`.
        num_envs: number of episodes.
        scenery: scenes, looks and belief, which several environments may share; None opens one.
        look_cost: cost of a look, subtracted from the reward; None takes the default of the task.
        find: reward for finding the target, or for a complete map.
        belief: whether observations contain the belief.
        glimpse: side in pixels of the foveated image that observations contain; None leaves it out.
        detections: whether infos contain the detections.
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

    @former_keywords
    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        scenery: Scenery | None = None,
        *,
        look_cost: float | None = None,
        find: float = 1.0,
        belief: bool = False,
        glimpse: int | None = None,
        detections: bool = True,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: object,
    ) -> None:
        check_whole(num_envs, "num_envs", 1, 1_000_000)
        mode_name = autoreset_mode.value if isinstance(autoreset_mode, AutoresetMode) else str(autoreset_mode)
        mode = AutoresetMode(lookup(mode_name, [mode.value for mode in AutoresetMode], "autoreset_mode"))
        self.metadata = {"render_modes": [], "autoreset_mode": mode}
        self.num_envs = num_envs
        self.task: Task = lookup(task, get_args(Task), "task")
        self.scenery = scenery_or_open(scenery, open_scenery, options, self.task)
        # A copy is a new environment of the same settings and scenes, which begins with a reset.
        EzPickle.__init__(
            self,
            task,
            num_envs,
            self.scenery,
            look_cost=look_cost,
            find=find,
            belief=belief,
            glimpse=glimpse,
            detections=detections,
            autoreset_mode=mode,
        )
        settings = GazeSettings(look_cost, find, belief, glimpse)
        self.gazes = CellGazes(self.scenery, self.task, settings, num_envs)
        self.single_observation_space = self.gazes.observation_space
        self.single_action_space = self.gazes.action_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._detections = detections
        self._rows = torch.arange(num_envs)
        self._terminated = torch.zeros(num_envs, dtype=torch.bool)
        self._truncated = torch.zeros(num_envs, dtype=torch.bool)
        self._randoms: list[np.random.Generator] = [seeding.np_random()[0] for _ in range(num_envs)]

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, object] | None = None
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
        self._seed(seed)
        check_options_of_reset(options)
        common_options = dict(options or {})
        rows = self._rows_of(common_options.pop("reset_mask", None))
        episodes = common_options.pop("episodes", None)
        if episodes is None:
            self._start(rows, common_options)
        else:
            check(not common_options, "options", "no other ones beside episodes", ", ".join(common_options))
            self._start_given(rows, episodes)
        return self._observed()

    def _seed(self, seed: int | Sequence[int | None] | None) -> None:
        """Seed the generators of the environments; None, also for one of them, continues the present generator."""
        if seed is None:
            return
        if isinstance(seed, int | np.integer):
            seeds: list[int | None] = [int(seed) + row for row in range(self.num_envs)]
        else:
            seeds = list(seed)
        check(len(seeds) == self.num_envs, "seed", f"{self.num_envs} seeds, one for each environment", len(seeds))
        for row, row_seed in enumerate(seeds):
            if row_seed is not None:
                self._randoms[row] = seeding.np_random(row_seed)[0]

    def _rows_of(self, mask: object) -> Tensor:
        """List the environments that a mask selects, `(n,)`; None selects all."""
        if mask is None:
            return self._rows
        flags = np.asarray(mask)
        # Like Gymnasium, which refuses a mask that selects none.
        is_mask = flags.shape == (self.num_envs,) and flags.dtype == np.bool_
        expected = f"{self.num_envs} booleans, one for each environment, at least one of them true"
        check(is_mask and bool(flags.any()), "reset_mask", expected, repr(mask))
        return torch.from_numpy(np.flatnonzero(flags))

    def _start(self, rows: Tensor, options: Mapping[str, object]) -> None:
        """Start episodes in the rows `(n,)`, each drawn by the generator of its environment."""
        if len(rows):
            self.gazes.start(rows, [self._randoms[row] for row in rows.tolist()], options)
            self._mark_started(rows)

    def _start_given(self, rows: Tensor, episodes: object) -> None:
        """Start given episodes in the rows `(n,)`, after a check that there are n."""
        expected = f"{len(rows)} episodes, one for each environment that is reset"
        if not isinstance(episodes, Collection):
            raise InputError(f"episodes: expected {expected}, got {episodes!r}")
        check(len(episodes) == len(rows), "episodes", expected, len(episodes))
        # Nothing is drawn where the episode is given, so that any generator will do.
        self.gazes.begin(rows, [self.gazes.choose(self._randoms[0], {"episode": episode}) for episode in episodes])
        self._mark_started(rows)

    def _mark_started(self, rows: Tensor) -> None:
        self._terminated[rows] = False
        self._truncated[rows] = False

    def step(
        self, actions: NDArray[np.int64]
    ) -> tuple[Arrays, NDArray[np.float64], NDArray[np.bool_], NDArray[np.bool_], Arrays]:
        """Move the gaze of every episode, and look.

        Args:
            actions: `(num_envs,)`, cells.

        Returns:
            Observations, rewards, terminated, truncated and infos, each for all environments. What a finished episode
            does depends on `autoreset_mode`.

        Raises:
            InputError: the actions are not `num_envs` cells, or no episode was started.
        """
        cells = self._checked(actions)
        if not self.gazes.episodes:
            raise InputError("step: expected episodes in progress, got none; call reset first")
        mode = self.metadata["autoreset_mode"]
        over = self._terminated | self._truncated  # (num_envs,), before this step
        # The action for an episode that is over means nothing.
        reward = self._move((~over).nonzero()[:, 0], cells)
        if mode == AutoresetMode.NEXT_STEP:
            self._start(over.nonzero()[:, 0], {})
        # What this step has ended, before a reset in the same step.
        terminated = self._terminated.numpy().copy()
        truncated = self._truncated.numpy().copy()
        final: Arrays = {}
        if mode == AutoresetMode.SAME_STEP:
            ended = (self._terminated | self._truncated).nonzero()[:, 0]
            if len(ended):
                final = self._final(ended)
                self._start(ended, {})
        observations, infos = self._observed()
        return observations, reward, terminated, truncated, infos | final

    def save_state(self) -> EnvState:
        """Save all episodes in progress, and the random numbers to come (`GazeEnv.save_state`).

        Returns:
            The state, which later steps leave as it is.

        Raises:
            InputError: no episode was started.
        """
        over = (self._terminated.clone(), self._truncated.clone())
        randoms = tuple(copy.deepcopy(self._randoms))
        return EnvState(_KIND, self.scenery, self.task, self.gazes.save(), randoms, over)

    def restore(self, state: EnvState) -> None:
        """Go back to a saved state; all that follows is the same, bit by bit.

        Args:
            state: a state of this environment, or of one with the same scenery, task and number of episodes, also
                where the state was pickled in another process.

        Raises:
            InputError: it is the state of another environment.
        """
        check_state(state, _KIND, self.scenery, self.task, self.num_envs)
        self.gazes.check_saved(state.gazes)
        self.gazes.restore(state.gazes)
        self._randoms = copy.deepcopy(list(state.randoms))
        terminated, truncated = state.over
        self._terminated = terminated.clone()
        self._truncated = truncated.clone()

    def _checked(self, actions: NDArray[np.int64]) -> Tensor:
        """Check that actions are a cell for each environment, `(num_envs,)`."""
        cells = np.asarray(actions)
        expected = f"{self.num_envs} cells from 0 to {int(self.gazes.action_space.n) - 1}"
        check(self.action_space.contains(cells), "actions", expected, repr(actions))
        return torch.as_tensor(cells, dtype=torch.int64)

    def _move(self, rows: Tensor, cells: Tensor) -> NDArray[np.float64]:
        """Move the gaze of the episodes that go on, in the rows `(n,)`, to their `cells` `(num_envs,)`.

        Returns:
            `(num_envs,)`, the rewards; 0 for all other episodes.
        """
        reward = torch.zeros(self.num_envs, dtype=torch.float64)
        if len(rows):
            outcome = self.gazes.move(rows, cells[rows])
            reward[rows] = outcome.reward
            self._terminated[rows] = outcome.terminated
            self._truncated[rows] = outcome.truncated
        return reward.numpy()

    def _final(self, rows: Tensor) -> Arrays:
        """Take the last observations and infos of episodes that end in the rows `(n,)`.

        Gymnasium keeps them among the infos where a reset follows in the same step.
        """
        observations = self.gazes.observe(rows)  # (n, ...) each
        final_observations = np.full(self.num_envs, None, dtype=object)
        is_final = np.zeros(self.num_envs, dtype=bool)
        for number, row in enumerate(rows.tolist()):
            final_observations[row] = {name: values[number] for name, values in observations.items()}
            is_final[row] = True
        infos = self.gazes.infos(self._rows, detections=self._detections)
        return _masked({"final_obs": final_observations, "final_info": infos}, is_final)

    def action_masks(self) -> NDArray[np.bool_]:
        """Mask of the cells that were not fixated.

        Returns:
            `(num_envs, X·Y)`, boolean.
        """
        return self.gazes.mask(self._rows)

    def _observed(self) -> tuple[Arrays, Arrays]:
        """Take the observations and infos of the last looks."""
        infos = self.gazes.infos(self._rows, detections=self._detections)
        return self.gazes.observe(self._rows), _masked(infos, np.ones(self.num_envs, dtype=bool))


def _masked(infos: Arrays, mask: NDArray[np.bool_]) -> Arrays:
    """Add to each info the mask of the environments that it applies to, under its name after an underscore."""
    masked: Arrays = {}
    for name, info in infos.items():
        masked[name] = _masked(info, mask) if isinstance(info, dict) else info
        masked[f"_{name}"] = mask.copy()
    return masked
