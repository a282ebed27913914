"""Output of a run of free viewing: tables, figures, settings and manifest."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from eval.comparison.summary import announce, sensing, write_files
from eval.human.viewing.figures import plot_by_shift, plot_scanpaths_beside
from eval.human.viewing.rows import MEASURES, PEOPLE, Half, Scored
from eval.human.viewing.run import ViewingRun
from eval.human.viewing.sequences import drawn_scanpaths
from semfov.io.files import clean
from semfov.io.tables import csv_text
from semfov.metrics.averages import standard_error
from semfov.runs.scene_run import gather
from semfov.runs.tables import table
from semfov.viz.style import save_figure

_Array = NDArray[np.float64]
_Table = Mapping[tuple[str, str], Scored]

GROUPS = {
    "alone": "each map alone; its weight (an inverse temperature) and its blur are fitted",
    "with habits": "each map plus, with fitted weights, the log densities of a centre bias and of saccade length, and "
    "the visited cells",
}
FLOORS = {"alone": "centre bias", "with habits": "nearby"}
"""Row of the baseline without any map, by group."""


def viewing_report(run: ViewingRun, scored: _Table, sequences: Mapping[str, _Array], reported: Half) -> None:
    """Write all output and print the tables."""
    records = gather(run)
    summary = viewing_summary(run, scored, sequences)
    tables = {
        "summary.md": summary,
        "summary.csv": summary_csv(scored),
        "pictures.csv": pictures_csv(run, scored),
        "weights.csv": weights_csv(scored),
        "sequences.csv": sequences_csv(sequences),
    }
    written = write_files(run, "eval.human", tables, records, records.seconds)
    written.append(draw_shifts(run, scored))
    written += draw_viewings(run, scored, reported)
    announce(summary, written)


def viewing_summary(run: ViewingRun, scored: _Table, sequences: Mapping[str, _Array]) -> str:
    """The tables of both groups and of sequence scores, as Markdown."""
    pictures = len(next(iter(scored.values())).pictures)
    lines = []
    for group, words in GROUPS.items():
        rows = {name: each for (name, kind), each in scored.items() if kind == group}
        base, rival = rows[FLOORS[group]], rows.get("vocus2")
        rows = dict(sorted(rows.items(), key=lambda item: item[1].pictures[:, 0].mean()))
        head = ["", "NSS", "AUC", "bits above uniform", "bits above centre bias"]
        head += [f"NSS − {FLOORS[group]}", *(["NSS − vocus2"] if rival else []), "weight of the map"]
        body = []
        for name, each in rows.items():
            gain = each.pictures[:, 2] - scored["centre bias", "alone"].pictures[:, 2]
            cells = [_figure(each.pictures[:, n]) for n in range(3)] + [_figure(gain)]
            cells.append(_signed(each, base))
            if rival is not None:
                cells.append(_signed(each, rival))
            cells.append(", ".join(f"{value:.2f}" for value in each.weights.values[: len(each.row.maps)].tolist()))
            body.append([name, *cells])
        lines += [
            f"**{group}** ({sensing(run)}; {pictures} pictures, conditional scores of all fixations except the first "
            f"of each scanpath, ± standard error over pictures; {words})",
            "",
            *table([head, *body]),
            "",
        ]
    if sequences:
        body = [[name, _figure(values)] for name, values in sorted(sequences.items(), key=lambda item: item[1].mean())]
        count = len(next(iter(sequences.values())))
        lines += [
            f"**sequences** (scanpaths drawn from the densities with habits, with the first fixation and the length of "
            f"each person's scanpath, compared with those of all other people; {count} pictures, ± standard error over "
            "pictures)",
            "",
            *table([["", "sequence score"], *body]),
            "",
        ]
    return "\n".join(lines)


def summary_csv(scored: _Table) -> str:
    """Means and standard errors over pictures of every row, as CSV."""
    lines = [["row", "group", "figure", "mean", "error", "pictures"]]
    for (name, group), each in scored.items():
        for number, figure in enumerate(MEASURES):
            values = each.pictures[:, number]
            lines.append(
                [name, group, figure, f"{values.mean():.6f}", f"{standard_error(values):.6f}", str(len(values))]
            )
    return csv_text(lines)


def pictures_csv(run: ViewingRun, scored: _Table) -> str:
    """Scores of every row and picture, as CSV."""
    ids = run.scenes.ids[0 if run.config.swap else 1 :: 2]
    lines = [["picture", "row", "group", *MEASURES]]
    for (name, group), each in scored.items():
        lines += [
            [str(i), name, group, *(f"{v:.5f}" for v in values)] for i, values in zip(ids, each.pictures, strict=True)
        ]
    return csv_text(lines)


def weights_csv(scored: _Table) -> str:
    """The fitted weights, and the likelihood of the fitted half under them, as CSV."""
    lines = [["row", "group", "term", "weight", "blur", "bits of the fitted half"]]
    for (name, group), each in scored.items():
        weights = each.weights
        for term, value in zip(weights.terms, weights.values.tolist(), strict=True):
            lines.append([name, group, term, f"{value:.4f}", f"{weights.blur:g}", f"{weights.bits:.4f}"])
    return csv_text(lines)


def sequences_csv(sequences: Mapping[str, _Array]) -> str:
    """Sequence scores of every row and picture, as CSV."""
    lines = [["row", "picture number", "sequence score"]]
    for name, values in sequences.items():
        lines += [[name, str(number), f"{value:.5f}"] for number, value in enumerate(values)]
    return csv_text(lines)


def draw_shifts(run: ViewingRun, scored: _Table) -> Path:
    """Draw NSS after each gaze shift, for rows with habits."""
    names = [
        "nearby",
        *run.config.models,
        "closer-look-learned",
        "landing",
        *(f"landing + {m}" for m in run.config.models[:1]),
    ]
    curves, errors = {}, {}
    for name in [*names, PEOPLE]:
        each = scored.get((name, "with habits"))
        if each is None:
            continue
        columns = [column[np.isfinite(column)] for column in each.shifts[..., 0].T]
        columns = [column for column in columns if len(column)]
        curves[name] = np.array([column.mean() for column in columns])
        errors[name] = np.array([standard_error(column) for column in columns])
    figure = plot_by_shift(curves, errors, label="conditional NSS", title=f"Free viewing, with habits\n{sensing(run)}")
    return save_figure(figure, run.config.out / "nss_by_shift.png")


def draw_viewings(run: ViewingRun, scored: _Table, reported: Half) -> list[Path]:
    """Draw scanpaths of four people, of `landing` and of `nearby` in the same pictures."""
    written = []
    for place, index in enumerate(reported.pictures[: run.config.drawings]):
        name = str(run.scenes.ids[index])
        scanpaths = {"people": [each.points[: run.config.longest] for each in run.people[name]]}
        for row in ("landing", "nearby"):
            scanpaths[row] = drawn_scanpaths(scored[row, "with habits"], reported, place)
        few = {name: paths[:4] for name, paths in scanpaths.items()}
        figure = plot_scanpaths_beside(run.scenes[index].image, few)
        written.append(save_figure(figure, run.config.out / f"scanpaths_{clean(Path(name).stem)}.png"))
    return written


def _figure(values: _Array) -> str:
    return f"{values.mean():.3f} ± {standard_error(values):.3f}"


def _signed(each: Scored, other: Scored) -> str:
    if each is other:
        return ""
    mean, error = each.difference(other)
    return f"{mean:+.3f} ± {error:.3f}"
