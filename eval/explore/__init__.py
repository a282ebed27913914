"""Scene exploration: `python -m eval.explore` learns what is where in photographs by moving a fovea.

Without arguments it explores the embedded scenes, which need no data set. With a COCO-format data set:

    python -m eval.explore --data.root val2017 --data.annotations instances_val2017.json --out runs/explore_val

Detections from every cell are stored and shared with `python -m eval.search`. To continue a stopped run, give the same
command again.
"""

from eval.comparison.model_folder import with_models
from eval.explore.report import exploration_report
from eval.explore.run import ExploreConfig, ExploreRun
from semfov.runs.command import command
from semfov.runs.scene_run import finish


def explore(config: ExploreConfig, *, pictures: bool = True) -> None:
    """Run an exploration experiment and write its tables and records, and with `pictures` its figures and its page."""
    run = ExploreRun(with_models(config))
    finish(run, "exploring")
    exploration_report(run, pictures=pictures)


main = command(explore, ExploreConfig, __doc__)
