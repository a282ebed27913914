r"""Regenerate the tables of docs/results.md and docs/tables.md: `python -m eval.results` runs the experiments.

    python -m eval.results --root val2017 --annotations instances_val2017.json --yolox yolox_nano.onnx \
        --fit_root fit --fit_annotations instances_fit.json

Results are measured on the photographs listed in configs/results_photographs.txt; settings are chosen on the
photographs of the fit set. In the pages a table stands between the comments `<!-- table NAME -->` or
`<!-- table EXPERIMENT NAME -->` and `<!-- end -->`; the command replaces what is between them, and leaves the text
unchanged. Behind the name it writes the commit, the day and the number of photographs of the runs. A table is kept as
it is until all its experiments have run, and so is a figure; the command ends with a list of what it renewed and kept.
Detections are computed once and shared by all experiments. To continue a stopped run, give the same command again.
"""

import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from eval.comparison.thresholds import ThresholdLooksConfig, look_at_thresholds
from eval.decide import search_and_decide
from eval.decide.run import DecideConfig
from eval.explore import explore
from eval.explore.run import ExploreConfig
from eval.page.curves import OBJECTS
from eval.page.experiments import AT_THRESHOLDS, SENSITIVITY, ResultsConfig, experiments
from eval.page.figures import PAGE_FIGURES, THRESHOLD_FIGURE, draw_figures
from eval.page.findings import findings
from eval.page.origin import END, PLACE, missing, origin
from eval.page.tables import (
    Runs,
    beside_paper,
    by_samples,
    markdown_table,
    photographs,
    published,
    sensitivity,
)
from eval.page.thresholds import by_threshold, verdicts, words_of_verdicts
from eval.search import search
from eval.search.run import SearchConfig
from semfov.errors import DataError, lookup
from semfov.io.files import write_text
from semfov.runs.command import command
from semfov.runs.workers import shared_processes


def results(config: ResultsConfig) -> None:
    """Run the experiments and write the pages."""
    runs = experiments(config)
    chosen = list(runs) if config.only is None else [lookup(name, runs, "experiment") for name in config.only]
    with shared_processes():
        for name in chosen:
            print(f"\n== {name}")
            _HANDLERS[type(runs[name])](runs[name])
    pages = (config.page, config.tables)
    texts = [_read_page(page) for page in pages]
    renewed: list[str] = []
    stale: list[str] = []
    for page, text in zip(pages, texts, strict=True):
        filled, kept = _fill_page(text, runs)
        write_text(page, filled)
        stale += kept
    for text in texts:
        renewed += [match["name"] for match in PLACE.finditer(text) if match["name"] not in stale]
    drawn = draw_figures(config.pictures, runs)
    for name in (*PAGE_FIGURES, THRESHOLD_FIGURE):
        path = config.pictures / f"{name}.png"
        if path not in drawn:
            stale.append(path.name)
    renewed += [path.name for path in drawn]
    print(f"\nrenewed: {', '.join(renewed) or 'nothing'}")
    print(f"kept, because experiments have not run: {', '.join(stale) or 'nothing'}")
    for path in [*pages, *drawn]:
        print(f"written: {path}")


def _read_page(path: Path) -> str:
    """Read the text of a page with tables."""
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"page: {path} cannot be read ({error.strerror}); check the path") from None


@dataclass(frozen=True)
class _PageTable:
    """A table of the pages."""

    made_of: tuple[str, ...]
    make: Callable[[Runs], list[str]]


def _fill_page(text: str, runs: Runs) -> tuple[str, list[str]]:
    """Renew the tables of a page whose experiments have all run."""
    stale = []

    def fill(match: re.Match[str]) -> str:
        name = match["name"]
        made = _page_table(name, runs)
        if missing(made.made_of, runs):
            stale.append(name)
            return match[0]
        source = origin(runs[experiment].out for experiment in made.made_of)
        lines = "\n".join(made.make(runs))
        return "\n\n".join([f"<!-- table {name} -- {source} -->", lines, END])

    return PLACE.sub(fill, text), stale


def _page_table(line: str, runs: Runs) -> _PageTable:
    """Find the table that a comment names: of several experiments, or of one experiment."""
    if line in _WHOLE:
        return _WHOLE[line]
    name, _, kind = line.partition(" ")
    lookup(name, [*runs, *_WHOLE], "experiment")
    make = _TABLES[lookup(kind, _TABLES, "table")]
    return _PageTable((name,), lambda runs: make(runs[name].out))


_SEARCHES, _EXPLORATIONS = (tuple(published(kind).values()) for kind in ("search", "explore"))

_WHOLE = {
    "paper": _PageTable(_SEARCHES, beside_paper),
    "findings": _PageTable((*_SEARCHES, *_EXPLORATIONS), findings),
    "verdicts": _PageTable(AT_THRESHOLDS, verdicts),
    "verdicts-words": _PageTable(AT_THRESHOLDS, words_of_verdicts),
    "thresholds": _PageTable(AT_THRESHOLDS, by_threshold),
    "photographs": _PageTable(_SEARCHES[:1], photographs),
    "sensitivity": _PageTable(tuple(f"sensitivity {setting}" for setting in SENSITIVITY), sensitivity),
}
"""Tables of the pages that are not of a single experiment."""

_SEARCHED = [f"CP@{n}" for n in (1, 5, 15, 30)]
_EXPLORED = [str(n) for n in (0, 1, 5, 20)]
"""Columns of the tables of runs that the pages show."""

_HANDLERS: dict[type, Callable[[Any], None]] = {
    SearchConfig: partial(search, pictures=False),
    ExploreConfig: partial(explore, pictures=False),
    DecideConfig: search_and_decide,
    ThresholdLooksConfig: look_at_thresholds,
}
"""Functions that run an experiment, by the class of its settings."""

_TABLES: dict[str, Callable[[Path], list[str]]] = {
    "search": partial(markdown_table, "summary.md", 0, columns=_SEARCHED),
    "explore": partial(markdown_table, "summary.md", 0, columns=_EXPLORED),
    "explore-objects": partial(markdown_table, "summary.md", 1, columns=_EXPLORED),
    "presence": partial(markdown_table, "decisions.md", 0),
    "decisions": partial(markdown_table, "decisions.md", 1),
    "samples-search": partial(by_samples, shifts=(1, 5, 15, 30)),
    "samples-explore": partial(by_samples, shifts=(1, 2, 5, 10, 20)),
    "samples-objects": partial(by_samples, shifts=(1, 2, 5, 10, 20), field=OBJECTS),
}
"""Tables of one experiment."""


main = command(results, ResultsConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
