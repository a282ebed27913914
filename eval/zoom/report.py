"""Runs an experiment with large pictures to its end, and writes its tables and curves."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import mean, median

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.comparison.records import gather, grouped
from eval.comparison.summary import announce, write_summary
from eval.zoom.decisions import decision_tables, presence_scores
from eval.zoom.folds import outcomes_in_folds
from eval.zoom.objects import SEMFOV, object_table
from eval.zoom.run import ZoomConfig, ZoomRun
from semfov.runs.results import ResultRecord
from semfov.runs.scene_run import finish
from semfov.runs.tables import table
from semfov.viz.curves import plot_reliability
from semfov.viz.style import save_figure


def zoom(config: ZoomConfig) -> None:
    """Run all scenes that are not finished yet, and write tables, records and curves."""
    run = ZoomRun(config)
    if config.folds:
        records = outcomes_in_folds(run)
    else:
        finish(run, "zooming")
        records = [*gather(run)]
    text = zoom_summary(records, run)
    written = write_summary(config.out, "zoom", text, records)
    if "recall" in config.measures:
        written.append(_curves(records, run))
    if decided := [record for record in records if record["measure"] == "decision"]:
        scores, there = presence_scores(decided)
        predictions = {name: (torch.stack([1 - score, score], -1), there.long()) for name, score in scores.items()}
        written.append(save_figure(plot_reliability(predictions), config.out / "reliability.png"))
    announce(text, written)


def curve(records: list[ResultRecord], passes: int) -> list[float]:
    """Compute the share of all objects found after each pass; if a way of looking ends early, its last share stays."""
    objects = sum(record["objects"] for record in records)
    shares = []
    for last in range(passes):
        found = sum(record["found"][min(last, len(record["found"]) - 1)] for record in records)
        shares.append(found / max(objects, 1))
    return shares


def zoom_summary(records: list[ResultRecord], run: ZoomRun) -> str:
    """Write the tables of all measures, as Markdown."""
    groups = grouped(records, "measure")
    lines: list[str] = []
    if "objects" in groups:
        lines += object_table(groups["objects"])
    if "recall" in groups:
        lines += recalls(grouped(groups["recall"], "way"), run)
    if "first hit" in groups:
        lines += _first_hits(grouped(groups["first hit"], "way"))
    if "decision" in groups:
        lines += decision_tables(groups["decision"])
    return "\n".join(lines)


def _first_hits(hits: dict[str, list[ResultRecord]]) -> list[str]:
    """Write the table of passes to the first confirmed hit, by way of looking."""
    rows = [["", "mean", "median", "failures at the cap"]]
    for way, group in hits.items():
        passes = [record["passes"] for record in group]
        failed = sum(not record["hit"] for record in group) / len(group)
        rows.append([way, f"{mean(passes):.2f}", f"{median(passes):g}", f"{100 * failed:.1f} %"])
    count = len(next(iter(hits.values())))
    return [
        f"Passes to the first confirmed hit, including the overview, in {count} searches for a class that one of "
        "the slices shows with a score of 0.3 or more.",
        "",
        *table(rows),
        "",
    ]


def recalls(finding: dict[str, list[ResultRecord]], run: ZoomRun) -> list[str]:
    """Write the table of recall for every way of looking."""
    passes = run.config.passes
    at = sorted({number for number in (1, 4, 8, 12, 16, 24) if number <= passes} | {passes})
    pixels = run.eye.detector.input_size[0] * run.eye.detector.input_size[1] / 1e6
    figures = Bootstrap.of(partial(recall_and_precision, finding, at), range(len(run.scenes)))
    rows = [["", *map(str, at), "area under the curve", "boxes for each object", "precision"]]
    for number, (way, group) in enumerate(finding.items()):
        recall, precision = _recall_cells(figures, number)
        area = mean(curve(group, passes))
        boxes = sum(record["boxes"] for record in group)
        annotated = sum(record["objects"] for record in group)
        rows.append([way, *recall, f"{area:.3f}", f"{boxes / max(annotated, 1):.2f}", precision])
    ways = list(finding)
    paired = figures.less(ways.index(SEMFOV))
    differences = [[f"difference to {SEMFOV}", *map(str, at), "precision"]]
    for number, way in enumerate(ways):
        if way != SEMFOV:
            recall, precision = _recall_cells(paired, number, "+")
            differences.append([way, *recall, precision])
    what = "objects" if run.config.target is None else run.config.target
    objects = sum(record["objects"] for record in next(iter(finding.values())))
    return [
        f"Recall of {objects} {what} in {len(run.scenes)} pictures after n passes of the detector, including the "
        f"overview (score 0.1, IoU 0.5), and the share of the boxes after the last pass that show an object, one box "
        f"for each object; a pass takes {pixels:.3f} million pixels. ± is the standard error by bootstrap over "
        "pictures; differences are paired.",
        "",
        *table(rows),
        "",
        *table(differences),
        "",
    ]


def recall_and_precision(finding: dict[str, list[ResultRecord]], at: Sequence[int], pictures: Tensor) -> Tensor:
    """Compute recall after some passes, and the share of right boxes after the last, for each way of looking.

    Args:
        finding: for each way of looking, a record of each picture.
        at: numbers of passes.
        pictures: indices of the pictures, some of them repeated.

    Returns:
        `(ways, len(at) + 1)`, float64; NaN where there is no box.
    """
    rows = []
    for group in finding.values():
        chosen = [group[picture] for picture in pictures.tolist()]
        shares = curve(chosen, max(at))
        boxes = sum(record["boxes"] for record in chosen)
        precision = sum(record["right"] for record in chosen) / boxes if boxes else torch.nan
        rows.append([*(shares[passes - 1] for passes in at), precision])
    return torch.tensor(rows, dtype=torch.float64)


def _recall_cells(figures: Bootstrap, way: int, sign: str = "") -> tuple[list[str], str]:
    """Write the cells of recall, and that of precision, of a way of looking (`recall_and_precision`)."""
    *recall, precision = figures.cells(way, sign=sign)
    return recall, precision if figures.value[way, -1].isfinite() else "-"


def _curves(records: list[ResultRecord], run: ZoomRun) -> Path:
    """Plot recall over passes, a line for each way of looking; returns the path of the figure."""
    from matplotlib.figure import Figure

    passes = run.config.passes
    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for way, group in grouped((record for record in records if record["measure"] == "recall"), "way").items():
        axes.plot(range(1, passes + 1), curve(group, passes), label=way)
    axes.set(xlabel="passes of the detector", ylabel="recall", ylim=(0, None))
    axes.legend(fontsize="small")
    return save_figure(figure, run.config.out / "recall.png")
