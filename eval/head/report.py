"""Runs an experiment with a head that turns to its end, and writes its tables and curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from eval.comparison.records import gather
from eval.comparison.summary import announce, by_scene, write_summary
from eval.head.run import OURS, HeadConfig, HeadRun
from semfov.metrics.episodes import standard_error
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import finish
from semfov.runs.tables import percent, plus_minus, table
from semfov.viz.style import line_style, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_Array = NDArray[np.float64]
_Measure = Callable[[ResultRecord], float]


def head(config: HeadConfig) -> None:
    """Run all scenes that are not finished yet, and write tables, records and curves."""
    run = HeadRun(config)
    finish(run, "looking around")
    records = [*gather(run)]
    text = _head_summary(records, config)
    announce(text, [*write_summary(config.out, "head", text, records), *_curves(records, config)])


def measured(records: list[ResultRecord], measure: _Measure) -> dict[Any, float]:
    """Mean of a measure over the records of each scene."""
    return by_scene((record["scene"], measure(record)) for record in records)


class Comparison(NamedTuple):
    """A measure over scenes beside that of others.

    Attributes:
        mean: mean over scenes.
        error: its standard error.
        difference: mean difference from the others, paired by scene.
        difference_error: its standard error.
    """

    mean: float
    error: float
    difference: float
    difference_error: float


def compared(records: list[ResultRecord], others: list[ResultRecord], measure: _Measure) -> Comparison:
    """Compare a measure of records with that of others in the same scenes."""
    of_scenes = measured(records, measure)
    of_others = measured(others, measure)
    values = np.array([*of_scenes.values()])
    differences = np.array([value - of_others[scene] for scene, value in of_scenes.items()])
    return Comparison(
        float(values.mean()),
        float(standard_error(values)),
        float(differences.mean()),
        float(standard_error(differences)),
    )


def _found_by(record: ResultRecord, seconds: float) -> float:
    """Return 1 if a search has found its target by `seconds`, else 0."""
    return float(record["found"] and record["seconds"] <= seconds)


def _value_by(record: ResultRecord, seconds: float, what: str) -> float:
    """Read the measure `what` of an exploration after the last look that has ended by `seconds`; 0 before the first."""
    done = sum(second <= seconds for second in record["seconds"])
    return float(record[what][done - 1]) if done else 0.0


def _budgets(config: HeadConfig) -> list[float]:
    """Return the times in seconds for which the tables give results."""
    return sorted({second for second in (2.0, 5.0, 10.0) if second < config.seconds} | {config.seconds})


def _head_summary(records: list[ResultRecord], config: HeadConfig) -> str:
    """Tables as Markdown."""
    groups: dict[tuple[str, str], list[ResultRecord]] = defaultdict(list)
    for record in records:
        groups[record["task"], record["way"]].append(record)
    what = {"panorama": "panoramas", "mosaic": "mosaics"}[config.scene]
    lines: list[str] = []
    searches = {way: group for (task, way), group in groups.items() if task == "search"}
    if searches:
        lines += _searching(searches, config, what)
    explorations = {way: group for (task, way), group in groups.items() if task == "exploration"}
    if explorations:
        lines += _exploring(explorations, config, what)
    return "\n".join(lines)


def _searching(searches: dict[str, list[ResultRecord]], config: HeadConfig, what: str) -> list[str]:
    """Write the table of searches."""

    def seconds_spent(record: ResultRecord) -> float:
        return record["seconds"] if record["found"] else config.seconds

    def passes_spent(record: ResultRecord) -> float:
        return float(record["passes"] if record["found"] else config.passes)

    ours = searches[OURS]
    times = _budgets(config)
    difference = "difference to semfov"
    rows = [["", *(f"found in {time:g} s, %" for time in times), "seconds", difference, "passes", difference]]
    for way, group in searches.items():
        row = [way]
        for time in times:
            found = compared(group, ours, partial(_found_by, seconds=time))
            row.append(percent(found.mean, found.error))
        for measure in (seconds_spent, passes_spent):
            spent = compared(group, ours, measure)
            row.append(plus_minus(spent.mean, spent.error, 2))
            row.append("" if way == OURS else plus_minus(spent.difference, spent.difference_error, 2))
        rows.append(row)
    scenes = len({record["scene"] for record in ours})
    return [
        f"{len(ours)} searches in {scenes} {what}, each until the gaze rests on a cell that a target overlaps. A "
        f"search that does not succeed within {config.seconds:g} s and {config.passes} passes counts with these "
        f"numbers. Means over {what} ± standard errors; `difference to semfov`: difference from semfov, paired by "
        "scene.",
        "",
        *table(rows),
        "",
    ]


def _exploring(explorations: dict[str, list[ResultRecord]], config: HeadConfig, what: str) -> list[str]:
    """Write the table of explorations."""
    ours = explorations[OURS]
    times = _budgets(config)
    last = times[-1]
    after = [f"after {time:g} s" for time in times]
    rows = [["", *after, f"difference to semfov, {after[-1]}", "objects alone", "looks"]]
    for way, group in explorations.items():
        success = [compared(group, ours, partial(_value_by, seconds=time, what="success")) for time in times]
        objects = compared(group, ours, partial(_value_by, seconds=last, what="objects"))
        looks = compared(group, ours, lambda record: float(len(record["seconds"])))
        row = [way, *(percent(figures.mean, figures.error) for figures in success)]
        at_end = success[-1]
        row.append("" if way == OURS else plus_minus(100 * at_end.difference, 100 * at_end.difference_error))
        rows.append([*row, percent(objects.mean, objects.error), f"{looks.mean:.1f}"])
    return [
        f"Explorations of {len(ours)} {what}: percentage of the cells with objects, weighted by area, whose most "
        "probable class, background included, is that of an object there. `objects alone`: the same without background "
        f"as an answer, after {last:g} s.",
        "",
        *table(rows),
        "",
    ]


def _curves(records: list[ResultRecord], config: HeadConfig) -> list[Path]:
    """Draw the curves of searches and of explorations over time; returns the paths of the figures."""
    measures: dict[str, tuple[str, Callable[..., float]]] = {
        "search": ("share of targets found", _found_by),
        "exploration": ("share of cells named right", partial(_value_by, what="success")),
    }
    written = []
    for task, (title, measure) in measures.items():
        of_task = [record for record in records if record["task"] == task]
        if of_task:
            figure = _plot(of_task, measure, title, config.seconds)
            written.append(save_figure(figure, config.out / f"{task}.png"))
    return written


def _plot(records: list[ResultRecord], measure: Callable[..., float], title: str, duration: float) -> Figure:
    """Plot the mean over scenes of a measure by `seconds`, a line for each way of moving eye and head."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    times = np.linspace(0, duration, 101)
    ways = [*dict.fromkeys(record["way"] for record in records)]
    for order, way in enumerate(ways):
        group = [record for record in records if record["way"] == way]
        line = [np.mean([*measured(group, partial(measure, seconds=time)).values()]) for time in times]
        axes.plot(times, line, label=way, **line_style(order, len(ways)))
    axes.set(xlabel="seconds", ylabel=title, ylim=(0, None))
    axes.legend(fontsize="small")
    return figure
