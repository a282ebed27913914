"""Regenerate docs/results.md and docs/tables.md: `python -m eval.results` runs the experiments and fills in both.

    python -m eval.results --root val2017 --annotations instances_val2017.json --yolox yolox_nano.onnx
        --fit_root fit --fit_annotations instances_fit.json

Results are measured on the photographs listed in configs/results_photographs.txt; settings are chosen on the
photographs of the fit set. The text of the findings is docs/results.template.md, and that of all other tables
docs/tables.template.md; a line `@@ table` or `@@ experiment table` stands for a table. Detections are computed once and
shared by all experiments. To continue a stopped run, give the same command again.
"""

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
from eval.page import paper
from eval.page.curves import OBJECTS
from eval.page.experiments import STUDIES, ResultsConfig, experiments
from eval.page.figures import draw_figures
from eval.page.findings import findings
from eval.page.tables import (
    Runs,
    agreement,
    beside_paper,
    finished,
    first_fixations,
    paired,
    paired_maps,
    photographs,
    readings,
    run_summary,
    study_table,
    told_table,
)
from eval.search import search
from eval.search.config import SearchConfig
from semfov.errors import DataError, lookup
from semfov.io.files import write_text
from semfov.runs.command import run_command

NOT_RUN = ["*Not run yet.*"]


def results(config: ResultsConfig) -> None:
    """Run the experiments and write the pages."""
    runs = experiments(config)
    chosen = list(runs) if config.only is None else [lookup(name, runs, "experiment") for name in config.only]
    for name in chosen:
        print(f"\n== {name}")
        HANDLERS[type(runs[name])](runs[name])
    pages = {config.page: config.template, config.tables: config.tables_template}
    texts = {page: read_template(template) for page, template in pages.items()}
    for page, template in texts.items():
        write_text(page, fill_page(template, runs))
    for path in [*pages, *draw_figures(config.pictures, runs)]:
        print(f"written: {path}")


def read_template(path: Path) -> str:
    """The text of a page, with lines that stand for tables."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"template: {path} cannot be read ({error.strerror}); check the path") from None


def fill_page(template: str, runs: Runs) -> str:
    """Replace every line `@@ …` of the template by the table that it names."""
    lines: list[str] = []
    for line in template.splitlines():
        lines += fill_line(line.removeprefix("@@ "), runs) if line.startswith("@@ ") else [line]
    return "\n".join(lines) + "\n"


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
    "table-1": partial(beside_paper, paper.TABLE_I),
    "table-2": partial(beside_paper, paper.TABLE_II),
    "findings": findings,
    "photographs": photographs,
    "readings": readings,
}
"""Tables made from several experiments, or from none."""

EXPLORED = (1, 2, 3, 4, 10, 20)

HANDLERS: dict[type, Callable[[Any], None]] = {
    SearchConfig: search,
    ExploreConfig: explore,
    DecideConfig: search_and_decide,
    CalibrationConfig: judge_beliefs,
}
"""Functions that run an experiment, by the class of its settings."""

TABLES: dict[str, Callable[[Path], list[str]]] = {
    "all": run_summary,
    "first": partial(run_summary, section=0),
    "second": partial(run_summary, section=1),
    "agreement": agreement,
    "first-fixations": first_fixations,
    "paired-search": partial(paired, baseline="random", shifts=(1, 5, 15, 30)),
    "paired-explore": partial(paired, baseline="random-raw", shifts=EXPLORED),
    "paired-explore-calibrated": partial(paired, baseline="random-calibrated", shifts=EXPLORED),
    "presence": partial(told_table, "decisions.md", 0),
    "decisions": partial(told_table, "decisions.md", 1),
    "landings": partial(told_table, "decisions.md", 2),
    "by-looks": partial(told_table, "beliefs.md", 0),
    "by-distance": partial(told_table, "beliefs.md", 1),
    "paired-map": paired_maps,
    "paired-map-objects": partial(paired_maps, field=OBJECTS),
}
"""Tables of one experiment."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(results, ResultsConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
