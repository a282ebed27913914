"""Time to fit 81 x 8 Dirichlets of 81 dimensions, relative to the PyPI package `dirichlet`, in one run.

The data are samples of random Dirichlets that resemble detectors' scores. semfov fits all 648 at once, from their mean
logarithms (as `FovealObservationModel.fit` does) and from the samples themselves. The package fits one after the other
from samples, by each of its methods. Because that takes long, every repetition times the package on a few of them, next
to a run of semfov on all. Ratios compare times per Dirichlet within one repetition. Values are medians over
repetitions, with quartiles. The largest relative difference of the parameters is over the same few Dirichlets; the
package stops when the log likelihood changes by less than 1e-7, whatever the change of the parameters.

python -m benchmarks.dirichlet_mle
"""

import argparse
import statistics
import time
from collections.abc import Callable

import dirichlet as pypi
import numpy as np
import torch
from torch import Tensor

from semfov.observation.dirichlet import floor, mle

CLASSES, LEVELS, COMPONENTS = 81, 8, 81


def draw(samples: int, seed: int) -> Tensor:
    """Score vectors drawn from random Dirichlets, `(648, samples, 81)`, with values floored at 1e-6."""
    rng = np.random.default_rng(seed)
    alpha = np.exp(rng.normal(-1.0, 1.0, (CLASSES * LEVELS, COMPONENTS)))
    scores = np.stack([rng.dirichlet(row, samples) for row in alpha])
    return floor(torch.from_numpy(scores), 1e-6)


def milliseconds(run: Callable[[], object]) -> float:
    """Elapsed milliseconds of one run."""
    start = time.perf_counter()
    run()
    return 1e3 * (time.perf_counter() - start)


def spread(values: list[float], digits: int = 1) -> str:
    """Median and quartiles, as text."""
    low, middle, high = statistics.quantiles(values, n=4)
    return f"{middle:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--samples", type=int, default=100, help="number of samples of each Dirichlet")
    parser.add_argument("--repetitions", type=int, default=15, help="number of repetitions")
    parser.add_argument("--few", type=int, default=4, help="number of Dirichlets that the package fits per repetition")
    parser.add_argument("--threads", type=int, default=2, help="number of threads")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)

    scores = draw(arguments.samples, seed=0)
    mean_log = scores.log().mean(1)
    count = len(scores)
    ours: dict[str, Callable[[], Tensor]] = {
        "newton, from mean logs": lambda: mle(mean_log),
        "newton, from samples": lambda: mle(scores.log().mean(1)),
        "fixed_point, from mean logs": lambda: mle(mean_log, method="fixed_point"),
        "gradient, from mean logs": lambda: mle(mean_log, method="gradient"),
    }
    methods = ("meanprecision", "fixedpoint")
    times: dict[str, list[float]] = {name: [] for name in [*ours, *methods]}
    difference = dict.fromkeys(methods, 0.0)
    fitted = mle(mean_log)
    for run in ours.values():
        run()
    for repetition in range(arguments.repetitions):
        for name, run in ours.items():
            times[name].append(milliseconds(run) / count)
        rows = [(repetition * arguments.few + i) % count for i in range(arguments.few)]
        few = [scores[row].numpy() for row in rows]
        for name in methods:
            start = time.perf_counter()
            found = [pypi.mle(sample, method=name) for sample in few]
            times[name].append((time.perf_counter() - start) * 1000 / arguments.few)
            for row, alpha in zip(rows, found, strict=True):
                reference = fitted[row].numpy()
                difference[name] = max(difference[name], float(np.abs(alpha / reference - 1).max()))

    size = f"{count} Dirichlets of {COMPONENTS} dimensions, {arguments.samples} samples each"
    print(f"{size}, {arguments.threads} threads")
    print(f"\n{'semfov':30}{'ms for all':>26}" + "".join(f"{'times ' + name:>32}" for name in methods))
    for name in ours:
        all_of_them = [count * value for value in times[name]]
        ratios = [[theirs / mine for theirs, mine in zip(times[m], times[name], strict=True)] for m in methods]
        print(f"{name:30}{spread(all_of_them):>26}" + "".join(f"{spread(r, 0):>32}" for r in ratios))
    print(f"\n{'dirichlet ' + pypi_version():30}{'ms for one':>26}{'largest difference':>32}")
    for name in methods:
        print(f"{name:30}{spread(times[name]):>26}{difference[name]:>32.1e}")


def pypi_version() -> str:
    """Version of the package `dirichlet`."""
    from importlib.metadata import version

    return version("dirichlet")


if __name__ == "__main__":
    main()
