"""Runs the study to its end, and writes its tables and its figure."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from functools import reduce
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.comparison.summary import announce, write_summary
from eval.stream.identity import IdentityCounts
from eval.stream.misses import ERRORS, MissCounts, miss_rows
from eval.stream.run import FILM, StreamConfig, StreamOutcome, StreamRun
from eval.stream.ways import CANDIDATES, SLICES
from eval.zoom.objects import average_precision
from semfov.agents.window_episode import LIKELY
from semfov.errors import check_data
from semfov.runs.results import ResultRecord
from semfov.runs.tables import plus_minus, table
from semfov.viz.style import save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_PROBABILITIES = 0.1, 0.3, 0.5, 0.7, 0.9, 1.0  # borders of the ranges of a table of reliability

_By = dict[str, dict[int, list[ResultRecord]]]
"""Records by way of looking and frame."""


class PrecisionAtPasses(NamedTuple):
    """AP50 of a way of looking that takes a number of passes a frame, with its standard error."""

    passes: int
    value: float
    error: float


def stream(config: StreamConfig) -> None:
    """Look at all streams, and write the tables, the records, and for several numbers of passes their figure."""
    outcomes = [*StreamRun(config).outcomes()]
    records = [record for outcome in outcomes for record in outcome.records]
    last = max((record["frame"] for record in records), default=0)
    what = f"a frame after frame {config.after} whose number is a multiple of {config.every}"
    check_data(last > config.after, "stream", what, "none; lower every and after")
    text = stream_summary(outcomes, config)
    written = write_summary(config.out, "stream", text, records)
    if len(config.passes) > 1:
        written.append(save_figure(plot_passes(outcomes, config.after), config.out / "passes.png"))
    announce(text, written)


def stream_summary(outcomes: Sequence[StreamOutcome], config: StreamConfig) -> str:
    """Write the tables, as Markdown."""
    courses = dict.fromkeys(outcome.course for outcome in outcomes)
    lines: list[str] = []
    for course in courses:
        lines += course_tables(course, [outcome for outcome in outcomes if outcome.course == course], config)
    return "\n".join([*lines, *drift_table(outcomes)])


def course_tables(course: str, outcomes: Sequence[StreamOutcome], config: StreamConfig) -> list[str]:
    """Tables of one course: AP50, and precision and recall of what is listed, by frame."""
    by = by_way([record for outcome in outcomes for record in outcome.records])
    frames = sorted(next(iter(by.values())))
    heads = [*map(str, frames), f"all after {config.after}"]
    precisions = [["", *heads, "of all slices", "passes a frame", "ms a frame"]]
    listed = [["", *heads]]
    figures = Bootstrap.of(precision_figures(by, config.after), range(len(outcomes)))
    values = dict(zip(by, figures.value.tolist(), strict=True))
    errors = (figures.error if len(outcomes) > 1 else torch.full_like(figures.value, torch.nan)).tolist()
    of_slices = sum(value for way, value in values.items() if way.startswith(SLICES))
    for error, (way, records) in zip(errors, by.items(), strict=True):
        chosen = [*records.values(), [each for frame in frames if frame > config.after for each in records[frame]]]
        cells = [f"{precision_of(group):.2f}" for group in chosen[:-1]]
        cells.append(plus_minus(values[way], error, 3))
        cells.append(f"{values[way] / of_slices:.2f}" if of_slices > 0 else "-")
        milliseconds = sum(outcome.costs[way].milliseconds for outcome in outcomes) / len(outcomes)
        precisions.append([way, *cells, str(outcomes[0].costs[way].passes), f"{milliseconds:.0f}"])
        listed.append([way, *map(listed_cell, chosen)])
    objects = sum(record["objects"] for group in next(iter(by.values())).values() for record in group)
    what = (
        "The frames of a film"
        if course == FILM
        else f"Course “{course}” ({outcomes[0].title}), {len(outcomes)} flights"
    )
    return [
        f"{what}: AP50 of {config.target} at the judged frames, with {objects} annotated objects. ± is the standard "
        "error by bootstrap over flights, and ms are of the processor.",
        "",
        *table(precisions),
        "",
        f"Precision / recall of the objects that are listed: of the agent from probability {LIKELY} on, of others from "
        "this score.",
        "",
        *table(listed),
        "",
        *reliability_table(by, config.after),
        *identity_table(outcomes, config.after),
        *miss_tables(outcomes, config.after),
    ]


def reliability_table(by: _By, after: int) -> list[str]:
    """Table of how much of what has a probability is right, of the candidates of the agent; empty without it."""
    rows = [["", *(f"{low:g} to {high:g}" for low, high in pairwise(_PROBABILITIES))]]
    for way, frames in by.items():
        if way.startswith(CANDIDATES):
            records = [record for frame, group in frames.items() if frame > after for record in group]
            rows.append([way, *reliability_cells(records)])
    if len(rows) == 1:
        return []
    return ["Share that is right of what has a probability in a range, and how many have it.", "", *table(rows), ""]


def reliability_cells(records: Sequence[ResultRecord]) -> list[str]:
    """Share of right objects and number of objects, by ranges of the probability."""
    scores = torch.tensor([score for record in records for score in record["scores"]])
    right = torch.tensor([value for record in records for value in record["right"]], dtype=torch.bool)
    cells = []
    for low, high in pairwise(_PROBABILITIES):
        inside = (scores >= low) & ((scores < high) | (high == 1))
        count = int(inside.sum())
        cells.append(f"{float(right[inside].float().mean()):.2f} ({count})" if count else "-")
    return cells


def identity_table(outcomes: Sequence[StreamOutcome], after: int) -> list[str]:
    """Table of how well numbers stay with their objects, of the ways that tell numbers; empty without any."""
    rows = [["", "IDF1", "found, of all boxes", "found, of objects that move"]]
    for way in outcomes[0].identities:
        counts = sum((outcome.identities[way] for outcome in outcomes), IdentityCounts(0, 0, 0))
        moving = f"{counts.found / counts.moving:.2f}" if counts.moving else "-"
        rows.append([way, f"{counts.score:.3f}", f"{counts.found_all / max(counts.there, 1):.2f}", moving])
    if len(rows) == 1:
        return []
    return [
        "IDF1 of the objects that are listed, and the share of boxes that are found, in all frames after the first "
        f"{after}.",
        "",
        *table(rows),
        "",
    ]


def miss_tables(outcomes: Sequence[StreamOutcome], after: int) -> list[str]:
    """Tables of what becomes of objects in the lists of the agent; empty where their numbers are not known."""
    lines: list[str] = []
    for way in outcomes[0].misses:
        counts = reduce(MissCounts.joined, (outcome.misses[way] for outcome in outcomes))
        if not counts.objects:
            continue
        errors = ", ".join(f"{counts.errors[kind]} {kind}" for kind in ERRORS)
        lines += [
            f"Why boxes of objects are not listed ({way}), as shares in all frames after the first {after}. Listed "
            f"boxes that are wrong: {errors}.",
            "",
            *table([["", "of all boxes", "of objects that move"], *miss_rows(counts)]),
            "",
        ]
    return lines


def by_way(records: Sequence[ResultRecord]) -> _By:
    """Read the records of each way of looking and frame, in their order."""
    groups: _By = {}
    for record in records:
        groups.setdefault(record["way"], {}).setdefault(record["frame"], []).append(record)
    return groups


def precision_of(records: Sequence[ResultRecord]) -> float:
    """AP50 of the objects of some frames together."""
    scores, right = (torch.tensor([value for each in records for value in each[name]]) for name in ("scores", "right"))
    return average_precision(scores, right.bool(), sum(record["objects"] for record in records))


def precision_figures(by: _By, after: int) -> Callable[[Tensor], Tensor]:
    """Make a function of the indices of streams: AP50 of each way at all judged frames after a number, `(ways,)`."""

    def figures(streams: Tensor) -> Tensor:
        chosen = streams.tolist()
        groups = [[each[n] for n in chosen for frame, each in way.items() if frame > after] for way in by.values()]
        return torch.tensor([precision_of(group) for group in groups], dtype=torch.float64)

    return figures


def precision_over_passes(outcomes: Sequence[StreamOutcome], after: int) -> dict[str, list[PrecisionAtPasses]]:
    """Compute AP50 of the frames of a course after a number, by way of looking, in the order of passes a frame."""
    by = by_way([record for outcome in outcomes for record in outcome.records])
    figures = Bootstrap.of(precision_figures(by, after), range(len(outcomes)))
    # One stream tells nothing of others.
    errors = (figures.error if len(outcomes) > 1 else torch.zeros_like(figures.error)).tolist()
    lines: dict[str, list[PrecisionAtPasses]] = defaultdict(list)
    for way, value, error in zip(by, figures.value.tolist(), errors, strict=True):
        passes = outcomes[0].costs[way].passes
        lines[way.removesuffix(f", {passes} passes")].append(PrecisionAtPasses(passes, value, error))
    return {way: sorted(line) for way, line in lines.items()}


def plot_passes(outcomes: Sequence[StreamOutcome], after: int) -> Figure:
    """Plot AP50 over passes a frame, of the frames after a number; each course has its axes.

    Args:
        outcomes: of all streams.
        after: number of the last frame that is left out.

    Returns:
        The figure, with standard errors over streams.
    """
    from matplotlib.figure import Figure

    courses = dict.fromkeys(outcome.course for outcome in outcomes)
    figure = Figure(figsize=(4.2 * len(courses), 4), layout="constrained")
    all_axes = figure.subplots(1, len(courses), sharey=True, squeeze=False)[0]
    for axes, course in zip(all_axes, courses, strict=True):
        on_course = [outcome for outcome in outcomes if outcome.course == course]
        lines = precision_over_passes(on_course, after)
        for way, line in lines.items():
            axes.errorbar(*zip(*line, strict=True), marker="o", capsize=2, label=way)
        counts = sorted({point.passes for line in lines.values() for point in line})
        axes.set_xscale("log")
        axes.set_xticks(counts, [str(count) for count in counts])
        axes.minorticks_off()
        axes.set(xlabel="passes a frame", title=on_course[0].title, ylim=(0, 1))
    all_axes[0].set_ylabel("AP50")
    all_axes[0].legend(fontsize="small")
    return figure


def listed_cell(records: Sequence[ResultRecord]) -> str:
    """Precision and recall of the listed objects of some frames."""
    right, listed, objects = (sum(each[name] for each in records) for name in ("listed right", "listed", "objects"))
    return f"{right / listed:.2f} / {right / max(objects, 1):.2f}" if listed else f"- / {0:.2f}"


def drift_table(outcomes: Sequence[StreamOutcome]) -> list[str]:
    """Table of the drift of the estimated motion, by course."""
    groups: Mapping[str, list[StreamOutcome]] = {outcome.course: [] for outcome in outcomes}
    for outcome in outcomes:
        groups[outcome.course].append(outcome)
    rows = [["", "frames", "lost", "mean drift in px", "largest", "ms a frame"]]
    for group in groups.values():
        drifts = [outcome.drift for outcome in group]
        pixels = [value for drift in drifts for value in drift.pixels]
        far = [f"{sum(pixels) / len(pixels):.1f}", f"{max(pixels):.1f}"] if pixels else ["-", "-"]
        frames = sum(drift.frames for drift in drifts)
        milliseconds = 1000 * sum(drift.seconds for drift in drifts) / frames
        rows.append(
            [group[0].title, str(frames), str(sum(drift.lost for drift in drifts)), *far, f"{milliseconds:.1f}"]
        )
    return [
        "The motion by `semfov.motion.CameraMotion`: frames that it found to fit none before, and how far the centre "
        "of a frame has drifted from its known place since the first frame.",
        "",
        *table(rows),
        "",
    ]
