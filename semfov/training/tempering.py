"""Finding the exponent with which likelihoods count best."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor

from semfov.belief.grid import Footprint, Grid
from semfov.belief.observers import Semantic
from semfov.data.scene import Scenes, legal_targets
from semfov.detection.detections import Detections
from semfov.errors import DataError, check
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.parallel import rank
from semfov.experiments.progress import track
from semfov.experiments.samples import Sampler, Samples, SampleSettings, collect
from semfov.experiments.settings import Count, Positive, Range, Seed, Settings, Share, Side, Whole, Workers
from semfov.experiments.setup import make_observation
from semfov.experiments.summary import table
from semfov.observation.foveal import FovealObservationModel
from semfov.training.outputs import write_outputs


@dataclass(frozen=True)
class FitTemperingConfig(Settings):
    """Find the exponent of the likelihoods.

    Args:
        data: photographs to learn from (all of them: no selection by number of objects).
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        calibrated: pass scores through the observation model shipped for the detector, or take them as likelihoods.
        footprint: which cells a detection updates.
        exponents: values of τ to compare.
        photographs: use only so many (None: all).
        fixations: random fixations in each photograph.
        iou: as in `train.fit_fom`, for looks to be shared with it.
        seed: of the fixations.
        shard: photographs in a unit of work.
        columns: cells in a row.
        rows: cells in a column.
        min_objects: photographs with fewer objects are left out.
        max_target_area: classes that cover a larger share of the image are not searched for.
        holdout: every n-th photograph is kept out and used to judge.
        out: folder for the report.
        cache: folder for the labelled detections (None: `out`).
        workers: processes that look (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    calibrated: bool = False
    footprint: Footprint = "box_centre"
    exponents: tuple[Positive, ...] = (0.05, 0.1, 0.15, 0.2, 0.25, 0.35, 0.5, 0.7, 1.0)
    photographs: Count | None = None
    fixations: Count = 8
    iou: Share = 0.5
    seed: Seed = 0
    shard: Count = 32
    columns: Side = 10
    rows: Side = 10
    min_objects: Whole = 4
    max_target_area: Positive = 0.2
    holdout: Annotated[int, Range(2, 10**9)] = 4
    out: Path = Path("runs/fit_tempering")
    cache: Path | None = None
    workers: Workers | None = None


def fit_tempering(config: FitTemperingConfig) -> None:
    """Collect looks, try every exponent, and write the report."""
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    check(len(config.exponents) > 0, "exponents", "at least one value", "none")
    settings = SampleSettings.of(config)
    sampler, samples = collect(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    model = make_observation(None, sampler.foveal_eye) if config.calibrated else None
    hits = {tempering: measure(config, sampler, samples, model, tempering) for tempering in config.exponents}
    text = report(hits)
    write_outputs(config, text, ("hits.json", json.dumps(hits, indent=2) + "\n"))


def measure(
    config: FitTemperingConfig,
    sampler: Sampler,
    samples: Samples,
    model: FovealObservationModel | None,
    tempering: float,
) -> dict[str, float]:
    """Mean over photographs of the share of next fixations that hit, `fitted` and `held_out`."""
    observer = Semantic(len(sampler.eye.detector.classes) + 1, model, footprint=config.footprint, tempering=tempering)
    return means_of(config, hit_rates(config, sampler.scenes, samples, observer, f"tempering {tempering:g}"))


def means_of(config: FitTemperingConfig, rates: dict[int, float]) -> dict[str, float]:
    """Means of what `hit_rates` gives, over the photographs to choose by, `fitted`, and over those `held_out`."""
    means: dict[str, list[float]] = {"fitted": [], "held_out": []}
    for index, share in rates.items():
        means["held_out" if index % config.holdout == 0 else "fitted"].append(share)
    if not all(means.values()):
        raise DataError("data: too few photographs to fit and to judge by; give more")
    return {name: sum(values) / len(values) for name, values in means.items()}


def hit_rates(
    config: FitTemperingConfig, scenes: Scenes, samples: Samples, observer: Semantic, title: str
) -> dict[int, float]:
    """Share of next fixations that hit, by the index of the photograph.

    Args:
        config: which photographs and targets count.
        scenes: the photographs.
        samples: looks at them, `config.fixations` at each, in order.
        observer: fuses the looks.
        title: of the progress.
    """
    rates = {}
    number = min(config.photographs or len(scenes), len(scenes))
    for index in track(range(number), title, "scene"):
        annotation = scenes.annotation(index)
        targets = legal_targets(annotation, config.max_target_area)
        if len(annotation.labels) < config.min_objects or not targets:
            continue
        looks = slice(index * config.fixations, (index + 1) * config.fixations)
        grid = Grid(config.columns, config.rows, annotation.size)
        covered = grid.footprint(annotation.boxes)
        goal = torch.stack([covered[annotation.labels == target].any(0) for target in targets])
        share = hit_rate(observer, samples.seen(looks), samples.fixations[looks], grid, torch.tensor(targets), goal)
        if share is not None:
            rates[index] = share
    return rates


def hit_rate(
    observer: Semantic, seen: Detections, fixations: Tensor, grid: Grid, targets: Tensor, goal: Tensor
) -> float | None:
    """Share of the next fixations that hit, over targets and over beliefs after the first look, the second and so on.

    A look that fixates the target would have ended the search and is left out. Where cells are equally probable, the
    share of them that hold the target counts.

    Args:
        observer: fuses the looks.
        seen: R looks at one photograph.
        fixations: `(R, 2)`.
        grid: the cells.
        targets: `(T,)`, classes to search for.
        goal: `(T, X·Y)` boolean, cells that hold them.

    Returns:
        None where every look ends every search.
    """
    evidence = observer.weigh(seen, fixations, grid)
    belief = observer.start(len(targets), grid, seen.scores)
    visited = torch.zeros_like(goal)
    hits = []
    for look, cell in enumerate(grid.cell_of(fixations).tolist()):
        going = (~goal[:, cell]).nonzero()[:, 0]
        updated = observer.update(belief[going], evidence[torch.full_like(going, look)])
        belief.beta[going], belief.closest[going] = updated.beta, updated.closest
        visited[going, cell] = True
        posterior = updated.probability(targets[going]).masked_fill(visited[going], -1)
        best = posterior == posterior.amax(-1, keepdim=True)
        hits.append((best & goal[going]).sum(-1) / best.sum(-1))
    share = torch.cat(hits)
    return float(share.mean()) if len(share) else None


def report(hits: dict[float, dict[str, float]]) -> str:
    """A row for every exponent, and the best of them, as Markdown."""
    best = max(hits, key=lambda tempering: hits[tempering]["fitted"])
    rows = [[f"{t:g}", f"{100 * h['fitted']:.2f}", f"{100 * h['held_out']:.2f}"] for t, h in hits.items()]
    return "\n".join(
        [
            f"Best exponent on the photographs to choose by: {best:g}. Percent of the next fixations that hit the "
            "target, after one to all of the looks at a photograph, mean over photographs.",
            "",
            *table([["tempering", "photographs to choose by", "held-out photographs"], *rows]),
            "",
        ]
    )
