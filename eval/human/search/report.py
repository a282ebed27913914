"""Output of a comparison of searches: tables, curves, the policies' scanpaths, settings and manifest."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Mapping

from eval.comparison.summary import announce, write_texts
from eval.human.search.config import PeopleSearchConfig
from eval.human.search.scores import DIMENSIONS, Beside
from semfov.data.fixations import Fixations, write_table
from semfov.io.code import commit
from semfov.io.files import clean, sha256
from semfov.runs.tables import csv_text, table
from semfov.version import __version__
from semfov.viz.style import save_figure

Rows = Mapping[str, Beside]

_HEAD = (
    "area under performance",
    "TFP-AUC",
    "probability mismatch",
    "scanpath ratio",
    "MultiMatch",
    "sequence score",
    "edit distance",
)


def people_report(
    config: PeopleSearchConfig, tables: Mapping[str, Rows], scanpaths: Mapping[str, list[Fixations]]
) -> None:
    """Write all output and print the tables; scanpaths are those of random baselines and policies, by name."""
    out = config.out
    summary = "\n".join(line for title, rows in tables.items() for line in [f"**{title}**", "", *_table(rows), ""])
    files = {
        "summary.md": summary,
        "summary.csv": _csv(tables),
        "curves.csv": _curves(tables),
        "config.yaml": config.yaml(),
        "manifest.json": json.dumps(_manifest(config), indent=2) + "\n",
    }
    written = write_texts(out, files)
    for name, searches in scanpaths.items():
        path = out / "scanpaths" / f"{clean(name)}.csv"
        write_table(path, searches)
        written.append(path)
    for number, (title, rows) in enumerate(tables.items(), start=1):
        from semfov.viz import plot_cumulative_performance

        figure = plot_cumulative_performance({name: each.curve for name, each in rows.items()}, title=title)
        written.append(save_figure(figure, out / f"performance_{number}.png"))
    announce(summary, written)


def _cells(each: Beside) -> list[tuple[float, float]]:
    none = float("nan")
    figures = [each.area, each.tfp_auc, (each.mismatch, none), each.ratio]
    return [*figures, each.multimatch, each.mean(4), each.mean(5)] if each.alike else [*figures, *[(none, none)] * 3]


def _table(rows: Rows) -> list[str]:
    body = [[name, *(_with_error(*cell) for cell in _cells(each))] for name, each in rows.items()]
    return table([["", *_HEAD], *body])


def _with_error(value: float, error: float) -> str:
    if math.isnan(value):
        return ""
    return f"{value:.3f} ± {error:.3f}" if not math.isnan(error) else f"{value:.3f}"


def _csv(tables: Mapping[str, Rows]) -> str:
    lines = [["table", "row", "figure", "value", "error"]]
    for title, rows in tables.items():
        for name, each in rows.items():
            named = dict(zip(_HEAD, _cells(each), strict=True))
            if each.alike:
                named |= {f"MultiMatch {what}": each.mean(n) for n, what in enumerate(DIMENSIONS)}
            lines += [[title, name, what, f"{value:.5f}", f"{error:.5f}"] for what, (value, error) in named.items()]
    return csv_text(lines)


def _curves(tables: Mapping[str, Rows]) -> str:
    lines = [["table", "row", "gaze shifts", "found"]]
    for title, rows in tables.items():
        for name, each in rows.items():
            lines += [[title, name, str(n), f"{value:.5f}"] for n, value in enumerate(each.curve)]
    return csv_text(lines)


def _manifest(config: PeopleSearchConfig) -> dict[str, object]:
    files = [config.people, *config.files]
    files = [file for path in files for file in (sorted(path.glob("*.json")) if path.is_dir() else [path])]
    return {
        "command": ["python", "-m", "eval.human", *sys.argv[1:]],
        "commit": commit(),
        "semfov": __version__,
        "sha256": {str(file): sha256(file) for file in files},
        "seed": config.protocol.seed,
    }
