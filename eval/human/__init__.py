"""Compare models with people: how soon they find the same targets, and how well they predict where people look.

Visual search: models from files of scanpaths, random baselines, and semfov's policies on the available pictures:

    python -m eval.human search --people human_scanpaths --files "[elm.json, nnIBS.json]" --pictures "[val2017]"

Free viewing: exploration policies, saliency, centre bias and random gaze, compared with people fixation by fixation:

    python -m eval.human viewing --people fixations.json --data.root images --detector.name yolox-nano

Habits: a noisy choice by a policy's value, a centre bias, saccade length and return, fitted one after another to half
of the people in half of the pictures, and evaluated on the others; the folder `out` gets the model and a report:

    python -m eval.human habits --root images --fixations fixations.json --out runs/habits

To continue a stopped run, give the same command again.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any

from eval.human.habits.fit import HabitsConfig, fit_habits
from eval.human.search.compare import compare
from eval.human.search.run import PeopleSearchConfig
from eval.human.viewing.report import viewing_report
from eval.human.viewing.rows import halves, score_all
from eval.human.viewing.run import ViewingConfig, ViewingRun
from eval.human.viewing.sequences import score_sequences
from semfov.runs.command import run_command
from semfov.runs.scene_run import finish


def viewing(config: ViewingConfig) -> None:
    """Compare policies with people who view pictures freely."""
    run = ViewingRun(config)
    finish(run, "following people")
    fitted, reported = halves(run)
    scored = score_all(run, fitted, reported)
    viewing_report(run, scored, score_sequences(scored, reported), reported)


JOBS: dict[str, tuple[Callable[[Any], None], type[Any]]] = {
    "search": (compare, PeopleSearchConfig),
    "viewing": (viewing, ViewingConfig),
    "habits": (fit_habits, HabitsConfig),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    if not command_line or command_line[0] not in JOBS:
        print(__doc__)
        got = repr(command_line[0]) if command_line else "nothing"
        print(
            f"expected {' or '.join(JOBS)} as the first argument, got {got}; add --help to see its settings",
            file=sys.stderr,
        )
        return 0 if command_line in (["--help"], ["-h"]) else 2
    job, config = JOBS[command_line[0]]
    return run_command(job, config, __doc__, command_line[1:])
