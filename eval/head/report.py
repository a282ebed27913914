"""Runs an experiment with a head that turns to its end, and writes its tables and curves."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

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


def compared(
    records: list[ResultRecord], others: list[ResultRecord], measure: _Measure
) -> tuple[float, float, float, float]:
    """Mean over scenes with its standard error, then mean difference from `others`, paired by scene, with its error."""
    mine, theirs = measured(records, measure), measured(others, measure)
    values = np.array([*mine.values()])
    apart = np.array([value - theirs[scene] for scene, value in mine.items()])
    errors = (float(standard_error(each)) for each in (values, apart))
    return float(values.mean()), next(errors), float(apart.mean()), next(errors)


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
    limit, ours = config.seconds, searches[OURS]
    times = _budgets(config)
    less = "difference to semfov"
    rows = [["", *(f"found in {second:g} s, %" for second in times), "seconds", less, "passes", less]]
    for way, group in searches.items():
        row = [way]
        for second in times:
            mean, error, *_ = compared(group, ours, lambda r, s=second: float(r["found"] and r["seconds"] <= s))  # type: ignore[misc]
            row.append(percent(mean, error))
        for measure in (
            lambda r: r["seconds"] if r["found"] else limit,
            lambda r: float(r["passes"]) if r["found"] else float(config.passes),
        ):
            mean, error, apart, error_apart = compared(group, ours, measure)
            row += [plus_minus(mean, error, 2), "" if way == OURS else plus_minus(apart, error_apart, 2)]
        rows.append(row)
    scenes = len({record["scene"] for record in ours})
    return [
        f"{len(ours)} searches in {scenes} {what}, each until the gaze rests on a cell that a target overlaps. A "
        f"search that does not succeed within {limit:g} s and {config.passes} passes counts with these numbers. Means "
        f"over {what} ± standard errors; `difference to semfov`: difference from semfov, paired by scene.",
        "",
        *table(rows),
        "",
    ]


def _exploring(explorations: dict[str, list[ResultRecord]], config: HeadConfig, what: str) -> list[str]:
    ours, times = explorations[OURS], _budgets(config)
    last = times[-1]
    rows = [
        [
            "",
            *(f"after {second:g} s" for second in times),
            f"difference to semfov, after {last:g} s",
            "objects alone",
            "looks",
        ]
    ]
    for way, group in explorations.items():
        row = [way]
        for second in times:
            mean, error, apart, error_apart = compared(group, ours, lambda r, s=second: _value_by(r, s, "success"))  # type: ignore[misc]
            row.append(percent(mean, error))
        row.append("" if way == OURS else plus_minus(100 * apart, 100 * error_apart))
        mean, error, *_ = compared(group, ours, lambda r: _value_by(r, last, "objects"))
        looks, _, *_ = compared(group, ours, lambda r: float(len(r["seconds"])))
        rows.append([*row, percent(mean, error), f"{looks:.1f}"])
    return [
        f"Explorations of {len(ours)} {what}: percentage of the cells with objects, weighted by area, whose most "
        "probable class, background included, is that of an object there. `objects alone`: the same without background "
        f"as an answer, after {last:g} s.",
        "",
        *table(rows),
        "",
    ]


def _curves(records: list[ResultRecord], config: HeadConfig):  # type: ignore[no-untyped-def]
    from matplotlib.figure import Figure

    seconds = np.linspace(0, config.seconds, 101)
    measures: dict[str, tuple[str, Callable[..., float]]] = {
        "search": ("share of targets found", lambda r, s=0.0: float(r["found"] and r["seconds"] <= s)),
        "exploration": ("share of cells named right", lambda r, s: _value_by(r, s, "success")),
    }
    written = []
    for task, (title, measure) in measures.items():
        ways = [*dict.fromkeys(record["way"] for record in records if record["task"] == task)]
        if not ways:
            continue
        figure = Figure(figsize=(6, 4), layout="constrained")
        axes = figure.subplots()
        for order, way in enumerate(ways):
            group = [record for record in records if record["task"] == task and record["way"] == way]
            line = [np.mean([*measured(group, partial(measure, s=s)).values()]) for s in seconds]
            axes.plot(seconds, line, label=way, **line_style(order, len(ways)))
        axes.set(xlabel="seconds", ylabel=title, ylim=(0, None))
        axes.legend(fontsize="small")
        written.append(save_figure(figure, config.out / f"{task}.png"))
    return written
