"""Training evidence for targets on series of looks."""

import json
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor
from torch.nn import functional as F
from tqdm import tqdm

from semfov.belief import TargetEvidence
from semfov.errors import DataError, check
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.parallel import rank
from semfov.experiments.samples import SampleSettings, collect
from semfov.experiments.summary import table
from semfov.training.evidence_examples import Examples, make_examples
from semfov.training.outputs import training_of, write_outputs


@dataclass(frozen=True)
class FitSearchConfig:
    """Train the evidence for a target.

    Args:
        data: photographs to learn from (all of them: no selection by number of objects).
        detector: which detector looks through the fovea.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's).
        fixations: random fixations in each photograph.
        iou: as in `train.fit_fom`, for looks to be shared with it.
        seed: of fixations, first parameters and training.
        shard: photographs in a unit of work.
        columns: cells in a row.
        rows: cells in a column.
        min_objects: photographs with fewer objects are left out.
        max_target_area: classes that cover a larger share of the image are not searched for.
        holdout: every n-th photograph is kept out and used to judge.
        steps: steps of training.
        batch: examples in a step.
        rate: highest learning rate.
        out: folder for the model and the report.
        cache: folder for the labelled detections (None: `out`).
        workers: processes that look (None: one for each CPU core).
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    name: str | None = None
    fixations: int = 8
    iou: float = 0.5
    seed: int = 0
    shard: int = 32
    columns: int = 10
    rows: int = 10
    min_objects: int = 4
    max_target_area: float = 0.2
    holdout: int = 10
    steps: int = 2000
    batch: int = 128
    rate: float = 5e-3
    out: Path = Path("runs/fit_search")
    cache: Path | None = None
    workers: int | None = None


def fit_search(config: FitSearchConfig) -> None:
    """Collect looks, train, judge on held-out photographs, and write everything."""
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    settings = SampleSettings.of(config)
    sampler, samples = collect(settings, (config.cache or config.out) / "samples", config.workers, "looking")
    if rank() > 0:
        return
    examples = make_examples(sampler, samples, config.columns, config.rows, config.min_objects, config.max_target_area)
    held_out = examples.scene % config.holdout == 0
    if held_out.all() or not held_out.any():
        raise DataError(f"data: too few examples to train and to judge by ({len(examples)}); give more photographs")
    metadata = {**sampler.eye.settings(), **training_of(config, sampler.scenes)}
    model, judged = train(config, examples[~held_out], examples[held_out], metadata)
    path = config.out / f"{config.name or sampler.eye.detector.name}.safetensors"
    model.save(path)
    text = report(judged, int((~held_out).sum()), int(held_out.sum()))
    write_outputs(config, text, ("judged.json", json.dumps(judged, indent=2) + "\n"), path)


def train(
    config: FitSearchConfig, examples: Examples, held_out: Examples, metadata: dict[str, object]
) -> tuple[TargetEvidence, list[dict[str, float]]]:
    """The trained model, and how well it did on held-out examples as training went on."""
    generator = torch.Generator().manual_seed(config.seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = TargetEvidence(metadata=metadata)
    optimiser = torch.optim.AdamW(model.parameters(), lr=config.rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, config.rate, total_steps=config.steps)
    judged = []
    bar = tqdm(range(1, config.steps + 1), desc="training", unit="step", dynamic_ncols=True)
    for step in bar:
        chosen = examples[torch.randint(len(examples), (config.batch,), generator=generator)]
        loss = objective(*series(model, chosen, config.columns, generator))
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if step in (1, config.steps) or step % 250 == 0:
            judged.append({"step": step, **judge(model, held_out, config.columns)})
            bar.set_postfix(held_out=f"{judged[-1]['hit']:.3f}")
    return model.eval(), judged


def series(
    model: TargetEvidence, examples: Examples, columns: int, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Log odds after a random number of random looks at each example, `(B, X·Y)`; goals; visited cells.

    Looks that fixate the target would have ended the search and are left out.
    """
    count, looks = examples.fixated.shape
    order = torch.rand(count, looks, generator=generator)
    order = order.masked_fill(examples.goal.gather(1, examples.fixated), torch.inf)
    number = torch.randint(1, looks + 1, (count, 1), generator=generator)
    used = (order.argsort(1).argsort(1) < number) & order.isfinite()
    kept = used.any(1)
    used, examples = used[kept], examples[kept]
    evidence = model.evidence(examples.features)
    distance, look = examples.distance.masked_fill(~used[..., None], torch.inf).min(1, keepdim=True)
    nearest = evidence.gather(1, look)[:, 0]
    best = evidence.masked_fill(~used[..., None], -torch.inf).amax(1)
    visited = torch.zeros(len(used), examples.goal.shape[1] + 1, dtype=torch.bool)
    visited = visited.scatter(1, torch.where(used, examples.fixated, examples.goal.shape[1]), True)[:, :-1]
    return model.log_odds(nearest, best, distance[:, 0], visited, columns), examples.goal, visited


def objective(log_odds: Tensor, goal: Tensor, visited: Tensor) -> Tensor:
    r"""Cross-entropy of the odds, and minus the log probability that a soft fixation lands on the target.

    .. math:: -\ln \sum_{x \in \text{goal}} \mathrm{softmax}(\ell)(x) + \mathrm{BCE}(\ell)
    """
    open_odds = log_odds.masked_fill(visited, -torch.inf)
    hit = open_odds.masked_fill(~goal, -torch.inf).logsumexp(1) - open_odds.logsumexp(1)
    return F.binary_cross_entropy_with_logits(log_odds[~visited], goal[~visited].to(log_odds)) - hit.mean()


@torch.no_grad()
def judge(model: TargetEvidence, examples: Examples, columns: int) -> dict[str, float]:
    """How often the most probable cell holds the target, and the cross-entropy of the odds, on the same series."""
    model.eval()
    log_odds, goal, visited = series(model, examples, columns, torch.Generator().manual_seed(0))
    model.train()
    best = log_odds.masked_fill(visited, -torch.inf).argmax(1, keepdim=True)
    entropy = F.binary_cross_entropy_with_logits(log_odds[~visited], goal[~visited].to(log_odds))
    return {"hit": float(goal.gather(1, best).float().mean()), "cross_entropy": float(entropy)}


def report(judged: list[dict[str, float]], trained: int, held_out: int) -> str:
    """How training went, as Markdown."""
    rows = [[str(int(j["step"])), f"{100 * j['hit']:.1f}", f"{j['cross_entropy']:.4f}"] for j in judged]
    return "\n".join(
        [
            f"Trained on {trained} pairs of photograph and class, judged on {held_out} of photographs that were held "
            "out, after one to all of the looks at each: how often the most probable cell held the target (%), and the "
            "cross-entropy of the odds over all cells.",
            "",
            *table([["step", "next fixation hits", "cross-entropy"], *rows]),
            "",
        ]
    )
