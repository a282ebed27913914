"""Regenerate docs/results.md: `python -m eval.results` runs its experiments and fills in the page.

    python -m eval.results --root val2017 --annotations instances_val2017.json --yolox yolox_nano.onnx

The page's text is docs/results.template.md, in which a line `@@ experiment table` stands for a table of an experiment.
What a detector sees is computed once and shared; a run that was stopped goes on where it was.
"""

import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from eval.command import run_command
from eval.config import (
    BeliefConfig,
    DataConfig,
    DetectorConfig,
    ExploreConfig,
    ProtocolConfig,
    RunConfig,
    SaliencyConfig,
    SearchConfig,
)
from eval.explore import explore
from eval.metrics import cumulative_performance, standard_error, success_rate
from eval.report import Array, Record, table
from eval.search import search
from semfov.errors import DataError, lookup
from semfov.files import write_text

PUBLISHED = ("random", "non-predictive-raw", "predictive-raw", "non-predictive-calibrated", "predictive-calibrated")
BEYOND = (
    *PUBLISHED,
    "vocus2",
    "itti-koch",
    "non-predictive-raw+tempered",
    "non-predictive-raw+tempered+central",
    "non-predictive-calibrated+tempered+soft",
    "target-evidence",
)
ABLATIONS = (
    "non-predictive-raw+central",
    "non-predictive-raw+closest",
    "non-predictive-calibrated+tempered+soft+misses",
    "neighbourhood-calibrated+tempered+soft",
    "foveal-hit-calibrated+tempered+soft+misses",
    "place-information-calibrated+tempered+soft+misses",
)
EXPLORE = (
    "random-raw",
    "kl-raw",
    "negative-entropy-raw",
    "two-peaks-raw",
    "vocus2-raw",
    "itti-koch-raw",
    "random-calibrated",
    "kl-calibrated",
    "random-raw+mild",
    "expected-accuracy-raw+misses",
    "closer-look-raw",
    "closer-look-raw+mild",
    "closer-look-calibrated",
)

SENSITIVITY: dict[str, dict[str, dict[str, object]]] = {
    "as published": {},
    "fovea 50 px": {"sensor": {"sigma": 50.0}},
    "fovea 200 px": {"sensor": {"sigma": 200.0}},
    "growth 1": {"sensor": {"growth": 1.0}},
    "background policy uniform": {"detector": {"background": "uniform"}},
    "background policy none": {"detector": {"background": "none"}},
    "score threshold 0.1": {"detector": {"threshold": 0.1}},
    "prior 0.1": {"belief": {"prior": 0.1}},
    "prior 2": {"belief": {"prior": 2.0}},
    "footprint centre": {"belief": {"footprint": "centre"}},
    "footprint box_centre": {"belief": {"footprint": "box_centre"}},
    "footprint soft": {"belief": {"footprint": "soft"}},
    "ties by first index": {"protocol": {"ties": "first"}},
    "fusion product": {"belief": {"fusion": "product"}},
    "fusion sum": {"belief": {"fusion": "sum"}},
    "tempering 0.1": {"belief": {"tempering": 0.1}},
    "tempering 0.25": {"belief": {"tempering": 0.25}},
    "tempering 0.5": {"belief": {"tempering": 0.5}},
    "closest look": {"belief": {"memory": "closest"}},
}
"""Settings that change one thing each; of non-predictive search with raw scores."""

SENSORS: dict[str, dict[str, dict[str, object]]] = {
    **{
        f"YOLOX-nano, fovea {sigma} px, growth {growth}": {"sensor": {"sigma": float(sigma), "growth": float(growth)}}
        for sigma in (50, 100, 200)
        for growth in (1, 2)
    },
    **{
        f"YOLOv3-tiny at {size} px": {"detector": {"name": "yolov3-tiny", "weights": None, "input_size": size}}
        for size in (320, 416, 608)
    },
}
"""Sensors and working resolutions."""

VIEWS: dict[str, dict[str, dict[str, object]]] = {
    "whole photograph, once": {"saliency": {"view": "picture"}},
    "foveated view, as published": {"saliency": {"view": "foveated"}},
}
"""What the saliency models see."""

FIVE_LEVELS = "explore-five-levels-nano"
"""The experiment that needs a model which is not shipped."""

STUDIES = {
    "sensitivity": (SENSITIVITY, ("non-predictive-raw",)),
    "saliency": (VIEWS, ("vocus2", "itti-koch")),
    "sensor": (SENSORS, ("non-predictive-raw", "non-predictive-raw+tempered+central")),
}
"""Studies on fewer photographs: what changes, and the policies. A row of their tables is a setting and a policy."""


