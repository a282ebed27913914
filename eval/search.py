"""Visual search: `python -m eval.search` finds objects in photographs by moving a fovea.

Without arguments it searches the embedded scenes, which need no data set. With a COCO-format data set:

    python -m eval.search --data.root val2017 --data.annotations instances_val2017.json --out runs/val
    python -m eval.search --config configs/paper_search.yaml --data.root ... --data.annotations ...
    python -m eval.search --models mymodels --data.root ... --data.annotations ...   # a folder of train.fit_detector

To continue a stopped run, give the same command again.
"""

import sys
from collections.abc import Sequence

from semfov.experiments.command import run_command
from semfov.experiments.config import SearchConfig
from semfov.experiments.fitted import with_models
from semfov.experiments.parallel import rank
from semfov.experiments.runs import SearchRun
from semfov.experiments.scene_run import finish
from semfov.experiments.search_report import report


def search(config: SearchConfig) -> None:
    """Run a visual search experiment and write its tables, figures and records."""
    run = SearchRun(with_models(config))
    finish(run, "searching")
    if rank() == 0:
        report(run)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(search, SearchConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
