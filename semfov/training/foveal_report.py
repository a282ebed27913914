"""The outputs of training on foveal views: the new detector as an ONNX model, and a report."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict

from semfov.detection.export import export_onnx, largest_difference
from semfov.experiments.summary import table
from semfov.io.files import inside
from semfov.training.foveal_epochs import Epoch, best_of
from semfov.training.foveal_settings import FinetuneConfig
from semfov.training.foveal_views import Viewer
from semfov.training.outputs import training_of, write_outputs


def write_detector(config: FinetuneConfig, viewer: Viewer, history: Sequence[Epoch], seconds: float) -> None:
    """Write the detector with its current weights and a report, and remove the stored views.

    Args:
        config: the settings.
        viewer: the viewer, whose detector was trained.
        history: results of the epochs.
        seconds: processor seconds that computing the views took.
    """
    detector = viewer.detector
    base, detector.name = detector.name, config.name or f"{detector.name}-foveal"
    path = inside(config.out, f"{detector.name}.onnx")
    text = report(config, viewer, base, history, seconds)
    export_onnx(detector, path, card=text)
    text += (
        "\nLargest difference between the outputs of the file and of the trained network: "
        f"{largest_difference(detector, path):.1e}.\n"
    )
    figures = {"base": base, "looking_seconds": seconds, "epochs": [asdict(epoch) for epoch in history]}
    write_outputs(config, text, ("training.json", json.dumps(figures, indent=2) + "\n"), path)
    shutil.rmtree(viewer.store.folder, ignore_errors=True)


def report(config: FinetuneConfig, viewer: Viewer, base: str, history: Sequence[Epoch], seconds: float) -> str:
    """Write the report on the training as Markdown. It is also the card of the model.

    Args:
        config: the settings.
        viewer: the viewer, whose detector was trained.
        base: name of the original detector.
        history: results of the epochs.
        seconds: processor seconds that computing the views took.

    Returns:
        The text.
    """
    detector, kept = viewer.detector, best_of(history)
    photographs = len(viewer.scenes)
    held_out = len(range(0, photographs, config.holdout))
    training = sum(epoch.seconds for epoch in history)
    rows = [["epoch", "rate", "training", "held out", "objectness", "classes", "boxes", "seconds", "note"]]
    for number, epoch in enumerate(history):
        losses = (epoch.training, epoch.loss, epoch.objectness, epoch.classes, epoch.boxes)
        shown = ["-" if not number else f"{losses[0]:.3f}", *(f"{loss:.3f}" for loss in losses[1:])]
        note = "kept" if number == kept else "original" if not number else "trial" if epoch.trial else ""
        rate = f"{epoch.rate:.2g}" if number else "-"
        rows.append([str(number), rate, *shown, f"{epoch.seconds:.0f}", note])
    gain = history[0].loss - history[kept].loss
    settings = {
        "eye": viewer.eye.settings(),
        **training_of(config, viewer.scenes, "name"),
        "layers": viewer.tail.trained,
    }
    result = (
        f"The loss of a held-out view fell by {gain:.3f}, from {history[0].loss:.3f} to {history[kept].loss:.3f}."
        if kept
        else "No epoch reduced the loss on held-out photographs, so the detector has its original weights."
    )
    return "\n".join(
        [
            f"# {detector.name}",
            "",
            f"{base} (sha256 of its weights: {detector.digest}), fine-tuned on foveal views. Training changed",
            f"{_convolutions(config.depth)}. It used {photographs - held_out} photographs with "
            f"{config.fixations} random fixations each and the loss of YOLOv3 (Redmon and Farhadi 2018).",
            f"{held_out} photographs were held out to choose the learning rate and the epoch.",
            result,
            f"Computing the views took {seconds / 60:.1f} processor minutes, training {training / 60:.1f}.",
            "",
            *table(rows),
            "",
            "Settings: " + json.dumps(settings, sort_keys=True),
            "",
        ]
    )


def _convolutions(depth: int) -> str:
    return "the last convolution before each head" if depth == 1 else f"the last {depth} convolutions before each head"
