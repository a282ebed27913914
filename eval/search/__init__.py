"""Visual search: `python -m eval.search` finds objects in photographs by moving a fovea.

Without arguments it searches the embedded scenes, which need no data set. With a COCO-format data set:

    python -m eval.search --data.root val2017 --data.annotations instances_val2017.json --out runs/val
    python -m eval.search --config configs/paper_search.yaml --data.root ... --data.annotations ...
    python -m eval.search --models mymodels --data.root ... --data.annotations ...   # a folder of semfov fit

To continue a stopped run, give the same command again.
"""

from eval.comparison.model_folder import with_models
from eval.search.report import search_report
from eval.search.run import SearchConfig, SearchRun
from semfov.runs.command import command
from semfov.runs.scene_run import finish


def search(config: SearchConfig, *, pictures: bool = True) -> None:
    """Run a search experiment and write its tables and records, and with `pictures` its figures and its page."""
    run = SearchRun(with_models(config))
    finish(run, "searching")
    search_report(run, pictures=pictures)


main = command(search, SearchConfig, __doc__)
