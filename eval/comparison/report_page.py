"""The HTML page of a run: curves, tables, and some episodes to step through."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import yaml

from eval.comparison.curves_html import curves_html
from eval.comparison.looking import ComparedLooking
from eval.comparison.replay import replay
from eval.comparison.summary import LAST_COLUMN, Curve, curve_rows
from semfov.metrics.episodes import FloatArray
from semfov.paths.stimulus import Stimulus
from semfov.report.episode import Data, episode_data
from semfov.report.markup import table_html
from semfov.report.page import write_page
from semfov.runs.config import WHERE
from semfov.runs.results import ResultRecord

_MOST_BYTES = 4_500_000
"""Size of a page in bytes from which no further episode is added."""

_BYTES_OF_VALUE = 7  # of a value in the text of the page


def write_run_report(
    run: ComparedLooking,
    records: list[ResultRecord],
    curves: Mapping[str, dict[str, Curve]],
    *,
    titles: Mapping[str, str],
    label: str,
    shifts: Sequence[int],
    others: Mapping[str, FloatArray] | None = None,
    episodes: int = 18,
) -> Path:
    """Write `report.html` to the folder of a run.

    Args:
        run: the run.
        records: its records.
        curves: for each way to average, the curves of the policies.
        titles: title of each way to average.
        label: what the curves show.
        shifts: numbers of gaze shifts of the tables.
        others: curves of others, for comparison, which join the first way to average.
        episodes: largest number of episodes to step through.

    Returns:
        The path of the page.
    """
    sections = []
    for number, (average, policies) in enumerate(curves.items()):
        joined = others if others and number == 0 else {}
        sections.append(_section(titles[average], label, policies, joined, shifts))
    values = {name: value for name, value in run.config.plain().items() if name not in WHERE}
    settings = escape(yaml.safe_dump(values, sort_keys=False))
    sections.append(f'<details><summary>Settings</summary><pre class="wide">{settings}</pre></details>')
    data = _episodes(run, _choose_episodes(records, list(run.policies), episodes))
    title = f"semfov: {run.task} with {run.eye.detector.name}"
    return write_page(run.config.out / "report.html", title, data, sections="\n".join(sections))


def _section(
    title: str,
    label: str,
    policies: dict[str, Curve],
    others: Mapping[str, FloatArray],
    shifts: Sequence[int],
) -> str:
    """Draw the curves of policies and of others, with a table of their values after some numbers of gaze shifts."""
    first = next(iter(policies.values()))
    means = {name: curve.mean for name, curve in policies.items()} | dict(others)
    errors = {name: curve.over_images for name, curve in policies.items()}
    columns = [number for number in shifts if number < len(first.mean)]
    rows = [["policy", *map(str, columns), LAST_COLUMN], *curve_rows(policies, columns)]
    for name, mean in others.items():
        rows.append([name, *(f"{100 * mean[number]:.1f}" for number in columns), ""])
    caption = f"{label} after n gaze shifts ± standard error over {first.images} images, {first.episodes} episodes"
    heading = escape(title)
    return (
        f"<section><h2>{heading[:1].upper()}{heading[1:]}</h2>\n"
        f"{curves_html(means, errors, label)}{table_html(rows, caption)}</section>"
    )


def _choose_episodes(records: list[ResultRecord], policies: Sequence[str], count: int) -> list[ResultRecord]:
    """Choose records to show: in each scene the same episode with all policies side by side.

    The episode of a scene is the one from the first start, in searches for the commonest target.
    """
    order = {policy: number for number, policy in enumerate(policies)}
    groups: dict[Any, list[ResultRecord]] = defaultdict(list)
    for record in records:
        if record["repetition"] == 0 and record.get("commonest", True) and record["policy"] in order:
            groups[record["scene"]].append(record)
    chosen: list[ResultRecord] = []
    for group in groups.values():
        if len(chosen) >= count:
            break
        chosen += sorted(group, key=lambda record: order[record["policy"]])
    return chosen


def _episodes(run: ComparedLooking, records: Sequence[ResultRecord]) -> list[Data]:
    """Describe episodes for the page, as many as it has room for."""
    settings = run.eye.settings()
    episodes: list[Data] = []
    size = 0
    pictures = set[str]()  # the page holds each picture once
    for record in records:
        if sum(map(len, pictures)) + size > _MOST_BYTES:
            break
        index = list(run.scenes.ids).index(record["scene"])
        scene = run.scenes[index]
        scanpath = replay(run, index, record)
        views = Stimulus.of(run.eye, scene.image).views(scanpath.fixations)
        boxes = None if scanpath.target is None else scene.boxes[scene.labels == scanpath.target]
        episode = episode_data(
            scanpath,
            scene.image,
            views,
            name=f"{scene.name}, {record['policy']}",
            settings=settings,
            boxes=boxes,
            classes=10,
            width=256,
            quality=60,
        )
        episodes.append(episode)
        shown = [episode["image"], *(fixation["view"] for fixation in episode["fixations"])]
        pictures.update(picture for picture in shown if picture is not None)
        size += sum(len(quantised["data"]) for quantised in (*episode["maps"], episode["entropy"]))
        size += _BYTES_OF_VALUE * scanpath.values.numel()
    return episodes
