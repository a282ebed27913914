"""Regenerate the tables of docs/results.md and docs/tables.md: `python -m eval.results` runs the experiments.

    python -m eval.results --root val2017 --annotations instances_val2017.json --yolox yolox_nano.onnx
        --fit_root fit --fit_annotations instances_fit.json

Results are measured on the photographs listed in configs/results_photographs.txt; settings are chosen on the
photographs of the fit set. In the pages a table stands between the comments `<!-- table NAME -->` or
`<!-- table EXPERIMENT NAME -->` and `<!-- end -->`; the command replaces what is between them, and leaves the text
unchanged. Detections are computed once and shared by all experiments. To continue a stopped run, give the same command
again.
"""

import re
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from eval.calibration.config import CalibrationConfig
from eval.calibration.evaluation import judge_beliefs
from eval.decide import search_and_decide
from eval.decide.config import DecideConfig
from eval.explore import explore
from eval.explore.config import ExploreConfig
from eval.page.curves import OBJECTS
from eval.page.experiments import STUDIES, ResultsConfig, experiments
from eval.page.figures import draw_figures
from eval.page.findings import findings
from eval.page.tables import (
    Runs,
    agreement,
    beside_paper,
    finished,
    paired,
    paired_maps,
    photographs,
    readings,
    study_table,
    told_table,
)
from eval.search import search
from eval.search.config import SearchConfig
from semfov.errors import DataError, lookup
from semfov.io.files import write_text
from semfov.runs.command import run_command

NOT_RUN = ["*Not run yet.*"]

END = "<!-- end -->"
PLACE = re.compile(rf"(<!-- table (.+?) -->).*?{END}", re.DOTALL)
"""A table of a page, between the comment that names it and the one that ends it."""


def results(config: ResultsConfig) -> None:
    """Run the experiments and write the pages."""
    runs = experiments(config)
    chosen = list(runs) if config.only is None else [lookup(name, runs, "experiment") for name in config.only]
    for name in chosen:
        print(f"\n== {name}")
        HANDLERS[type(runs[name])](runs[name])
    pages = (config.page, config.tables)
    texts = [read_page(page) for page in pages]
    for page, text in zip(pages, texts, strict=True):
        write_text(page, fill_page(text, runs))
    for path in [*pages, *draw_figures(config.pictures, runs)]:
        print(f"written: {path}")


def read_page(path: Path) -> str:
    """The text of a page with tables."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"page: {path} cannot be read ({error.strerror}); check the path") from None


def fill_page(text: str, runs: Runs) -> str:
    """Replace every table of a page by that of the runs; raises InputError where a comment names no table."""
    return PLACE.sub(lambda found: "\n\n".join((found[1], "\n".join(fill_line(found[2], runs)), END)), text)


def fill_line(line: str, runs: Runs) -> list[str]:
    """The table that a line names: a table of several experiments, of a study, or of one experiment."""
    if line in STUDIES:
        return study_table(line, runs)
    if line in WHOLE:
        return WHOLE[line](runs)
    name, _, kind = line.partition(" ")
    run = runs.get(lookup(name, [*runs, *STUDIES, *WHOLE], "experiment"))
    make = TABLES[lookup(kind, TABLES, "table")]
    return make(run.out) if run is not None and finished(run) else NOT_RUN


WHOLE: dict[str, Callable[[Runs], list[str]]] = {
    "paper": beside_paper,
    "findings": findings,
    "photographs": photographs,
    "readings": readings,
}
"""Tables made from several experiments, or from none."""

SEARCHED = [f"CP@{n}" for n in (1, 5, 15, 30)]
EXPLORED = [str(n) for n in (0, 1, 5, 10, 20)]
BELIEVED = ["belief", "NLL", "ECE", "mean probability", "share that hold it"]
"""Columns of the tables of runs that the pages show."""

HANDLERS: dict[type, Callable[[Any], None]] = {
    SearchConfig: search,
    ExploreConfig: explore,
    DecideConfig: search_and_decide,
    CalibrationConfig: judge_beliefs,
}
"""Functions that run an experiment, by the class of its settings."""

TABLES: dict[str, Callable[[Path], list[str]]] = {
    "search": partial(told_table, "summary.md", 0, columns=SEARCHED),
    "explore": partial(told_table, "summary.md", 0, columns=EXPLORED),
    "explore-objects": partial(told_table, "summary.md", 1, columns=EXPLORED),
    "explore-cells": partial(told_table, "summary.md", 2, columns=EXPLORED),
    "agreement": agreement,
    "paired-search": partial(paired, baseline="random", shifts=(1, 5, 15, 30)),
    "presence": partial(told_table, "decisions.md", 0),
    "decisions": partial(told_table, "decisions.md", 1),
    "differences": partial(told_table, "decisions.md", 2),
    "landings": partial(told_table, "decisions.md", 3),
    "by-looks": partial(told_table, "beliefs.md", 0, columns=BELIEVED),
    "by-distance": partial(told_table, "beliefs.md", 1, columns=BELIEVED),
    "paired-map": paired_maps,
    "paired-map-objects": partial(paired_maps, field=OBJECTS),
}
"""Tables of one experiment."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(results, ResultsConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
