"""Milliseconds of one decision of the field's searchers, by the size of the grid: `python -m benchmarks.searchers`.

A decision begins with a belief of 81 classes that is there, for one episode. It values every cell and takes the best
that was not visited. Beside each time stands how often the choice is that of the ideal observer, over beliefs drawn at
random.
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
    """All searchers on a grid of so many rows and columns."""
    model = FovealObservationModel.from_pretrained(MODEL).requires_grad_(False)
    means, grid = policies.Means(model), Grid(side, side, (640, 480))
    return {name: policies.named_policy(policy, "search", means)(TARGET, grid) for name, policy in POLICIES.items()}


def choices(value: acquisition.AcquisitionFunction, cells: int, episodes: int) -> Tensor:
    """Cells that a searcher would fixate next."""
    belief = make_belief(cells, CLASSES, episodes)
    return value(belief, unvisited(belief)).argmax(-1)


def decide(value: acquisition.AcquisitionFunction, cells: int) -> Run:
    """One decision."""
    belief = make_belief(cells)
    visited, noise = unvisited(belief), torch.rand(1, cells, generator=torch.Generator().manual_seed(0))
    return lambda: select_fixation(value(belief, visited), visited, noise)


@torch.inference_mode()
def main() -> None:
    """Measure all rows and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.searchers", description=__doc__.splitlines()[0])
    parser.add_argument("--sides", type=int, nargs="+", default=[5, 7, 10], help="rows and columns of the grids")
    parser.add_argument("--episodes", type=int, default=20, help="beliefs over which choices are compared")
    parser.add_argument("--seconds", type=float, default=10.0, help="for each grid, at least")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS)
    options = parser.parse_args()
    use_threads(options.threads)
    clock, times = clock_for(options.threads)
    about = describe() | {"times": times, "observation model": MODEL}
    rows, figures = [], {}
    for side in options.sides:
        every = searchers(side)
        found = interleaved({name: decide(value, side**2) for name, value in every.items()}, options.seconds, clock)
        best = choices(every["ideal observer"], side**2, options.episodes)
        for name, value in every.items():
            milliseconds = Spread.of(found[name])
            same = float((choices(value, side**2, options.episodes) == best).double().mean())
            rows.append([f"{side} x {side}", name, spread(milliseconds), f"{100 * same:.0f} %"])
            figures[f"{name}, {side} x {side}"] = asdict(milliseconds) | {"same_choice": same}
    head = ["grid", "searcher", "ms a decision", "same choice as the ideal observer"]
    text = "\n".join(
        [
            "# The field's searchers",
            "",
            "Written by `python -m benchmarks.searchers`. Medians (quartiles); one episode, a belief that is there.",
            f"The same choice: of {options.episodes} beliefs drawn at random, before the first look.",
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