@dataclass(frozen=True)
class ResultsConfig:
    """Which photographs, and where the page goes.

    Args:
        root: folder of the photographs.
        annotations: COCO-format instances file for them.
        yolox: ONNX file of YOLOX-nano (None: the published one).
        limit: only the first so many photographs, for a trial.
        sensitivity: photographs for the studies of settings, which look anew for every one.
        five_levels: observation model of YOLOX-nano with five levels, the last of them empty (None: left out).
        only: experiments to run (None: all); the page says of the others what is there from before, or nothing.
        page: file to write.
        template: its text.
        out: folder for the runs.
        cache: folder for what the detectors saw (None: the user's cache).
        workers: processes (None: one for each CPU core).
    """

    root: Path
    annotations: Path
    yolox: Path | None = None
    limit: int | None = None
    sensitivity: int = 30
    five_levels: Path | None = None
    only: tuple[str, ...] | None = None
    page: Path = Path("docs/results.md")
    template: Path = Path("docs/results.template.md")
    out: Path = Path("runs/results")
    cache: Path | None = None
    workers: int | None = None


def experiments(config: ResultsConfig) -> dict[str, RunConfig]:
    """The experiments of the page, by name."""
    data = DataConfig(root=config.root, annotations=config.annotations, limit=config.limit)
    detectors = {"nano": DetectorConfig(name="yolox-nano", weights=config.yolox), "tiny": DetectorConfig()}
    picture = SaliencyConfig(view="picture")
    runs: dict[str, RunConfig] = {}
    for name, detector in detectors.items():
        common: dict[str, Any] = {"data": data, "detector": detector, "cache": config.cache, "workers": config.workers}
        seek = partial(SearchConfig, **common, saliency=picture)
        runs[f"search-{name}"] = seek(policies=(*ABLATIONS, *BEYOND) if name == "nano" else BEYOND)
        for control in ("wrong-class", "permuted"):
            protocol = ProtocolConfig(control=control)
            runs[f"{control}-{name}"] = seek(policies=("random", "target-evidence"), protocol=protocol, scanpaths=0)
        if name == "tiny":
            policies = ("non-predictive-raw+tempered+central", "learned-raw")
            runs[f"learned-{name}"] = seek(policies=policies, scanpaths=0)
        tour = partial(ExploreConfig, **common, saliency=picture)
        runs[f"explore-{name}"] = tour(policies=EXPLORE)
        published = BeliefConfig(model=f"{'yolov3-tiny' if name == 'tiny' else 'yolox-nano'}-published")
        models = ("random-calibrated", "kl-calibrated", "negative-entropy-calibrated", "two-peaks-calibrated")
        runs[f"explore-published-{name}"] = tour(policies=models, belief=published)
    if config.five_levels is not None:
        belief = BeliefConfig(model=str(config.five_levels))
        policies = ("random-raw", "kl-raw", "random-calibrated", "kl-calibrated")
        nano: dict[str, Any] = {"data": data, "detector": detectors["nano"], "cache": config.cache}
        runs[FIVE_LEVELS] = ExploreConfig(**nano, workers=config.workers, policies=policies, belief=belief)
    base = SearchConfig(
        replace(data, limit=config.sensitivity),
        detectors["nano"],
        cache=config.cache,
        workers=config.workers,
        scanpaths=0,
    )
    for study, (settings, policies) in STUDIES.items():
        for label, changes in settings.items():
            parts = {part: replace(getattr(base, part), **values) for part, values in changes.items()}
            runs[f"{study} {label}"] = replace(base, **parts, policies=policies)
    folder = str.maketrans({" ": "-", ",": None})
    return {name: replace(run, out=config.out / name.translate(folder)) for name, run in runs.items()}


def results(config: ResultsConfig) -> None:
    """Run the experiments and write the page."""
    runs = experiments(config)
    chosen = list(runs) if config.only is None else [lookup(name, runs, "experiment") for name in config.only]
    for name in chosen:
        print(f"\n== {name}")
        run = runs[name]
        if isinstance(run, SearchConfig):
            search(run)
        else:
            explore(run)
    try:
        template = config.template.read_text(encoding="utf-8")
    except OSError as error:
        raise DataError(f"{config.template}: cannot be read ({error.strerror})") from None
    write_text(config.page, fill(template, runs))
    print(f"written: {config.page}")


def fill(template: str, runs: dict[str, RunConfig]) -> str:
    """The template with every line `@@ experiment table` replaced by that table."""
    lines: list[str] = []
    for line in template.splitlines():
        if not line.startswith("@@ "):
            lines.append(line)
            continue
        if line.removeprefix("@@ ") in STUDIES:
            lines += study_table(line.removeprefix("@@ "), runs)
            continue
        name, kind = line.removeprefix("@@ ").split()
        make = TABLES[lookup(kind, TABLES, "table")]
        run = runs.get(lookup(name, [*runs, FIVE_LEVELS], "experiment"))
        lines += make(run.out) if run and (run.out / "summary.md").exists() else ["*Not run yet.*"]
    return "\n".join(lines) + "\n"


