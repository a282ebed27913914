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
    """Write `report.html` to the folder of a run."""
    sections = []
    for order, (average, policies) in enumerate(curves.items()):
        first = next(iter(policies.values()))
        added = dict(others or {}) if order == 0 else {}
        means = {**{name: curve.mean for name, curve in policies.items()}, **added}
        errors = {name: curve.over_images for name, curve in policies.items()}
        at = [n for n in shifts if n < len(first.mean)]
        rows = [["policy", *(str(n) for n in at), LAST_COLUMN], *curve_rows(policies, at)]
        rows += [[name, *(f"{100 * curve[n]:.1f}" for n in at), ""] for name, curve in added.items()]
        caption = f"{label} after n gaze shifts ± standard error over {first.images} images, {first.episodes} episodes"
        title = escape(titles[average])
        sections.append(f"<section><h2>{title[:1].upper()}{title[1:]}</h2>")
        sections.append(curves_html(means, errors, label) + table_html(rows, caption) + "</section>")
    values = {name: value for name, value in run.config.plain().items() if name not in WHERE}
    settings = escape(yaml.safe_dump(values, sort_keys=False))
    sections.append(f'<details><summary>Settings</summary><pre class="wide">{settings}</pre></details>')
    data = _episodes(run, _choose_episodes(records, list(run.policies), episodes))
    title = f"semfov: {run.task} with {run.eye.detector.name}"
    return write_page(run.config.out / "report.html", title, data, sections="\n".join(sections))


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
    data, size, settings, pictures = [], 0, run.eye.settings(), set[str]()
    for record in records:
        if sum(map(len, pictures)) + size > _MOST_BYTES:
            break
        index = list(run.scenes.ids).index(record["scene"])
        scene, scanpath = run.scenes[index], replay(run, index, record)
        views = Stimulus.of(run.eye, scene.image).views(scanpath.fixations)
        boxes = None if scanpath.target is None else scene.boxes[scene.labels == scanpath.target]
        name = f"{scene.name}, {record['policy']}"
        data.append(
            episode_data(
                scanpath,
                scene.image,
                views,
                name=name,
                settings=settings,
                boxes=boxes,
                classes=10,
                width=256,
                quality=60,
            )
        )
        shown = [data[-1]["image"], *(each["view"] for each in data[-1]["fixations"])]
        pictures.update(picture for picture in shown if picture is not None)
        size += sum(len(each["data"]) for each in [*data[-1]["maps"], data[-1]["entropy"]])
        size += 7 * scanpath.values.numel()
    return data
