"""Output of a search run: cumulative performance as tables and curves, and a few scanpaths."""

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.chance import random_search
from eval.comparison.replay import replay
from eval.comparison.report_page import write_run_report
from eval.comparison.summary import (
    LAST_COLUMN,
    Curve,
    announce,
    collect_records,
    curve_of,
    curve_rows,
    curves_csv,
    sensing,
    write_files,
)
from eval.search.run import SearchRun
from semfov.errors import DataError
from semfov.io.files import inside, plain_name
from semfov.metrics.episodes import FloatArray, cumulative_performance
from semfov.paths.stimulus import Stimulus
from semfov.runs.results import ResultRecord
from semfov.runs.tables import table
from semfov.viz.style import save_figure

_SEARCH_SHIFTS = (1, 5, 10, 15, 30)
"""Gaze shifts at which tables show the cumulative performance."""

_AVERAGES = {
    "all targets": "mean over images, every legal target of an image",
    "commonest": "mean over images, the target class with most instances",
}


def search_report(run: SearchRun, *, pictures: bool = True) -> None:
    """Write all output of a finished run, or all but its figures and its page, and print the tables."""
    records, seconds = collect_records(run)
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    shifts = run.config.protocol.shifts
    curves = {average: performance(records, list(run.policies), shifts, average) for average in _AVERAGES}
    expected = _expected_random(records, shifts, run.config.belief.columns * run.config.belief.rows)
    summary = _search_summary(curves, expected, sensing(run))
    tables = {"summary.md": summary, "summary.csv": curves_csv(curves, ("average", "performance"))}
    written = write_files(run, "eval.search", tables, records, seconds)
    if pictures:
        written += [_draw_search_curves(run, curves["all targets"], expected), *_draw_searches(run, records)]
        written.append(
            write_run_report(
                run,
                records,
                curves,
                titles=_AVERAGES,
                label="targets found (%)",
                shifts=_SEARCH_SHIFTS,
                others={"random, by formula": expected},
            )
        )
    announce(summary, written)


def performance(records: list[ResultRecord], policies: Sequence[str], shifts: int, average: str) -> dict[str, Curve]:
    """Cumulative performance of each policy, over all targets or over the commonest target of each image."""
    measure = partial(found, shifts=shifts)
    counted = [record for record in records if record["commonest"] or average == "all targets"]
    return {policy: curve_of((r for r in counted if r["policy"] == policy), measure) for policy in policies}


def found(record: ResultRecord, shifts: int) -> FloatArray:
    """Whether a search has found its target after 0, 1, … gaze shifts."""
    return cumulative_performance(np.array([record["found_at"]]), shifts)


def _expected_random(records: list[ResultRecord], shifts: int, cells: int) -> FloatArray:
    """Compute expected performance of random search for these targets (hypergeometric formula), mean over images."""
    targets: dict[Any, dict[int, int]] = defaultdict(dict)
    for record in records:
        targets[record["scene"]][record["target"]] = len(record["goal"])
    curves = [
        np.mean([random_search(count, shifts, cells) for count in goals.values()], axis=0) for goals in targets.values()
    ]
    return np.asarray(np.mean(curves, axis=0), dtype=np.float64)


def _search_summary(curves: dict[str, dict[str, Curve]], expected: FloatArray, sensing: str) -> str:
    """Write the tables that the run prints: cumulative performance with standard errors over images."""
    shifts = [n for n in _SEARCH_SHIFTS if n < len(expected)]
    head = ["policy", *(f"CP@{n}" for n in shifts), LAST_COLUMN]
    lines = []
    for average, policies in curves.items():
        first = next(iter(policies.values()))
        lines += [
            f"**{_AVERAGES[average]}** ({sensing}; {first.images} images, {first.episodes} searches per policy; "
            "percentage of targets found after n gaze shifts, not counting the first fixation, ± standard error over "
            "images)",
            "",
        ]
        rows = curve_rows(policies, shifts)
        if average == "all targets":
            rows.append(["random, by formula", *(f"{100 * expected[n]:.1f}" for n in shifts), ""])
        lines += [*table([head, *rows]), ""]
    return "\n".join(lines)


def _draw_search_curves(run: SearchRun, curves: dict[str, Curve], expected: FloatArray) -> Path:
    """Draw the cumulative performance against gaze shifts."""
    from semfov.viz import plot_curves

    figure = plot_curves(
        {**{name: curve.mean for name, curve in curves.items()}, "random, by formula": expected},
        {name: curve.over_images for name, curve in curves.items()},
        label="targets found (%)",
        title=f"Visual search\n{sensing(run)}",
        most=102,
    )
    return save_figure(figure, run.config.out / "cumulative_performance.png")


def _draw_searches(run: SearchRun, records: list[ResultRecord]) -> list[Path]:
    """Draw a few episodes of the last policy in different scenes, preferring finds after two to six gaze shifts."""
    from semfov.viz import plot_episode

    last = [record for record in records if record["policy"] == list(run.policies)[-1]]
    last.sort(key=lambda record: (record["found_at"] < 0, not 2 <= record["found_at"] <= 6))
    chosen = list({record["scene"]: record for record in reversed(last)}.values())
    chosen.sort(key=last.index)
    paths = []
    for record in chosen[: run.config.scanpaths]:
        index = run.scenes.ids.index(record["scene"])
        scene = run.scenes[index]
        scanpath = replay(run, index, record)
        views = Stimulus.of(run.eye, scene.image).views(scanpath.fixations)
        boxes = scene.boxes[scene.labels == record["target"]]
        # An id may be any text. Cleaned ids may coincide, so the scene's number is put before them.
        scene_name = record["scene"] if isinstance(record["scene"], int) else f"{index}-{plain_name(record['scene'])}"
        path = inside(run.config.out, f"scanpath_{scene_name}_{plain_name(record['target_name'])}.png")
        paths.append(save_figure(plot_episode(scanpath, scene.image, views, boxes=boxes), path))
    return paths
