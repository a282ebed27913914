"""Measure semfov and other implementations (peers) in one run: `python -m benchmarks`.

Results are ratios of the times of two programs within one repetition, as median and quartiles over repetitions. With
one thread, the default, times are CPU times, which other work on the machine changes little. With more threads, times
are elapsed times. Results go to `benchmarks/results/NAME.md` and `NAME.json`.
"""

import argparse
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.beliefs import exploration, kaplan_update, predictive_search
from benchmarks.fits import dirichlets
from benchmarks.growth import grow
from benchmarks.images import use_threads
from benchmarks.interleave import in_turn
from benchmarks.limits import Path as HotPath
from benchmarks.limits import limits
from benchmarks.machine import copy_bandwidth, describe
from benchmarks.rollouts import rollouts
from benchmarks.saliency import saliency
from benchmarks.sensor import foveation
from benchmarks.tables import RESULTS, comparison_rows, number, spread, table, write
from benchmarks.timing import Comparison, Measured, Spread, clock_for, measure

COMPARISONS: tuple[Callable[[], Comparison], ...] = (
    lambda: foveation("opencv", reuse=False),
    lambda: foveation("opencv", reuse=True),
    lambda: foveation("kornia", reuse=False),
    lambda: foveation("kornia", reuse=True),
    dirichlets,
    kaplan_update,
    predictive_search,
    lambda: exploration("KL divergence"),
    lambda: exploration("negative entropy"),
    lambda: saliency("VOCUS2"),
    lambda: saliency("Itti-Koch"),
    in_turn,
    rollouts,
)


@torch.inference_mode()
def main() -> None:
    """Measure everything and write the tables."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("--name", default="cpu", help="name of the result files")
    parser.add_argument("--seconds", type=float, default=4.0, help="shortest duration of each comparison")
    parser.add_argument("--threads", type=int, default=1, help="number of threads")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result files")
    options = parser.parse_args()
    use_threads(options.threads)
    clock, times = clock_for(options.threads)
    about = describe() | {"times": times}
    bandwidth = copy_bandwidth(min(options.seconds, 1.0), clock)
    measured = []
    for make in COMPARISONS:
        measured.append(measure(make(), options.seconds, clock))
        for row in comparison_rows(measured[-1]):
            print(" | ".join(row), flush=True)
    grown, paths = grow(options.seconds / 2, clock), limits(bandwidth, options.seconds / 2, clock)
    text = report(about, bandwidth, measured, grown, paths)
    figures = {
        "machine": about,
        "copy_bandwidth": bandwidth,
        "comparisons": [asdict(each) for each in measured],
        "growth": {
            name: {"ms": {size: asdict(s) for size, s in sizes.items()}, "slope": slope}
            for name, (sizes, slope) in grown.items()
        },
        "limits": {
            name: {"bytes": path.bytes, "ms": asdict(ms), "share_of_bandwidth": share}
            for name, (path, ms, share) in paths.items()
        },
    }
    write(options.out, options.name, text, figures)


def report(
    about: dict[str, str],
    bandwidth: float,
    measured: list[Measured],
    grown: dict[str, tuple[dict[int, Spread], float]],
    paths: dict[str, tuple[HotPath, Spread, float]],
) -> str:
    """The report with all tables, as Markdown."""
    rows = [row for each in measured for row in comparison_rows(each)]
    growth = [
        [name, ", ".join(f"{size:,}: {number(s.middle)}" for size, s in sizes.items()), f"{slope:.2f}"]
        for name, (sizes, slope) in grown.items()
    ]
    hot = [
        [name, f"{path.bytes / 1e6:.2f}", path.what, spread(ms), f"{100 * share:.1f}"]
        for name, (path, ms, share) in paths.items()
    ]
    slowest = min(paths, key=lambda name: paths[name][2])
    return "\n".join(
        [
            "# Benchmarks",
            "",
            "Written by `python -m benchmarks`. Ratios of times are taken within one repetition and given as median",
            "(quartiles); above 1, semfov is faster. Where the whole work would take a peer too long, it does a part",
            "of the work, and its time is scaled up.",
            "",
            *(f"- {key}: {value}" for key, value in about.items()),
            f"- copy bandwidth: {bandwidth / 1e9:.1f} GB/s, read and written",
            "",
            "## Comparison with peers",
            "",
            table(["work", "peer", "semfov, ms", "peer, ms", "peer / semfov"], rows),
            "",
            "## Growth",
            "",
            "Milliseconds by size of the problem, and the exponent of growth between the first and the last size.",
            "",
            table(["series", "size: ms", "exponent"], growth),
            "",
            "## Distance from the limit of memory bandwidth",
            "",
            "The bytes of inputs and results, each moved once, divided by the time, as a share of the copy bandwidth.",
            "",
            table(["path", "MB", "bytes of", "ms", "% of copy bandwidth"], hot),
            "",
            "What keeps each path from reaching the copy bandwidth:",
            "",
            *(
                f"- {name}{' (the slowest)' if name == slowest else ''}: {path.stops}"
                for name, (path, *_) in paths.items()
            ),
            "",
        ]
    )


if __name__ == "__main__":
    main()
