"""Output that all runs share: tables, per-episode records and the manifest."""

import csv
import io
import json
import platform
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

from semfov.errors import DataError
from semfov.experiments.parallel import rank
from semfov.experiments.parts import Record
from semfov.experiments.run import Run, SceneRun, finish
from semfov.experiments.setup import fovea_of, plain
from semfov.io.compatibility import recommended
from semfov.io.files import inside, write_text
from semfov.io.storage import checksum
from semfov.metrics.averages import standard_error
from semfov.version import __version__

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Curve:
    """A measure after 0, 1, … gaze shifts: its mean, and its standard errors over images and over repetitions."""

    mean: Array
    over_images: Array
    over_repetitions: Array
    images: int
    episodes: int


def curve_of(records: Iterable[Record], measure: Callable[[Record], Array]) -> Curve:
    """Average episodes: first over the episodes of each image, then over images.

    Args:
        records: records of one policy.
        measure: maps an episode's record to its measure after 0, 1, … gaze shifts.

    Returns:
        The mean curve with its standard errors.
    """
    images: dict[Any, list[Array]] = defaultdict(list)
    repetitions: dict[int, dict[Any, list[Array]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        curve = measure(record)
        images[record["scene"]].append(curve)
        repetitions[record["repetition"]][record["scene"]].append(curve)

    def per_image(groups: dict[Any, list[Array]]) -> Array:
        return np.stack([np.mean(group, axis=0) for group in groups.values()])

    means = per_image(images)
    return Curve(
        means.mean(0),
        standard_error(means),
        standard_error(np.stack([per_image(groups).mean(0) for groups in repetitions.values()])),
        len(means),
        sum(map(len, images.values())),
    )


def collect(run: Run) -> tuple[list[Record], dict[str, float]]:
    """Records of all scenes, sorted by policy, and the seconds that each stage took."""
    records, seconds = gather(run)
    order = {policy: number for number, policy in enumerate(run.policies)}
    records.sort(key=lambda record: order.get(record["policy"], len(order)))
    return records, seconds


def complete(run: SceneRun, title: str) -> list[Record] | None:
    """Run all scenes that are not finished yet.

    Args:
        run: the run.
        title: label of the progress bar.

    Returns:
        The records of all scenes; None in a process of torchrun that does not write the report.
    """
    finish(run, title)
    return gather(run)[0] if rank() == 0 else None


def by_scene(values: Iterable[tuple[Any, float]]) -> dict[Any, float]:
    """Mean value of each scene, from pairs of scene and value.

    Args:
        values: the pairs.

    Returns:
        The mean by scene.

    >>> by_scene([(7, 1.0), (7, 2.0), (8, 5.0)])
    {7: 1.5, 8: 5.0}
    """
    scenes: dict[Any, list[float]] = defaultdict(list)
    for scene, value in values:
        scenes[scene].append(value)
    return {scene: float(np.mean(group)) for scene, group in scenes.items()}


def gather(run: SceneRun) -> tuple[list[Record], dict[str, float]]:
    """Records of all scenes in their order, and the seconds that each stage took."""
    records: list[Record] = []
    seconds: dict[str, float] = defaultdict(float)
    for index in range(len(run.scenes)):
        part = run.parts.load(index)
        if part is None:
            raise DataError(f"{run.parts.path(index)} is missing or damaged; run the same command again")
        records += part["records"]
        for stage, value in part["seconds"].items():
            seconds[stage] += value
    return records, dict(seconds)


def write_summary(out: Path, name: str, text: str, records: list[Record]) -> list[Path]:
    """Write the tables as Markdown, and the records that they summarise; returns the paths of both files."""
    files = {f"{name}.md": text, "records.jsonl": "".join(json.dumps(record) + "\n" for record in records)}
    for file, content in files.items():
        write_text(out / file, content)
    return [out / file for file in files]


def write_files(
    run: Run,
    program: str,
    tables: dict[str, str],
    records: list[Record],
    seconds: dict[str, float],
) -> list[Path]:
    """Write tables (text by file name), records, settings and manifest; returns the paths of all files."""
    files = {
        **tables,
        "episodes.jsonl": "".join(json.dumps(record) + "\n" for record in records),
        "config.yaml": yaml.safe_dump(plain(asdict(run.config)), sort_keys=False),
        "manifest.json": json.dumps(manifest(run, program, seconds), indent=2) + "\n",
    }
    for name, text in files.items():
        write_text(inside(run.config.out, name), text)
    return [run.config.out / name for name in files]


def announce(summary: str, written: Iterable[Path]) -> None:
    """Print the tables and the paths of the written files."""
    print(summary)
    print("written:")
    for path in written:
        print(f"  {path}")


def curves_csv(curves: dict[str, dict[str, Curve]], head: tuple[str, str]) -> str:
    """The curves as CSV, with one row for each average, policy and number of gaze shifts.

    Args:
        curves: curves by average and policy.
        head: column headings of the averages and of the values.

    Returns:
        The text of the CSV file.
    """
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    average, value = head
    errors = ["error_over_images", "error_over_repetitions"]
    rows.writerow([average, "policy", "shifts", value, *errors, "images", "episodes"])
    for average, policies in curves.items():
        for policy, curve in policies.items():
            for shift in range(len(curve.mean)):
                figures = (f"{values[shift]:.6f}" for values in (curve.mean, curve.over_images, curve.over_repetitions))
                rows.writerow([average, policy, shift, *figures, curve.images, curve.episodes])
    return text.getvalue()


def curve_rows(curves: dict[str, Curve], shifts: Iterable[int]) -> list[list[str]]:
    """A table row for each policy: its curve at these gaze shifts, in percent, with both standard errors."""
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


def percent(value: float, error: float) -> str:
    """A share and its standard error in percent, such as `12.3 ± 0.4`."""
    return f"{100 * value:.1f} ± {100 * error:.1f}" if np.isfinite(error) else f"{100 * value:.1f}"


def table(rows: list[list[str]]) -> list[str]:
    """A Markdown table with aligned columns; the first row holds the headings."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def manifest(run: Run, program: str, seconds: dict[str, float]) -> dict[str, object]:
    """Provenance of the results: versions, commit, checksums and seed; and the time that each stage took."""
    return {
        "command": ["python", "-m", program, *sys.argv[1:]],
        "commit": commit(),
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
        "model_sha256": None if run.models.observation is None else checksum(run.models.observation.state_dict()),
        "seed": run.config.protocol.seed,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
    }


def commit() -> str | None:
    """Commit of the git checkout, followed by `+` if it has uncommitted changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def sensing(run: Run) -> str:
    """Detector, sensor and observation model of a run, as text for titles."""
    sensor, model = run.config.sensor, run.config.belief.model
    spread = fovea_of(run.eye)
    what = f"{run.eye.detector.name}, {sensor.name} fovea (σ {float(spread.sigma):g} px, growth {spread.growth:g})"
    if run.models.observation is None:
        return what
    own = model or recommended(run.eye.detector.name, float(spread.growth))
    return f"{what}, observation model {Path(own).stem}"
