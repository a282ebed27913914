"""Steps per second of the environments: `python -m benchmarks.environments`.

Episodes run in embedded scenes with stored detections, on 10 x 10 cells. Each step fixates a random cell that was not
fixated before, and every episode that ends is followed by another; the time of restarts is included. For comparison,
an agent makes the same number of steps and runs the detector in each.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.typing import NDArray

import semfov
from benchmarks.tables import begin, command, number, page, table, write
from benchmarks.timing import Run, Spread, interleaved
from semfov.envs import GazeExplore, GazeSearch, GazeVectorEnv, open_scenery
from semfov.envs.scenery import Scenery
from semfov.gaze.acquisition.base import Task

STEPS = 20
WORLDS: dict[str, tuple[Task, str, tuple[int, int]]] = {
    "search, recommended": ("search", "recommended", (64, 256)),
    "search, Kaplan's rule": ("search", "non-predictive-raw", (64, 256)),
    "exploration, recommended": ("exploration", "recommended", (8, 32)),
    "exploration, Kaplan's rule": ("exploration", "kl-raw", (64, 256)),
}
"""Beliefs of the environments: task, policy, and numbers of episodes that run side by side."""
TEXT = """\
Written by `python -m benchmarks.environments`. Steps per second in {} embedded scenes, on 10 x 10 cells: median and
quartiles over repetitions. The detections from every cell were stored before. Episodes that end are followed by others;
the time of their first looks is included, without counting as a step. `one that looks itself`: an agent that runs
YOLOv3-tiny in every step."""


def steps(envs: Any, seed: int) -> Run:
    """Make a program that makes `STEPS` steps of several environments side by side."""
    random = np.random.default_rng(seed)
    state: dict[str, Any] = {"infos": envs.reset(seed=seed)[1]}

    def run() -> None:
        for _ in range(STEPS):
            state["infos"] = envs.step(any_free(random, state["infos"]["action_mask"]))[4]

    return run


def any_free(random: np.random.Generator, masks: NDArray[np.int8]) -> NDArray[np.int64]:
    """For each row, a random cell that was not fixated before."""
    chosen: NDArray[np.int64] = (random.random(masks.shape, dtype=np.float32) * masks).argmax(-1)
    return chosen


def alone(env: GazeSearch | GazeExplore, seed: int) -> Run:
    """Make a program that makes `STEPS` steps of one environment."""
    random = np.random.default_rng(seed)
    state: dict[str, Any] = {"info": env.reset(seed=seed)[1]}

    def run() -> None:
        for _ in range(STEPS):
            action = any_free(random, state["info"]["action_mask"][None])[0]
            _, _, terminated, truncated, state["info"] = env.step(action)
            if terminated or truncated:
                state["info"] = env.reset()[1]

    return run


def looking(task: str, scenery: Scenery) -> Run:
    """Make a program in which the recommended agent makes as many looks with the detector."""
    agent = semfov.ActivePerception.recommended()
    image = scenery.image(0)
    if task == "search":
        # No probability passes these thresholds, so the search does not end early.
        return lambda: agent.search(image, "person", start=0, shifts=STEPS - 1, confirm=1.0, stop_below=0.0)
    return lambda: agent.explore(image, start=0, shifts=STEPS - 1, min_gain=0.0)


def programs(task: str, scenery: Scenery, sizes: Sequence[int]) -> dict[str, tuple[Run, int]]:
    """All programs, each with its number of episodes side by side."""
    kind = GazeSearch if task == "search" else GazeExplore
    # Restart in the same step, so that the time of restarts is included and every step counts.
    restarts = AutoresetMode.SAME_STEP
    wide: Callable[..., Any] = partial(GazeVectorEnv, task, scenery=scenery, autoreset_mode=restarts)
    every: dict[str, tuple[Run, int]] = {
        "one, `gymnasium.make`": (alone(kind(scenery), 0), 1),
        f"{sizes[0]}, one after another (`SyncVectorEnv`)": (
            steps(SyncVectorEnv([lambda: kind(scenery)] * sizes[0], autoreset_mode=restarts), 0),
            sizes[0],
        ),
    }
    for size in sizes:
        every[f"{size}, `gymnasium.make_vec`"] = steps(wide(size), 0), size
    every[f"{sizes[-1]}, with the belief shown, no detections"] = (
        steps(wide(sizes[-1], belief=True, detections=False), 0),
        sizes[-1],
    )
    return every


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all rows and write the table."""
    parser = command("benchmarks.environments", __doc__, seconds=6.0)
    parser.add_argument("--scenes", type=int, default=8, help="number of embedded scenes")
    parser.add_argument("--only", choices=list(WORLDS), nargs="+", default=list(WORLDS), help="beliefs to measure")
    parser.add_argument("--cache", type=Path, help="folder of the stored detections from every cell")
    options = parser.parse_args(arguments)
    clock, about = begin(options)
    rows, figures = [], {}
    for name in options.only:
        task, policy, sizes = WORLDS[name]
        scenery = open_scenery(task, count=options.scenes, policy=policy, cache=options.cache)
        for scene in scenery.scenes:
            scenery.open(scene)
        todo = programs(task, scenery, sizes)
        if policy == "recommended":
            todo["one that looks itself"] = looking(task, scenery), 1
        durations = interleaved({program: run for program, (run, _) in todo.items()}, options.seconds, clock)
        for program, (_, size) in todo.items():
            rates = Spread.of([1e3 * STEPS * size / each for each in durations[program]])
            rows.append([name, program, *(number(value) for value in (rates.middle, rates.low, rates.high))])
            figures[f"{name}: {program}"] = asdict(rates)
            print(" | ".join(rows[-1]), flush=True)
    head = ["belief", "episodes side by side", "steps a second", "lower quartile", "upper quartile"]
    text = page("Environments", TEXT.format(options.scenes), about, table(head, rows))
    write(options.out, "environments", text, {"machine": about, "steps_per_second": figures})


if __name__ == "__main__":
    main()
