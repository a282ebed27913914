"""Command line of the fuzzer."""

import argparse
import sys
import time
import traceback
from collections import Counter

import torch

from benchmarks.fuzz import TARGETS
from benchmarks.fuzz.runner import run

CLASSES = {"result": "right", "missing": "right", "InputError": "refused by name", "DataError": "refused by name"}
"""Classes of outcomes by the values that targets return; anything else is a finding."""


def main() -> None:
    """Run the targets, and print the table of outcomes."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.fuzz", description="pass bad input to semfov; a finding is printed with its input"
    )
    parser.add_argument("targets", nargs="*", metavar="TARGET", help=f"any of {', '.join(TARGETS)} (default: all)")
    parser.add_argument("--cases", type=int, default=1000, help="number of inputs for each target")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the inputs")
    options = parser.parse_args()
    for name in options.targets:
        if name not in TARGETS:
            parser.error(f"unknown target {name!r}; known: {', '.join(TARGETS)}")
    torch.set_num_threads(1)
    print("| target | cases | right | refused by name | else | s |\n|---|---|---|---|---|---|", flush=True)
    total: Counter[str] = Counter()
    for name in options.targets or TARGETS:
        start = time.perf_counter()
        outcomes = Counter({CLASSES[kind]: 0 for kind in CLASSES})
        try:
            for kind, count in run(TARGETS[name], options.cases, options.seed).items():
                outcomes[CLASSES[kind]] += count
        except Exception:
            traceback.print_exc()
            outcomes["else"] += 1
        seconds = time.perf_counter() - start
        total += outcomes
        cells = [sum(outcomes.values()), *(outcomes[kind] for kind in ("right", "refused by name", "else"))]
        print(f"| {name} | {' | '.join(map(str, cells))} | {seconds:.0f} |", flush=True)
    counts = ", ".join(f"{total[kind]} {kind}" for kind in ("right", "refused by name", "else"))
    print(f"\n{sum(total.values())} cases: {counts}")
    sys.exit(1 if total["else"] else 0)


if __name__ == "__main__":
    main()
