"""What a search run leaves: tables, curves, per-episode records, scanpaths and the manifest."""

import csv
import io
import json
import platform
import subprocess
import sys
import time
from collections import defaultdict
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from numpy.typing import NDArray

import semfov
from eval.cached import checksum
from eval.metrics import cumulative_performance, random_search, standard_error
from eval.protocol import Looks
from eval.setup import plain
from eval.tasks import Parts, SearchRun
from semfov.errors import DataError
from semfov.files import replacing, write_text
from semfov.gaze import select_fixation
from semfov.scanpath import Scanpath

SHIFTS = (1, 5, 10, 15, 30)
"""Gaze shifts at which tables show the cumulative performance."""

AVERAGES = {
    "all targets": "mean over images, every legal target of an image",
    "commonest": "mean over images, the target class with most instances",
}


@dataclass(frozen=True)
class Curve:
    """Cumulative performance of a policy: its mean, and standard errors over images and over repetitions."""

    mean: NDArray[np.float64]
    over_images: NDArray[np.float64]
    over_repetitions: NDArray[np.float64]
    images: int
    episodes: int


def report(run: SearchRun, parts: Parts) -> None:
    """Write everything that a finished run leaves, and print the table."""
    records, seconds = collect(run, parts)
    out, policies, shifts = run.config.out, run.config.policies, run.config.protocol.shifts
    curves = {
        average: {policy: curve_of(records, policy, shifts, average == "commonest") for policy in policies}
        for average in AVERAGES
    }
    expected = expected_random(records, shifts, run.config.belief.columns * run.config.belief.rows)
    decision = {policy: milliseconds_per_decision(run, policy) for policy in policies}
    lines = "".join(json.dumps(record) + "\n" for record in records)
    write_text(out / "episodes.jsonl", lines)
    write_text(out / "summary.csv", summary_csv(curves))
    summary = summary_markdown(run, curves, expected, decision)
    write_text(out / "summary.md", summary)
    write_text(out / "config.yaml", resolved_config(run))
    write_text(out / "manifest.json", json.dumps(manifest(run, seconds, decision), indent=2) + "\n")
    written = [out / name for name in ("summary.md", "summary.csv", "episodes.jsonl", "config.yaml", "manifest.json")]
    written += [draw_curves(run, curves["all targets"], expected), *draw_scanpaths(run, records)]
    print(summary)
    print("written:")
    for path in written:
        print(f"  {path}")


