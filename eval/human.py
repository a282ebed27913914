"""Beside people: how soon models find what people search for, and how well they tell where people look.

Visual search: files of scanpaths, floors, and our policies on those of the pictures that are at hand:

    python -m eval.human search --people human_scanpaths --files "[elm.json, nnIBS.json]" --pictures "[val2017]"

Free viewing: exploration policies, saliency, centre bias and random gaze, held against people fixation by fixation:

    python -m eval.human viewing --people fixations.json --data.root images --detector.name yolox-nano

A run that was stopped goes on where it was when the same command is given again.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any

from semfov.experiments.command import run_command
from semfov.experiments.parallel import rank
from semfov.experiments.run import finish
from semfov.experiments.searching.compare import compare
from semfov.experiments.searching.config import PeopleSearchConfig
from semfov.experiments.viewing.config import ViewingConfig
from semfov.experiments.viewing.report import report
from semfov.experiments.viewing.run import ViewingRun
from semfov.experiments.viewing.scores import halves, score_all
from semfov.experiments.viewing.sequences import score_sequences


def viewing(config: ViewingConfig) -> None:
    """Hold policies against people who view pictures freely."""
    run = ViewingRun(config)
    finish(run, "following people")
    if rank() == 0:
        fitted, reported = halves(run)
        scored = score_all(run, fitted, reported)
        report(run, scored, score_sequences(scored, reported), reported)


JOBS: dict[str, tuple[Callable[[Any], None], type[Any]]] = {
    "search": (compare, PeopleSearchConfig),
    "viewing": (viewing, ViewingConfig),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] not in JOBS:
        print(__doc__)
        print(f"expected {' or '.join(JOBS)}, and `--help` after it for its settings", file=sys.stderr)
        return 0 if given in (["--help"], ["-h"]) else 2
    job, config = JOBS[given[0]]
    return run_command(job, config, __doc__, given[1:])


if __name__ == "__main__":
    sys.exit(main())
