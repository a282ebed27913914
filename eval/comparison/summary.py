"""Output that all runs share: tables, per-episode records and the manifest."""

import json
import platform
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch

from eval.comparison.looking import ComparedLooking
from eval.comparison.records import gather
from semfov.io.files import inside, replacing, write_text
from semfov.io.state import without_settings
from semfov.io.storage import checksum
from semfov.io.tables import csv_text
from semfov.metrics.episodes import FloatArray, standard_error
from semfov.runs.results import ResultRecord
from semfov.runs.setup import observation_name
from semfov.runs.tables import percent
from semfov.version import __version__
from train.outputs import commit

_Value = TypeVar("_Value", float, FloatArray)
"""A number, or a curve."""


@dataclass(frozen=True)
class Curve:
    """A measure after 0, 1, … gaze shifts: its mean, and its standard errors over images and over repetitions."""

    mean: FloatArray
    over_images: FloatArray
    over_repetitions: FloatArray
    images: int
    episodes: int


def curve_of(records: Iterable[ResultRecord], measure: Callable[[ResultRecord], FloatArray]) -> Curve:
    """Average episodes: first over the episodes of each image, then over images."""
    episodes: list[tuple[Any, FloatArray]] = []
    by_repetition: dict[int, list[tuple[Any, FloatArray]]] = defaultdict(list)
    for record in records:
        episode = (record["scene"], measure(record))
        episodes.append(episode)
        by_repetition[record["repetition"]].append(episode)
    of_images = np.stack([*by_scene(episodes).values()])
    of_repetitions = np.stack([np.mean([*by_scene(group).values()], axis=0) for group in by_repetition.values()])
    return Curve(
        mean=of_images.mean(0),
        over_images=standard_error(of_images),
        over_repetitions=standard_error(of_repetitions),
        images=len(of_images),
        episodes=len(episodes),
    )


def collect_records(run: ComparedLooking) -> tuple[list[ResultRecord], dict[str, float]]:
    """Read records of all scenes, sorted by policy, and the seconds that each stage took."""
    stored = gather(run)
    order = {policy: number for number, policy in enumerate(run.policies)}
    return sorted(stored, key=lambda record: order.get(record["policy"], len(order))), stored.seconds


def by_scene(values: Iterable[tuple[Any, _Value]]) -> dict[Any, _Value]:
    """Mean value of each scene, from pairs of scene and value.

    >>> {scene: float(mean) for scene, mean in by_scene([(7, 1.0), (7, 2.0), (8, 5.0)]).items()}
    {7: 1.5, 8: 5.0}
    """
    scenes: dict[Any, list[_Value]] = defaultdict(list)
    for scene, value in values:
        scenes[scene].append(value)
    return {scene: np.mean(group, axis=0) for scene, group in scenes.items()}


def write_texts(folder: Path, files: Mapping[str, str]) -> list[Path]:
    """Write texts by the names of their files into a folder; returns the paths."""
    for name, text in files.items():
        write_text(inside(folder, name), text)
    return [folder / name for name in files]


def write_summary(out: Path, name: str, text: str, records: Iterable[ResultRecord]) -> list[Path]:
    """Write the tables as Markdown, and the records that they summarise; returns the paths of both files."""
    return [*write_texts(out, {f"{name}.md": text}), _write_lines(out / "records.jsonl", records)]


def _write_lines(path: Path, records: Iterable[ResultRecord]) -> Path:
    """Write records as JSON, one in a line, as they are read; returns the path."""
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.writelines(json.dumps(record) + "\n" for record in records)
    return path


def write_files(
    run: ComparedLooking,
    program: str,
    tables: dict[str, str],
    records: Iterable[ResultRecord],
    seconds: dict[str, float],
) -> list[Path]:
    """Write tables (text by file name), records, settings and manifest; returns the paths."""
    out = run.config.out
    files = {"config.yaml": run.config.yaml(), MANIFEST: manifest(run, program, seconds)}
    return [*write_texts(out, tables), _write_lines(out / "episodes.jsonl", records), *write_texts(out, files)]


def announce(summary: str, written: Iterable[Path]) -> None:
    """Print the tables and the paths of the written files."""
    print(summary)
    print("written:")
    for path in written:
        print(f"  {path}")


def curves_csv(curves: dict[str, dict[str, Curve]], head: tuple[str, str]) -> str:
    """Write the curves by average and policy as CSV, a row for each number of shifts; `head` names what they are."""
    average, value = head
    errors = ["error_over_images", "error_over_repetitions"]
    rows: list[list[object]] = [[average, "policy", "shifts", value, *errors, "images", "episodes"]]
    for average, policies in curves.items():
        for policy, curve in policies.items():
            columns = zip(curve.mean, curve.over_images, curve.over_repetitions, strict=True)
            for shift, figures in enumerate(columns):
                cells = [f"{figure:.6f}" for figure in figures]
                rows.append([average, policy, shift, *cells, curve.images, curve.episodes])
    return csv_text(rows)


def curve_rows(curves: dict[str, Curve], shifts: Iterable[int]) -> list[list[str]]:
    """Write a table row for each policy: its curve at these gaze shifts, in percent, with both standard errors."""
    return [
        [
            name,
            *(percent(curve.mean[n], curve.over_images[n]) for n in shifts),
            f"{100 * curve.over_repetitions.max():.2f}",
        ]
        for name, curve in curves.items()
    ]


LAST_COLUMN = "max. SEM over repetitions"
"""Heading of the last column of `curve_rows`: the largest standard error of the mean over the starts (published)."""

MANIFEST = "manifest.json"
"""Name of the file that says where the results of a run come from; it is written when the run has ended."""


def manifest(run: ComparedLooking, program: str, seconds: dict[str, float]) -> str:
    """Provenance of the results as JSON: commit, day, versions, checksums, seed, and the time of each stage."""
    record = {
        "command": ["python", "-m", program, *sys.argv[1:]],
        "commit": commit(),
        "date": datetime.now(UTC).date().isoformat(),
        "scenes": len(run.scenes),
        "versions": {
            "semfov": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
        "machine": platform.machine(),
        "run_key": run.key,
        "code_sha256": run.code,
        "store_key": run.store.key,
        "saliency_keys": {name: store.key for name, store in run.saliency_stores.items()},
        "scenes_sha256": run.scenes.fingerprint,
        "eye": run.eye.settings(),
        "model_sha256": None
        if run.models.observation is None
        else checksum(without_settings(run.models.observation.state_dict())),
        "seed": run.config.protocol.seed,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
    }
    return json.dumps(record, indent=2) + "\n"


def sensing(run: ComparedLooking) -> str:
    """Name detector, sensor and observation model of a run, for titles."""
    sensor = run.eye.sensor
    description = sensor.describe(sensor.settings())
    text = f"{run.eye.detector.name}, {run.config.sensor.name} fovea ({description})"
    if run.models.observation is None:
        return text
    model = run.config.belief.model or observation_name(run.eye)
    return f"{text}, observation model {Path(model).name.removesuffix('.safetensors')}"