def collect(run: SearchRun, parts: Parts) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Records of all scenes in order, and the seconds spent by stage."""
    records: list[dict[str, Any]] = []
    seconds: dict[str, float] = defaultdict(float)
    for index in range(len(run.scenes)):
        part: Any = parts.load(index)
        if part is None:
            raise DataError(f"{parts.path(index)} is missing or damaged; run the same command again")
        records += part["records"]
        for stage, value in part["seconds"].items():
            seconds[stage] += value
    order = {policy: number for number, policy in enumerate(run.config.policies)}
    records.sort(key=lambda record: order[record["policy"]])
    if not records:
        raise DataError("data: no scene has a class that may be searched for; raise data.max_target_area")
    return records, dict(seconds)


def curve_of(records: list[dict[str, Any]], policy: str, shifts: int, commonest: bool) -> Curve:
    """Cumulative performance of a policy, averaged over the episodes of an image first."""
    found: dict[Any, list[int]] = defaultdict(list)
    by_repetition: dict[int, dict[Any, list[int]]] = defaultdict(lambda: defaultdict(list))
    for record in records:
        if record["policy"] == policy and (record["commonest"] or not commonest):
            found[record["scene"]].append(record["found_at"])
            by_repetition[record["repetition"]][record["scene"]].append(record["found_at"])

    def per_image(groups: dict[Any, list[int]]) -> NDArray[np.float64]:
        return np.stack([cumulative_performance(np.array(group), shifts) for group in groups.values()])

    images = per_image(found)
    repetitions = np.stack([per_image(groups).mean(0) for groups in by_repetition.values()])
    return Curve(
        images.mean(0),
        standard_error(images),
        standard_error(repetitions),
        len(images),
        sum(map(len, found.values())),
    )


def expected_random(records: list[dict[str, Any]], shifts: int, cells: int) -> NDArray[np.float64]:
    """What random search must give on these targets by the hypergeometric formula, mean over images."""
    targets: dict[Any, dict[int, int]] = defaultdict(dict)
    for record in records:
        targets[record["scene"]][record["target"]] = len(record["goal"])
    curves = [
        np.mean([random_search(count, shifts, cells) for count in goals.values()], axis=0) for goals in targets.values()
    ]
    return np.asarray(np.mean(curves, axis=0), dtype=np.float64)


def milliseconds_per_decision(run: SearchRun, name: str, repetitions: int = 50) -> float:
    """Median time from a belief to the next fixation, one episode on one thread."""
    searcher, grid = run.searcher(name), run.grid(0)
    generator = torch.Generator().manual_seed(0)
    start = searcher.observer.start(1, grid, torch.empty(0)).beta
    beta = start + torch.rand(start.shape, generator=generator)
    visited, noise = torch.zeros(1, len(grid), dtype=torch.bool), torch.rand(1, len(grid), generator=generator)
    acquisition = searcher.policy(searcher.observer.component(torch.tensor([1])), grid)
    times = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.inference_mode():
            for _ in range(repetitions):
                began = time.perf_counter()
                select_fixation(acquisition(beta), visited, noise)
                times.append(time.perf_counter() - began)
    finally:
        torch.set_num_threads(threads)
    return 1000 * float(np.median(times))


def summary_csv(curves: dict[str, dict[str, Curve]]) -> str:
    """The curves as a table, one row for each average, policy and number of gaze shifts."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        [
            "average",
            "policy",
            "shifts",
            "performance",
            "error_over_images",
            "error_over_repetitions",
            "images",
            "episodes",
        ]
    )
    for average, policies in curves.items():
        for policy, curve in policies.items():
            for shift in range(len(curve.mean)):
                figures = (f"{values[shift]:.6f}" for values in (curve.mean, curve.over_images, curve.over_repetitions))
                table.writerow([average, policy, shift, *figures, curve.images, curve.episodes])
    return text.getvalue()


def summary_markdown(
    run: SearchRun,
    curves: dict[str, dict[str, Curve]],
    expected: NDArray[np.float64],
    decision: dict[str, float],
) -> str:
    """The tables that the run prints: cumulative performance with standard errors over images."""
    shifts = [n for n in SHIFTS if n <= run.config.protocol.shifts]
    head = ["policy", *(f"CP@{n}" for n in shifts), "ms / decision"]
    lines = []
    for average, policies in curves.items():
        first = next(iter(policies.values()))
        lines += [
            f"**{AVERAGES[average]}** ({first.images} images, {first.episodes} searches per policy; "
            "% found after n gaze shifts ± standard error over images)",
            "",
        ]
        rows = [
            [name, *(_percent(curve.mean[n], curve.over_images[n]) for n in shifts), f"{decision[name]:.2f}"]
            for name, curve in policies.items()
        ]
        if average == "all targets":
            rows.append(["random, by formula", *(f"{100 * expected[n]:.1f}" for n in shifts), ""])
        lines += [*table([head, *rows]), ""]
    return "\n".join(lines)


def _percent(value: float, error: float) -> str:
    return f"{100 * value:.1f} ± {100 * error:.1f}" if np.isfinite(error) else f"{100 * value:.1f}"


def table(rows: list[list[str]]) -> list[str]:
    """A Markdown table, its columns aligned; the first row is the head."""
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    lines = [
        "| " + " | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) + " |" for row in rows
    ]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def resolved_config(run: SearchRun) -> str:
    """Every setting of the run as YAML, ready for `--config`."""
    return yaml.safe_dump(plain(asdict(run.config)), sort_keys=False)


