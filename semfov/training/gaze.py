"""Train a gaze policy end to end, through whole searches."""

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
from semfov.experiments.tables import table
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
        detector: the detector that processes the foveated views. It must not be an ONNX model, as gradients have to
            pass through it.
        sensor: the foveal sensor.
        name: name of the model (None: the detector's name).
        columns: columns of the grid.
        rows: rows of the grid.
        width: channels of the network.
        learn_sigma: learn the width of the fovea as well.
        shifts: number of gaze shifts in a search.
        window: number of gaze shifts that a gradient flows through (truncated backpropagation through time).
        temperature: temperature of the Gumbel-softmax.
        discount: discount factor of the loss per gaze shift.
        posterior: weight of the loss term for the posterior probability of the target's cells.
        others: weight of the loss term for the other classes in the photograph. The same looks also show where these
            classes are.
        steps: number of training steps.
        photographs: number of photographs in a step.
        searches: number of searches in each of these photographs, with random targets and starting points.
        rate: highest learning rate.
        holdout: one in every n photographs is held out for the evaluation.
        judged: maximum number of held-out photographs to evaluate on.
        seed: seed of the initial parameters, the selection of photographs and searches, and the choices of the policy.
        save_every: number of steps between checkpoints.
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
        """Settings of the differentiable searches."""
        return Relaxation(self.shifts, self.window, self.temperature, self.discount, self.posterior, self.others)


def fit_gaze(config: FitGazeConfig) -> None:
    """Train, compare the policy with its starting point on held-out photographs, and write all results."""
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
        raise DataError(
            f"data: expected at least 2 photographs, one to train on and one to hold out, got {len(scenes)}"
        )
    metadata = {**eye.settings(), **training_of(config, scenes, "save_every", "judged")}
    fovea = fovea_of(eye)
    start, width = first_model(config, metadata), float(fovea.sigma)
    judged = {"start": judge(config, start, eye, scenes, held_out, "evaluating the start")}
    fovea.log_sigma.requires_grad_(config.learn_sigma)
    gaze, losses = train(config, eye, scenes, trained_on, metadata)
    eye.requires_grad_(False)
    gaze.metadata.update(eye.settings())
    judged["learned"] = judge(config, gaze, eye, scenes, held_out, "evaluating")
    path = model_path(config, eye.detector.name)
    gaze.save(path)
    text = report(config, judged, losses, len(trained_on), len(held_out), (width, float(fovea.sigma)))
    found = {name: found.tolist() for name, found in judged.items()}
    write_outputs(config, text, ("judged.json", json.dumps({"found_at": found, "losses": losses}) + "\n"), path)


def first_model(config: FitGazeConfig, metadata: dict[str, object]) -> LearnedGaze:
    """Make the policy before training, which is equivalent to non-predictive search."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        return LearnedGaze(config.width, metadata=metadata)


def train(
    config: FitGazeConfig, eye: Eye, scenes: Scenes, trained_on: Sequence[int], metadata: dict[str, object]
) -> tuple[LearnedGaze, list[float]]:
    """Train the policy, continuing from the checkpoint in `out` if there is one.

    Random numbers are seeded anew in each step, so that an interrupted run gives the same result as an uninterrupted
    one.

    Args:
        config: the settings.
        eye: the sensor and the detector.
        scenes: the photographs.
        trained_on: indices of the training photographs.
        metadata: metadata of the model.

    Returns:
        The trained policy, and the loss of every step.
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
        # A saturated score can give a gradient that is not finite. Such a step is skipped.
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
    """Search a few photographs and add the gradient of their mean loss to the parameters.

    Args:
        config: the settings.
        gaze: the policy.
        eye: the sensor and the detector.
        scenes: the photographs.
        trained_on: indices of the training photographs.
        generator: source of random numbers.

    Returns:
        The mean loss.
    """
    loss = 0.0
    for place in torch.randint(len(trained_on), (config.photographs,), generator=generator).tolist():
        size = config.columns, config.rows
        searches = draw_searches(eye, scenes, trained_on[place], size, config.searches, generator)
        if searches is not None:
            noise = torch.rand(config.shifts, *searches.goal.shape, generator=generator)
            loss += backpropagate(gaze, eye, searches, noise, config.relaxation, 1 / config.photographs)
    return loss


def learning_rate(config: FitGazeConfig, step: int) -> float:
    """Compute the learning rate of a step: a linear increase over a twentieth of the steps, then a cosine decay."""
    warm = max(1, config.steps // 20)
    if step < warm:
        return config.rate * (step + 1) / warm
    return config.rate * (1 + math.cos(math.pi * (step - warm) / max(1, config.steps - warm))) / 2


class Checkpoint:
    """The state of a training in one file, which is written atomically.

    Args:
        path: the file.
        settings: the settings that the training depends on. A checkpoint with other settings is an error.
        code: sha256 of the code that the training depends on. A checkpoint of other code is ignored with a warning.
    """

    def __init__(self, path: Path, settings: dict[str, object], code: str) -> None:
        self.path, self.code = path, code
        self.key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()

    def save(self, parameters: Mapping[str, Tensor], optimiser: torch.optim.Optimizer, losses: list[float]) -> None:
        """Write the parameters, the optimiser's averages, and the losses so far."""
        tensors = {f"parameter.{name}": parameter for name, parameter in parameters.items()}
        for name, parameter in parameters.items():
            tensors |= {f"{key}.{name}": torch.as_tensor(v) for key, v in optimiser.state[parameter].items()}
        storage.write(self.path, tensors, {"kind": _CHECKPOINT, "key": self.key, "code": self.code, "losses": losses})

    def load(self, parameters: Mapping[str, Tensor], optimiser: torch.optim.Optimizer) -> list[float]:
        """Restore the parameters and the optimiser's averages in place.

        Args:
            parameters: the parameters to restore.
            optimiser: the optimiser to restore.

        Returns:
            The losses so far; an empty list if there is no usable checkpoint.

        Raises:
            DataError: the file is damaged, or its settings are different.
        """
        if not self.path.exists():
            return []
        tensors, record = storage.read(self.path, _CHECKPOINT)
        if record.get("key") != self.key:
            raise DataError(
                f"{self.path}: the checkpoint was written with other settings; remove it, or choose another folder "
                "with --out"
            )
        if record.get("code") != self.code:
            _log.warning(
                "%s: the checkpoint was written by another version of this package or of a library; training starts "
                "from the beginning",
                self.path,
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
    """Describe the content of a checkpoint: all parameters, and the optimiser's averages of those already updated."""
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
    """Search held-out photographs with a policy. The searches are the same for each policy.

    Args:
        config: the settings.
        gaze: the policy.
        eye: the sensor and the detector.
        scenes: the photographs.
        indices: indices of the held-out photographs.
        title: label of the progress bar.

    Returns:
        The gaze shift at which each search found its target, `(photographs, searches)`.

    Raises:
        DataError: none of the photographs has a class to search for.
    """
    found = []
    for index in tqdm(indices, desc=title, unit="scene", dynamic_ncols=True):
        generator = generator_for("judge", config.seed, scenes.ids[index])
        searches = draw_searches(eye, scenes, index, (config.columns, config.rows), config.searches, generator)
        if searches is not None:
            noise = torch.rand(config.shifts, *searches.goal.shape, generator=generator)
            found.append(found_at(gaze, eye, searches, noise))
    if not found:
        raise DataError("data: none of the held-out photographs contains a class to search for; give more of them")
    return torch.stack(found)


def report(
    config: FitGazeConfig,
    judged: dict[str, Tensor],
    losses: list[float],
    trained: int,
    held_out: int,
    sigma: tuple[float, float],
) -> str:
    """Report the training and the evaluation as Markdown.

    Args:
        config: the settings.
        judged: results of `judge` for the policy before training (`start`) and after it (`learned`).
        losses: the loss of every training step.
        trained: number of training photographs.
        held_out: number of held-out photographs.
        sigma: width of the fovea before and after training, in pixels.

    Returns:
        The text.
    """
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
            f"searches) and evaluated on {config.searches} searches in each of {held_out} held-out photographs. The "
            "table shows the targets found within so many gaze shifts (%), and the gain over the policy before "
            "training with its standard error over photographs.",
            "",
            *table([["policy", *(f"{n}" for n in shifts)], *rows]),
            "",
            f"Mean loss over the first quarter of the steps: {sum(losses[:quarter]) / quarter:.3f}; over the last "
            f"quarter: {sum(losses[-quarter:]) / quarter:.3f}. σ of the fovea: {sigma[0]:.1f} → {sigma[1]:.1f}.",
            "",
        ]
    )
