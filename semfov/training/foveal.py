"""Train the heads of a detector on foveal views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import torch
from torch import Tensor

from semfov.errors import DataError
from semfov.experiments.looks import one_thread
from semfov.experiments.parallel import processor_seconds
from semfov.experiments.progress import task_bar
from semfov.experiments.run import digest_of
from semfov.experiments.seeds import generator_for
from semfov.experiments.store import versions
from semfov.io.code import modules_digest
from semfov.io.storage import read, write
from semfov.training.foveal_epochs import Epoch, best_of, next_epoch
from semfov.training.foveal_report import write_detector
from semfov.training.foveal_settings import FinetuneConfig
from semfov.training.foveal_views import Viewer, Views, look
from semfov.training.outputs import training_of
from semfov.training.yolo_loss import Losses, yolo_loss

KIND = "foveal-training"


class Trainer:
    """Train the tail of a detector, epoch by epoch, with a checkpoint after each epoch.

    Args:
        config: the settings.
        viewer: the viewer, whose detector is trained.
        views: the views of all photographs, in order.

    Raises:
        DataError: there are too few photographs to train on and to hold out.
    """

    def __init__(self, config: FinetuneConfig, viewer: Viewer, views: Sequence[Views]) -> None:
        self.config, self.tail, self.views = config, viewer.tail, views
        self.heads = viewer.detector.network.heads
        self.parameters = self.tail.named_parameters()
        self.base = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
        held_out = range(0, len(views), config.holdout)
        self.held_out = [(index, number) for index in held_out for number in range(len(views[index]))]
        self.trained = [
            (index, number)
            for index in range(len(views))
            if index not in held_out
            for number in range(len(views[index]))
        ]
        if not self.trained:
            raise DataError(
                f"data: expected at least 2 photographs, one to train on and one to hold out, got {len(views)}"
            )
        self.history: list[Epoch] = []
        self.kept = self.base
        self.moments: dict[str, Tensor] = {}

    def batches(self, chosen: Sequence[tuple[int, int]], generator: torch.Generator | None) -> Iterator[Views]:
        """Group views into batches of canvases of the same size.

        Args:
            chosen: index of the photograph and number of the view, for each view.
            generator: source of the random order (None: keep the order).

        Yields:
            One batch of views.
        """
        order = range(len(chosen)) if generator is None else torch.randperm(len(chosen), generator=generator).tolist()
        sizes: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for place in order:
            sizes.setdefault(self.views[chosen[place][0]].canvas, []).append(chosen[place])
        size = self.config.batch
        parts = [group[at : at + size] for group in sizes.values() for at in range(0, len(group), size)]
        turns = range(len(parts)) if generator is None else torch.randperm(len(parts), generator=generator).tolist()
        for turn in turns:
            yield Views.join([(self.views[index], number) for index, number in parts[turn]])

    def losses(self, batch: Views) -> Losses:
        """Compute the loss of a batch with the current weights."""
        maps = self.tail(batch.features)
        return yolo_loss(maps, self.heads, batch.canvas, batch.boxes, batch.labels, ignore=self.config.ignore)

    def judge(self) -> tuple[float, float, float]:
        """Compute the mean loss of a held-out view, as objectness, classes and boxes."""
        total = torch.zeros(3, dtype=torch.float64)
        with torch.inference_mode():
            for batch in self.batches(self.held_out, None):
                parts = self.losses(batch)
                total += torch.stack([parts.objectness, parts.classes, parts.boxes]).double()
        objectness, classes, boxes = (total / len(self.held_out)).tolist()
        return objectness, classes, boxes

    def train(self, rate: float, trial: bool) -> None:
        """Train for one epoch, and keep its weights if its loss is lower than that of all epochs before.

        Args:
            rate: learning rate.
            trial: start from the original weights, to try this learning rate; otherwise from the best weights so far.
        """
        started = processor_seconds()
        self._set(self.base if trial else self.kept)
        optimiser = torch.optim.Adam(self.parameters.values(), lr=rate)
        if not trial:
            self._restore(optimiser)
        generator = generator_for("epoch", self.config.seed, len(self.history))
        total = 0.0
        title = f"epoch {len(self.history)}, rate {rate:.1g}"
        for parameter in self.parameters.values():
            parameter.requires_grad_(True)
        with closing(task_bar(len(self.trained), title, "view")) as bar:
            for batch in self.batches(self.trained, generator):
                loss = self.losses(batch).total
                optimiser.zero_grad()
                (loss / len(batch)).backward()
                optimiser.step()
                total += float(loss.detach())
                bar.update(len(batch))
        for parameter in self.parameters.values():
            parameter.requires_grad_(False)
        parts = self.judge()
        self.history.append(Epoch(rate, trial, total / len(self.trained), *parts, processor_seconds() - started))
        if best_of(self.history) == len(self.history) - 1:
            self.kept = {name: parameter.detach().clone() for name, parameter in self.parameters.items()}
            self.moments = _moments(optimiser, list(self.parameters))

    def run(self, path: Path, key: str) -> None:
        """Train to the end. Afterwards the detector has the best weights.

        Args:
            path: checkpoint file. Training continues from it if it exists.
            key: identifies the training (`training_key`).
        """
        self.load(path, key)
        if not self.history:
            started = processor_seconds()
            parts = self.judge()
            self.history.append(Epoch(0.0, False, sum(parts), *parts, processor_seconds() - started))
            self.save(path, key)
        while (following := next_epoch(self.history, self.config)) is not None:
            self.train(*following)
            self.save(path, key)
        self._set(self.kept)

    def save(self, path: Path, key: str) -> None:
        """Write a checkpoint."""
        record = {"kind": KIND, "key": key, "history": [asdict(epoch) for epoch in self.history]}
        write(path, {**self.kept, **self.moments}, record)

    def load(self, path: Path, key: str) -> None:
        """Continue from a checkpoint. Start from the beginning if there is none, or if it has another key."""
        try:
            tensors, record = read(path, KIND)
            history = [Epoch(**epoch) for epoch in record["history"]]
        except (DataError, TypeError, KeyError):
            return
        if record.get("key") == key and self.base.keys() <= tensors.keys():
            self.history = history
            self.kept = {name: tensors.pop(name) for name in self.base}
            self.moments = tensors

    def _set(self, weights: dict[str, Tensor]) -> None:
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(weights[name])

    def _restore(self, optimiser: torch.optim.Adam) -> None:
        """Restore Adam's averages of the gradients and their squares as they were at the best weights."""
        for name, parameter in self.parameters.items():
            for what in _MOMENTS:
                if f"{what} {name}" in self.moments:
                    optimiser.state[parameter][what] = self.moments[f"{what} {name}"].clone()


_MOMENTS = ("step", "exp_avg", "exp_avg_sq")


def _moments(optimiser: torch.optim.Adam, names: Sequence[str]) -> dict[str, Tensor]:
    parameters = optimiser.param_groups[0]["params"]
    return {
        f"{what} {name}": optimiser.state[parameter][what].clone()
        for name, parameter in zip(names, parameters, strict=True)
        for what in _MOMENTS
    }


def finetune(config: FinetuneConfig) -> None:
    """Compute the views, train, and write the new detector and its report."""
    viewer = Viewer(config)
    views, seconds = look(viewer)
    trainer = Trainer(config, viewer, views)
    with one_thread():
        trainer.run(config.out / "training.safetensors", training_key(config, viewer))
        write_detector(config, viewer, trainer.history, seconds)


def training_key(config: FinetuneConfig, viewer: Viewer) -> str:
    """Return the sha256 of everything that the training depends on."""
    settings = training_of(config, viewer.scenes, "name")
    return digest_of([viewer.store.key, settings, versions(), modules_digest(__name__)])