def manifest(run: SearchRun, seconds: dict[str, float], decision: dict[str, float]) -> dict[str, object]:
    """Where the figures come from: versions, commit, checksums, seed, and where the time went."""
    return {
        "command": ["python", "-m", "eval.search", *sys.argv[1:]],
        "commit": commit(),
        "versions": {
            "semfov": semfov.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
        "machine": platform.machine(),
        "run_key": run.key,
        "store_key": run.store.key,
        "scenes_sha256": run.scenes.fingerprint,
        "eye": run.eye.settings(),
        "model_sha256": None if run.model is None else checksum(run.model.state_dict()),
        "seed": run.config.protocol.seed,
        "seconds": {stage: round(value, 3) for stage, value in seconds.items()},
        "milliseconds_per_decision": {name: round(value, 4) for name, value in decision.items()},
    }


def commit() -> str | None:
    """Commit of the checkout, with `+` where it has changes; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        return git("rev-parse", "HEAD") + ("+" if git("status", "--porcelain") else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def draw_curves(run: SearchRun, curves: dict[str, Curve], expected: NDArray[np.float64]) -> Path:
    """The cumulative-performance figure."""
    from semfov.viz import plot_cumulative_performance

    figure = plot_cumulative_performance(
        {**{name: curve.mean for name, curve in curves.items()}, "random, by formula": expected},
        {name: curve.over_images for name, curve in curves.items()},
        title=f"Visual search, {run.eye.detector.name}, fovea {run.config.sensor.sigma:g} px",
    )
    return save_figure(figure, run.config.out / "cumulative_performance.png")


def save_figure(figure: Any, path: Path) -> Path:
    """Save a matplotlib figure atomically."""
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=150, format=path.suffix[1:])
    return path


def draw_scanpaths(run: SearchRun, records: list[dict[str, Any]]) -> list[Path]:
    """Pictures of a few episodes of the last policy, of different scenes, those with a few gaze shifts first."""
    from semfov.viz import plot_episode

    last = [record for record in records if record["policy"] == run.config.policies[-1]]
    last.sort(key=lambda record: (record["found_at"] < 0, not 2 <= record["found_at"] <= 6))
    chosen = list({record["scene"]: record for record in reversed(last)}.values())
    chosen.sort(key=last.index)
    paths = []
    for record in chosen[: run.config.scanpaths]:
        index = run.scenes.ids.index(record["scene"])
        scene = run.scenes[index]
        scanpath = replay(run, index, record)
        views = foveated_views(run, index, scanpath)
        boxes = scene.boxes[scene.labels == record["target"]]
        name = f"scanpath_{record['scene']}_{record['target_name'].replace(' ', '-')}.png"
        paths.append(save_figure(plot_episode(scanpath, scene.image, views, boxes=boxes), run.config.out / name))
    return paths


def replay(run: SearchRun, index: int, record: dict[str, Any]) -> Scanpath:
    """The scanpath of a recorded episode, with what was seen and believed at each fixation."""
    grid, detections, target = run.grid(index), run.detections(index), int(record["target"])
    searcher = run.searcher(record["policy"])
    observer = searcher.observer
    looks = Looks(observer, detections, grid, [target])
    acquisition = searcher.policy(observer.component(target), grid)
    belief = observer.start(1, grid, detections.scores)
    cells = torch.tensor(record["cells"])
    beliefs, values = [], []
    with torch.no_grad():
        for cell in cells:
            belief = observer.update(belief, looks(torch.tensor([target]), cell[None]))
            beliefs.append(belief.beta[0])
            values.append(acquisition(belief.beta)[0])
    return Scanpath(
        grid=grid,
        classes=("background", *run.scenes.classes),
        target=record["target"],
        cells=cells,
        fixations=grid.centres[cells],
        detections=tuple(detections[cell[None]] for cell in cells),
        beliefs=torch.stack(beliefs),
        values=torch.stack(values),
        found=record["found_at"] >= 0,
    )


def foveated_views(run: SearchRun, index: int, scanpath: Scanpath) -> list[torch.Tensor]:
    """What the detector was shown at each fixation, cut out of the canvas and back at the size of the image."""
    from semfov.detection.placement import resize

    image = run.scenes[index].image
    with torch.no_grad():
        view = run.eye.open(image[None])
        canvases = run.eye.foveated(view, scanpath.fixations)
    placement = view.placement
    left, top = placement.offset
    width, height = (round(n * s) for n, s in zip(placement.size, placement.scale, strict=True))
    inner = canvases[..., top : top + height, left : left + width]
    return list(resize(inner, placement.size))
