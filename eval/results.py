"""Regenerate docs/results.md: `python -m eval.results` runs its experiments and fills in the page.

    python -m eval.results --root val2017 --annotations instances_val2017.json --yolox yolox_nano.onnx

The page's text is docs/results.template.md, in which a line `@@ experiment table` stands for a table of an experiment.
What a detector sees is computed once and shared; a run that was stopped goes on where it was.
"""

import json
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from eval.command import run_command
from eval.config import RunConfig, SearchConfig
from eval.experiments import FIVE_LEVELS, STUDIES, ResultsConfig, experiments
from eval.explore import explore
from eval.metrics import cumulative_performance, standard_error, success_rate
from eval.report import Array, Record, table
from eval.search import search
from semfov.errors import DataError, lookup
from semfov.files import write_text


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


def study_table(title: str, runs: dict[str, RunConfig]) -> list[str]:
    """One row for each setting and policy: of the curves over all targets, or of cells named but as background."""
    study = STUDIES[title]
    several = len(study.policies) > 1
    shifts = [str(n) if study.explores else f"CP@{n}" for n in study.shifts]
    rows = [["setting", *(["policy"] if several else []), *shifts]]
    for label in study.settings:
        folder = runs[f"{title} {label}"].out
        records = read_records(folder) if (folder / "summary.md").exists() else None
        for policy in study.policies:
            head = [label, *([policy] if several else [])]
            if records is None:
                rows.append([*head, *("not run yet" for _ in shifts)])
                continue
            curves = per_image([record for record in records if record["policy"] == policy], max(study.shifts))
            mean, error = curves.mean(0), standard_error(curves)
            rows.append([*head, *(f"{100 * mean[n]:.1f} ± {100 * error[n]:.1f}" for n in study.shifts)])
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
