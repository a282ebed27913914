"""Training a gaze policy end to end, through whole searches."""

import hashlib
import json
import logging
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from tqdm import tqdm

from semfov.data.scene import Scenes
from semfov.errors import DataError, check
from semfov.experiments.config import DataConfig, DetectorConfig, SensorConfig
from semfov.experiments.seeds import generator_for
from semfov.experiments.settings import Count, Name, Positive, Range, Seed, Settings, Share, Side, Weight
from semfov.experiments.setup import check_sources, fovea_of, make_eye, make_scenes, prepare_worker
from semfov.experiments.store import versions
from semfov.experiments.summary import table
from semfov.eye import Eye
from semfov.gaze.learned import LearnedGaze
from semfov.io import storage
from semfov.io.code import package_digest
from semfov.io.schema import Array, Field, Number, Schema
from semfov.training.gaze_episodes import Relaxation, backpropagate, draw_searches, found_at
from semfov.training.outputs import model_path, training_of, write_outputs

_log = logging.getLogger(__name__)

_CHECKPOINT = "gaze-checkpoint"


@dataclass(frozen=True)
class FitGazeConfig(Settings):
    """Train a gaze policy end to end.

    Args:
        data: photographs to learn from.
        detector: which detector looks through the fovea; gradients pass through it, so not an ONNX model.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's).
        columns: cells in a row.
        rows: cells in a column.
        width: channels of the network.
        learn_sigma: learn the width of the fovea too.
        shifts: gaze shifts of a search.
        window: gaze shifts that a gradient flows through (truncated backpropagation through time).
        temperature: of the Gumbel-softmax.
        discount: weight of a gaze shift in the loss against the one before it.
        posterior: weight in the loss of the target's posterior on the target.
        others: weight in the loss of the photograph's other classes, for which the same looks teach where to look.
        steps: steps of training.
        photographs: in a step.
        searches: in each of them, with targets and starts at random.
        rate: highest learning rate.
        holdout: every n-th photograph is kept out and used to judge.
        judged: so many of them, at most.
        seed: of first parameters, of photographs and searches, and of choices.
        save_every: steps between checkpoints.
        out: folder for the model, the checkpoint and the report.
    """

    data: DataConfig = field(default_factory=lambda: DataConfig(min_instances=4))
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    sensor: SensorConfig = field(default_factory=SensorConfig)
    name: Name | None = None
    columns: Side = 10
    rows: Side = 10
    width: Annotated[int, Range(1, 4096)] = 8
    learn_sigma: bool = False
    shifts: Annotated[int, Range(1, 10_000)] = 9
    window: Count = 3
    temperature: Positive = 1.0
    discount: Share = 0.9
    posterior: Weight = 0.3
    others: Weight = 1.0
    steps: Count = 200
    photographs: Count = 4
    searches: Count = 1
    rate: Positive = 5e-3
    holdout: Annotated[int, Range(2, 10**9)] = 10
    judged: Count = 120
    seed: Seed = 0
    save_every: Count = 5
    out: Path = Path("runs/fit_gaze")

    @property
    def relaxation(self) -> Relaxation:
        """How searches are made differentiable."""
        return Relaxation(self.shifts, self.window, self.temperature, self.discount, self.posterior, self.others)


def fit_gaze(config: FitGazeConfig) -> None:
    """Train, judge on held-out photographs beside the start, and write everything."""
    for name in ("shifts", "window", "steps", "photographs", "searches", "judged", "save_every"):
        check(getattr(config, name) >= 1, name, "1 or more", getattr(config, name))
    check(config.holdout >= 2, "holdout", "2 or more", config.holdout)
    prepare_worker()
    check_sources(config.data, config.detector)
    eye = make_eye(config.detector, config.sensor)
    scenes = make_scenes(config.data, eye.detector.classes)
    held_out = list(range(0, len(scenes), config.holdout))[: config.judged]
    trained_on = [index for index in range(len(scenes)) if index % config.holdout]
    if not trained_on:
        raise DataError(f"data: too few photographs to train and to judge by ({len(scenes)})")
    metadata = {**eye.settings(), **training_of(config, scenes, "save_every", "judged")}
    fovea = fovea_of(eye)
    start, width = first_model(config, metadata), float(fovea.sigma)
    judged = {"start": judge(config, start, eye, scenes, held_out, "judging the start")}
    fovea.log_sigma.requires_grad_(config.learn_sigma)
    gaze, losses = train(config, eye, scenes, trained_on, metadata)
    eye.requires_grad_(False)
    gaze.metadata.update(eye.settings())
    judged["learned"] = judge(config, gaze, eye, scenes, held_out, "judging")
    path = model_path(config, eye.detector.name)
    gaze.save(path)
    text = report(config, judged, losses, len(trained_on), len(held_out), (width, float(fovea.sigma)))
    found = {name: found.tolist() for name, found in judged.items()}
    write_outputs(config, text, ("judged.json", json.dumps({"found_at": found, "losses": losses}) + "\n"), path)