def study_table(study: str, runs: dict[str, RunConfig]) -> list[str]:
    """One row for each setting and policy, of the curves over all targets."""
    shifts = (1, 5, 10, 15, 30)
    settings, policies = STUDIES[study]
    rows = [["setting", *(["policy"] if len(policies) > 1 else []), *(f"CP@{n}" for n in shifts)]]
    for label in settings:
        folder = runs[f"{study} {label}"].out
        records = read_records(folder) if (folder / "summary.md").exists() else None
        for policy in policies:
            head = [label, *([policy] if len(policies) > 1 else [])]
            if records is None:
                rows.append([*head, *("not run yet" for _ in shifts)])
                continue
            curves = per_image([record for record in records if record["policy"] == policy], max(shifts))
            mean, error = curves.mean(0), standard_error(curves)
            rows.append([*head, *(f"{100 * mean[n]:.1f} ± {100 * error[n]:.1f}" for n in shifts)])
    return table(rows)


def read_records(folder: Path) -> list[Record]:
    """What a run wrote of every episode."""
    return [json.loads(line) for line in (folder / "episodes.jsonl").read_text(encoding="utf-8").splitlines()]


def summary(folder: Path, section: int | None = None) -> list[str]:
    """The tables that a run printed, or one of them."""
    text = (folder / "summary.md").read_text(encoding="utf-8").strip()
    parts = ["**" + part.strip() for part in text.split("\n**")]
    parts[0] = parts[0].removeprefix("**")
    return text.splitlines() if section is None else parts[section].splitlines()


def paired(folder: Path, baseline: str, shifts: Sequence[int]) -> list[str]:
    """Differences of every policy to `baseline` over the same images, in points, with standard errors."""
    records = read_records(folder)
    last = max(shifts)
    policies = list(dict.fromkeys(record["policy"] for record in records))
    curves = {policy: per_image([r for r in records if r["policy"] == policy], last) for policy in policies}
    rows = [[f"difference to {baseline}", *(str(n) for n in shifts), "behind at"]]
    for policy in policies:
        if policy == baseline:
            continue
        difference = curves[policy] - curves[baseline]
        mean, error = difference.mean(0), standard_error(difference)
        cells = [f"{100 * mean[n]:+.1f} ± {100 * error[n]:.1f}" for n in shifts]
        behind = [n for n in range(1, last + 1) if mean[n] < 0]
        rows.append([policy, *cells, f"{behind[0]} to {behind[-1]}" if behind else "no shift"])
    return table(rows)


def per_image(records: list[Record], last: int) -> Array:
    """Figure of merit of each image after 0..`last` gaze shifts, in order of the images, `(images, last+1)`."""
    images: dict[str, list[Array]] = {}
    for record in records:
        if "found_at" in record:
            curve = cumulative_performance(np.array([record["found_at"]]), last)
        else:
            curve = success_rate(record["right"], record["object_cells"])[: last + 1]
        images.setdefault(str(record["scene"]), []).append(curve)
    return np.stack([np.mean(images[scene], axis=0) for scene in sorted(images)])


def agreement(folder: Path) -> list[str]:
    """How often predictive and non-predictive search choose the same cell, first and all the way."""
    episodes: dict[str, list[Record]] = {}
    for record in read_records(folder):
        episodes.setdefault(record["policy"], []).append(record)
    rows = [["scores", "same first gaze shift", "found after as many shifts"]]
    for mode in ("raw", "calibrated"):
        pairs = list(zip(episodes[f"non-predictive-{mode}"], episodes[f"predictive-{mode}"], strict=True))
        first = [a["cells"][1] == b["cells"][1] for a, b in pairs]
        found = [a["found_at"] == b["found_at"] for a, b in pairs]
        rows.append([mode, *(f"{100 * np.mean(same):.1f} %" for same in (first, found))])
    return table(rows)


TABLES: dict[str, Callable[[Path], list[str]]] = {
    "all": summary,
    "first": partial(summary, section=0),
    "second": partial(summary, section=1),
    "agreement": agreement,
    "paired-search": partial(paired, baseline="random", shifts=(1, 5, 15, 30)),
    "paired-learned": partial(paired, baseline="non-predictive-raw+tempered+central", shifts=(1, 5, 10, 15, 30)),
    "paired-explore": partial(paired, baseline="random-raw", shifts=(1, 2, 3, 4, 10, 20)),
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    return run_command(results, ResultsConfig, __doc__, arguments)


if __name__ == "__main__":
    sys.exit(main())
