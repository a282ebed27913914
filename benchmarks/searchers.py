"""Milliseconds of one decision of searchers from the literature, by size of the grid: `python -m benchmarks.searchers`.

A decision is made for one episode from a given belief over 81 classes. It evaluates every cell and takes the best cell
not visited yet. The table also gives how often the choice is the same as that of the ideal observer, over random
beliefs.
"""

from dataclasses import asdict

import torch
from torch import Tensor

from benchmarks.beliefs import CLASSES, make_belief, unvisited
from benchmarks.tables import begin, command, page, spread, table, write
from benchmarks.timing import Run, Spread, interleaved
from semfov import FovealObservationModel, Grid, acquisition, policies
from semfov.gaze import select_fixation

TARGET, MODEL = 5, "yolox-nano-published"
POLICIES = {
    "maximum a posteriori": "non-predictive",
    "entropy limit": "entropy-limit",
    "ideal observer": "ideal-observer",
}
TEXT = """\
Written by `python -m benchmarks.searchers`. Medians (quartiles) for one episode and a given belief. The same choice:
share of {} random beliefs, before the first look."""


def searchers(side: int) -> dict[str, acquisition.AcquisitionFunction]:
    """All searchers on a grid of `side` × `side` cells."""
    model = FovealObservationModel.from_pretrained(MODEL).requires_grad_(False)
    grid = Grid(side, side, (640, 480))
    return {name: policies.Policy(policy, model)(TARGET, grid) for name, policy in POLICIES.items()}


def choices(value: acquisition.AcquisitionFunction, cells: int, episodes: int) -> Tensor:
    """Compute the cells that a searcher would fixate next, for random beliefs."""
    belief = make_belief(cells, CLASSES, episodes)
    return value(belief, unvisited(belief)).argmax(-1)


def decide(value: acquisition.AcquisitionFunction, cells: int) -> Run:
    """Make a program that makes one decision."""
    belief = make_belief(cells)
    visited, noise = unvisited(belief), torch.rand(1, cells, generator=torch.Generator().manual_seed(0))
    return lambda: select_fixation(value(belief, visited), visited, noise)


@torch.inference_mode()
def main() -> None:
    """Measure all rows and write the table."""
    parser = command("benchmarks.searchers", __doc__, seconds=10.0)
    parser.add_argument("--sides", type=int, nargs="+", default=[5, 7, 10], help="rows (and columns) of the grids")
    parser.add_argument("--episodes", type=int, default=150, help="number of beliefs for which choices are compared")
    options = parser.parse_args()
    clock, about = begin(options)
    about["observation model"] = MODEL
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
    text = page("Searchers from the literature", TEXT.format(options.episodes), about, table(head, rows))
    print(text)
    write(options.out, "searchers", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