def first_model(config: FitGazeConfig, metadata: dict[str, object]) -> LearnedGaze:
    """The policy before training: non-predictive search."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return LearnedGaze(config.width, metadata=metadata)


def train(
    config: FitGazeConfig, eye: Eye, scenes: Scenes, trained_on: Sequence[int], metadata: dict[str, object]
) -> tuple[LearnedGaze, list[float]]:
    """The trained policy, and the loss of every step; goes on from the checkpoint in `out` where there is one.

    Random numbers are seeded step by step, so that a run that was stopped ends as if it had not been.
    """
    gaze = first_model(config, metadata)
    parameters = dict(gaze.named_parameters())
    if config.learn_sigma:
        parameters["log_sigma"] = fovea_of(eye).log_sigma
    optimiser = torch.optim.AdamW(parameters.values(), lr=config.rate, weight_decay=1e-2)
    code = json.dumps([package_digest(), versions()])
    checkpoint = Checkpoint(config.out / "checkpoint.safetensors", metadata, hashlib.sha256(code.encode()).hexdigest())
    losses = checkpoint.load(parameters, optimiser)
    todo, done = range(len(losses), config.steps), len(losses)
    bar = tqdm(todo, desc="training", unit="step", initial=done, total=config.steps, dynamic_ncols=True)
    for step in bar:
        generator = generator_for("gaze", config.seed, step)
        optimiser.param_groups[0]["lr"] = learning_rate(config, step)
        optimiser.zero_grad()
        losses.append(take_step(config, gaze, eye, scenes, trained_on, generator))
        norm = torch.nn.utils.clip_grad_norm_(parameters.values(), 1.0)
        # A saturated score has no gradient: such a step is left out.
        if norm.isfinite():
            optimiser.step()
        if (step + 1) % config.save_every == 0 or step + 1 == config.steps:
            checkpoint.save(parameters, optimiser, losses)
        recent = losses[-25:]
        bar.set_postfix(loss=f"{sum(recent) / len(recent):.3f}")
    return gaze.eval(), losses


def take_step(
    config: FitGazeConfig,
    gaze: LearnedGaze,
    eye: Eye,
    scenes: Scenes,
    trained_on: Sequence[int],
    generator: torch.Generator,
) -> float:
    """Search a few photographs and leave the gradient of their mean loss; returns the loss."""
    loss = 0.0
    for place in torch.randint(len(trained_on), (config.photographs,), generator=generator).tolist():
        size = config.columns, config.rows
        searches = draw_searches(eye, scenes, trained_on[place], size, config.searches, generator)
        if searches is not None:
            noise = torch.rand(config.shifts, *searches.goal.shape, generator=generator)
            loss += backpropagate(gaze, eye, searches, noise, config.relaxation, 1 / config.photographs)
    return loss


def learning_rate(config: FitGazeConfig, step: int) -> float:
    """Up for a twentieth of the steps, then down along a cosine."""
    warm = max(1, config.steps // 20)
    if step < warm:
        return config.rate * (step + 1) / warm
    return config.rate * (1 + math.cos(math.pi * (step - warm) / max(1, config.steps - warm))) / 2


class Checkpoint:
    """State of a training in one file of tensors and JSON, written whole or not at all.

    Args:
        path: the file.
        settings: what the training depends on; a checkpoint of other settings is refused.
        code: sha256 of the code that it depends on; what other code left is told of, and not gone on from.
    """

    def __init__(self, path: Path, settings: dict[str, object], code: str) -> None:
        self.path, self.code = path, code
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()

    def save(self, parameters: Mapping[str, Tensor], optimiser: torch.optim.Optimizer, losses: list[float]) -> None:
        """Keep parameters, the optimiser's averages, and the losses so far."""
        tensors = {f"parameter.{name}": parameter for name, parameter in parameters.items()}
        for name, parameter in parameters.items():
            tensors |= {f"{key}.{name}": torch.as_tensor(v) for key, v in optimiser.state[parameter].items()}
        storage.write(self.path, tensors, {"kind": _CHECKPOINT, "key": self.key, "code": self.code, "losses": losses})

    def load(self, parameters: Mapping[str, Tensor], optimiser: torch.optim.Optimizer) -> list[float]:
        """Put back what `save` kept, in place; returns the losses so far, none where there is no file."""
        if not self.path.exists():
            return []
        tensors, record = storage.read(self.path, _CHECKPOINT)
        if record.get("key") != self.key:
            raise DataError(f"{self.path}: a checkpoint of other settings; remove it, or give another --out")
        if record.get("code") != self.code:
            _log.warning(
                "%s: made by other code (this package or a library has changed since); training starts anew", self.path
            )
            return []
        _checkpoint_schema(parameters).check(tensors, record)
        with torch.no_grad():
            for name, parameter in parameters.items():
                parameter.copy_(tensors[f"parameter.{name}"])
                kept = {key: f"{key}.{name}" for key in ("step", "exp_avg", "exp_avg_sq")}
                optimiser.state[parameter] = {key: tensors[place] for key, place in kept.items() if place in tensors}
        return list(record["losses"])


