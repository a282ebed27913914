"""Milliseconds of one decision of searchers from the literature, by size of the grid: `python -m benchmarks.searchers`.

A decision is made for one episode from a given belief over 81 classes. It evaluates every cell and takes the best cell
not visited yet. The table also gives how often the choice is the same as that of the ideal observer, over random
beliefs.
"""

import argparse
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.beliefs import CLASSES, make_belief, unvisited
from benchmarks.images import use_threads
from benchmarks.machine import describe
from benchmarks.tables import RESULTS, spread, table, write
from benchmarks.timing import Run, Spread, clock_for, interleaved
from semfov import FovealObservationModel, Grid, acquisition, policies
from semfov.gaze import select_fixation

TARGET, MODEL = 5, "yolox-nano-published"
POLICIES = {
    "maximum a posteriori": "non-predictive",
    "entropy limit": "entropy-limit",
    "ideal observer": "ideal-observer",
}


def searchers(side: int) -> dict[str, acquisition.AcquisitionFunction]:
    """All searchers on a grid of `side` × `side` cells."""
    model = FovealObservationModel.from_pretrained(MODEL).requires_grad_(False)
    means, grid = policies.Means(model), Grid(side, side, (640, 480))
    return {name: policies.named_policy(policy, "search", means)(TARGET, grid) for name, policy in POLICIES.items()}


def choices(value: acquisition.AcquisitionFunction, cells: int, episodes: int) -> Tensor:
    """The cells that a searcher would fixate next, for random beliefs."""
    belief = make_belief(cells, CLASSES, episodes)
    return value(belief, unvisited(belief)).argmax(-1)


def decide(value: acquisition.AcquisitionFunction, cells: int) -> Run:
    """A program that makes one decision."""
    belief = make_belief(cells)
    visited, noise = unvisited(belief), torch.rand(1, cells, generator=torch.Generator().manual_seed(0))
    return lambda: select_fixation(value(belief, visited), visited, noise)


@torch.inference_mode()
def main() -> None:
    """Measure all rows and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.searchers", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--sides", type=int, nargs="+", default=[5, 7, 10], help="numbers of rows (and columns) of grids"
    )
    parser.add_argument("--episodes", type=int, default=150, help="number of beliefs for which choices are compared")
    parser.add_argument("--seconds", type=float, default=10.0, help="shortest duration for each grid")
    parser.add_argument("--threads", type=int, default=1, help="number of threads")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result files")
    options = parser.parse_args()
    use_threads(options.threads)
    clock, times = clock_for(options.threads)
    about = describe() | {"times": times, "observation model": MODEL}
    rows, figures = [], {}
    for side in options.sides:
        every = searchers(side)
        durations = interleaved({name: decide(value, side**2) for name, value in every.items()}, options.seconds, clock)
        best = choices(every["ideal observer"], side**2, options.episodes)
        for name, value in every.items():
            milliseconds = Spread.of(durations[name])
            same = float((choices(value, side**2, options.episodes) == best).double().mean())
            rows.append([f"{side} x {side}", name, spread(milliseconds), f"{100 * same:.0f} %"])
            figures[f"{name}, {side} x {side}"] = asdict(milliseconds) | {"same_choice": same}
    head = ["grid", "searcher", "ms a decision", "same choice as the ideal observer"]
    text = "\n".join(
        [
            "# Searchers from the literature",
            "",
            "Written by `python -m benchmarks.searchers`. Medians (quartiles) for one episode and a given belief. The",
            f"same choice: share of {options.episodes} random beliefs, before the first look.",
            "",
            *(f"- {key}: {value}" for key, value in about.items()),
            "",
            table(head, rows),
            "",
        ]
    )
    print(text)
    write(options.out, "searchers", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
