"""Compare models with people: how soon they find the same targets, and how well they predict where people look.

Visual search: models from files of scanpaths, random baselines, and semfov's policies on the available pictures:

    python -m eval.human search --people human_scanpaths --files "[elm.json, nnIBS.json]" --pictures "[val2017]"

Free viewing: densities of fixations from saliency, from the feature maps of detectors and from other people, with and
without a centre bias and oculomotor biases, on folds of the pictures that they were fitted without:

    python -m eval.human viewing --fixations "[osie/fixations.json]" --pictures "[osie/images]"

Pictures unlike those of the fit: how well the gaze model tells pages, charts and drawings from photographs:

    python -m eval.human unlike --fitted "[osie/images, crowd/images]" --others photographs

One view of each picture beside six, on held-out pictures:

    python -m eval.human quality --fixations "[osie/fixations.json]" --pictures "[osie/images]"

To continue a stopped run, give the same command again.
"""

import sys
from collections.abc import Callable, Sequence
from typing import Any

from eval.human.quality import QualityConfig, compare_qualities
from eval.human.search.compare import compare
from eval.human.search.run import PeopleSearchConfig
from eval.human.unlike import UnlikeConfig, tell_apart
from eval.human.viewing import ViewingConfig, compare_viewing
from semfov.runs.command import run_command

JOBS: dict[str, tuple[Callable[[Any], None], type[Any]]] = {
    "search": (compare, PeopleSearchConfig),
    "viewing": (compare_viewing, ViewingConfig),
    "unlike": (tell_apart, UnlikeConfig),
    "quality": (compare_qualities, QualityConfig),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    if not command_line or command_line[0] not in JOBS:
        print(__doc__)
        print("`python -m eval.human JOB --help` lists the settings of search, viewing, unlike or quality.")
        if command_line in (["--help"], ["-h"]):
            return 0
        got = repr(command_line[0]) if command_line else "nothing"
        print(f"expected {' or '.join(JOBS)} as the first argument, got {got}", file=sys.stderr)
        return 2
    job, config = JOBS[command_line[0]]
    return run_command(job, config, __doc__, command_line[1:], program=f"python -m eval.human {command_line[0]}")