def _checkpoint_schema(parameters: Mapping[str, Tensor]) -> Schema:
    """What a checkpoint holds: parameters, and of those that a step has moved the optimiser's averages."""
    tensors = {}
    for name, parameter in parameters.items():
        tensors[f"parameter.{name}"] = Field(tuple(parameter.shape))
        tensors[f"step.{name}"] = Field((), low=0, optional=True)
        for average in ("exp_avg", "exp_avg_sq"):
            tensors[f"{average}.{name}"] = Field(tuple(parameter.shape), optional=True)
    return Schema(tensors, {"losses": Array(Number())})


def judge(
    config: FitGazeConfig, gaze: LearnedGaze, eye: Eye, scenes: Scenes, indices: Sequence[int], title: str
) -> Tensor:
    """Gaze shift at which each of the same held-out searches found its target, `(photographs, searches)`."""
    found = []
    for index in tqdm(indices, desc=title, unit="scene", dynamic_ncols=True):
        generator = generator_for("judge", config.seed, scenes.ids[index])
        searches = draw_searches(eye, scenes, index, (config.columns, config.rows), config.searches, generator)
        if searches is not None:
            noise = torch.rand(config.shifts, *searches.goal.shape, generator=generator)
            found.append(found_at(gaze, eye, searches, noise))
    if not found:
        raise DataError("data: nothing can be searched for in the held-out photographs; give more photographs")
    return torch.stack(found)


def report(
    config: FitGazeConfig,
    judged: dict[str, Tensor],
    losses: list[float],
    trained: int,
    held_out: int,
    sigma: tuple[float, float],
) -> str:
    """How training went, as Markdown."""
    shifts = [n for n in (1, 2, 3, 5, 9, 15, 30) if n <= config.shifts]
    hits = {name: torch.stack([(f <= n).double().mean(1) for n in shifts], 1) for name, f in judged.items()}
    rows = [[name, *(f"{100 * h:.1f}" for h in hit.mean(0))] for name, hit in hits.items()]
    gain = hits["learned"] - hits["start"]
    error = gain.std(0) / len(gain) ** 0.5 if len(gain) > 1 else torch.full_like(gain[0], torch.nan)
    rows.append(["gain", *(f"{100 * g:+.1f} ± {100 * e:.1f}" for g, e in zip(gain.mean(0), error, strict=True))])
    quarter = max(1, len(losses) // 4)
    return "\n".join(
        [
            f"Trained on {trained} photographs ({config.steps} steps of {config.photographs} × {config.searches} "
            f"searches), judged on {config.searches} searches in each of {held_out} that were held out: targets found "
            "within so many gaze shifts (%), and the gain over the policy that training started from, with its "
            "standard error over photographs.",
            "",
            *table([["policy", *(f"{n}" for n in shifts)], *rows]),
            "",
            f"Mean loss of the first quarter of the steps {sum(losses[:quarter]) / quarter:.3f}, of the last "
            f"{sum(losses[-quarter:]) / quarter:.3f}. σ of the fovea {sigma[0]:.1f} → {sigma[1]:.1f}.",
            "",
        ]
    )
