"""Runs an experiment with large pictures to its end, and writes its tables and curves."""

from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from statistics import mean, median

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.comparison.records import gather
from eval.comparison.summary import announce, write_summary
from eval.zoom.decisions import decision_tables, presence_scores
from eval.zoom.folds import outcomes_in_folds
from eval.zoom.objects import object_table
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
        sure = {name: (torch.stack([1 - score, score], -1), there.long()) for name, score in scores.items()}
        written.append(save_figure(plot_reliability(sure), config.out / "reliability.png"))
    announce(text, written)


def curve(records: list[ResultRecord], passes: int) -> list[float]:
    """Share of all objects found after each pass; if a way of looking ends early, its last share stays."""
    total = sum(record["objects"] for record in records)
    counts = [sum(r["found"][min(n, len(r["found"])) - 1] for r in records) for n in range(1, passes + 1)]
    return [count / max(total, 1) for count in counts]


def zoom_summary(records: list[ResultRecord], run: ZoomRun) -> str:
    """Tables as Markdown."""
    groups: dict[tuple[str, str], list[ResultRecord]] = defaultdict(list)
    for record in records:
        groups[record["measure"], record["way"]].append(record)
    finding = {way: group for (measure, way), group in groups.items() if measure == "recall"}
    returned = [record for record in records if record["measure"] == "objects"]
    lines = object_table(returned) if returned else []
    lines += recalls(finding, run) if finding else []
    hits = {way: group for (measure, way), group in groups.items() if measure == "first hit"}
    if hits:
        rows = [["", "mean", "median", "failures at the cap"]]
        for way, group in hits.items():
            counts = [record["passes"] for record in group]
            failed = sum(not record["hit"] for record in group) / len(group)
            rows.append([way, f"{mean(counts):.2f}", f"{median(counts):g}", f"{100 * failed:.1f} %"])
        count = len(next(iter(hits.values())))
        lines += [
            f"Passes to the first confirmed hit, including the overview, in {count} searches for a class that one of "
            "the slices shows with a score of 0.3 or more.",
            "",
            *table(rows),
            "",
        ]
    if decided := [record for record in records if record["measure"] == "decision"]:
        lines += decision_tables(decided)
    return "\n".join(lines)


def recalls(finding: dict[str, list[ResultRecord]], run: ZoomRun) -> list[str]:
    """Table of recall for every way of looking."""
    passes = run.config.passes
    at = sorted({n for n in (1, 4, 8, 12, 16, 24) if n <= passes} | {passes})
    pixels = run.eye.detector.input_size[0] * run.eye.detector.input_size[1] / 1e6
    figures = Bootstrap.of(partial(recall_and_precision, finding, at), range(len(run.scenes)))
    rows = [["", *map(str, at), "area under the curve", "boxes for each object", "precision"]]
    for (way, group), value, error in zip(finding.items(), figures.value, figures.error, strict=True):
        cells, right = recall_cells(value, error)
        boxes = sum(r["boxes"] for r in group) / max(sum(r["objects"] for r in group), 1)
        rows.append([way, *cells, f"{mean(curve(group, passes)):.3f}", f"{boxes:.2f}", right])
    apart = figures.less(list(finding).index("semfov"))
    less = [["difference to semfov", *map(str, at), "precision"]]
    for way, value, error in zip(finding, apart.value, apart.error, strict=True):
        cells, right = recall_cells(value, error, "+")
        less += [[way, *cells, right]] if way != "semfov" else []
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
        *table(less),
        "",
    ]


def recall_and_precision(finding: dict[str, list[ResultRecord]], at: Sequence[int], pictures: Tensor) -> Tensor:
    """Recall after `at` passes, and the share of right boxes after the last, for each way of looking at pictures.

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
        line, boxes = curve(chosen, max(at)), sum(record["boxes"] for record in chosen)
        precision = sum(record["right"] for record in chosen) / boxes if boxes else torch.nan
        rows.append([*(line[n - 1] for n in at), precision])
    return torch.tensor(rows, dtype=torch.float64)


def recall_cells(value: Tensor, error: Tensor, sign: str = "") -> tuple[list[str], str]:
    """Cells of a table row for figures of `recall_and_precision` and their standard errors: recall, and precision."""
    cells = [f"{each:{sign}.3f} ± {apart:.3f}" for each, apart in zip(value.tolist(), error.tolist(), strict=True)]
    return cells[:-1], cells[-1] if value[-1].isfinite() else "-"


def _curves(records: list[ResultRecord], run: ZoomRun):  # type: ignore[no-untyped-def]
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    for way in dict.fromkeys(record["way"] for record in records if record["measure"] == "recall"):
        group = [record for record in records if record["way"] == way and record["measure"] == "recall"]
        axes.plot(range(1, run.config.passes + 1), curve(group, run.config.passes), label=way)
    axes.set(xlabel="passes of the detector", ylabel="recall", ylim=(0, None))
    axes.legend(fontsize="small")
    return save_figure(figure, run.config.out / "recall.png")
