"""What training on foveal views leaves: the new detector as an ONNX model, and a report."""

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
    """Write the detector, with the weights that its network has now, and a report; remove the views.

    Args:
        config: settings.
        viewer: whose detector it is.
        history: what came of the epochs.
        seconds: of processors that looking took.
    """
    detector = viewer.detector
    base, detector.name = detector.name, config.name or f"{detector.name}-foveal"
    path = inside(config.out, f"{detector.name}.onnx")
    text = report(config, viewer, base, history, seconds)
    export_onnx(detector, path, card=text)
    text += f"\nLargest difference of the file from what was trained: {largest_difference(detector, path):.1e}.\n"
    figures = {"base": base, "looking_seconds": seconds, "epochs": [asdict(epoch) for epoch in history]}
    write_outputs(config, text, ("training.json", json.dumps(figures, indent=2) + "\n"), path)
    shutil.rmtree(viewer.store.folder, ignore_errors=True)


def report(config: FinetuneConfig, viewer: Viewer, base: str, history: Sequence[Epoch], seconds: float) -> str:
    """What was trained, on what, and what came of it, as Markdown; the model's card."""
    detector, kept = viewer.detector, best_of(history)
    photographs = len(viewer.scenes)
    held_out = len(range(0, photographs, config.holdout))
    training = sum(epoch.seconds for epoch in history)
    rows = [["epoch", "rate", "training", "held out", "objectness", "classes", "boxes", "seconds", ""]]
    for number, epoch in enumerate(history):
        losses = (epoch.training, epoch.loss, epoch.objectness, epoch.classes, epoch.boxes)
        shown = ["-" if not number else f"{losses[0]:.3f}", *(f"{loss:.3f}" for loss in losses[1:])]
        what = "kept" if number == kept else "as it was" if not number else "trial" if epoch.trial else ""
        rate = f"{epoch.rate:.2g}" if number else "-"
        rows.append([str(number), rate, *shown, f"{epoch.seconds:.0f}", what])
    gain = history[0].loss - history[kept].loss
    told = training_of(config, viewer.scenes, "name")
    settings = {"eye": viewer.eye.settings(), **told, "layers": viewer.tail.trained}
    said = (
        f"The loss of a held-out view fell by {gain:.3f}, from {history[0].loss:.3f} to {history[kept].loss:.3f}."
        if kept
        else "No epoch was better on held-out photographs: the detector is as it was."
    )
    return "\n".join(
        [
            f"# {detector.name}",
            "",
            f"{base} (weights of sha256 {detector.digest}), trained on foveal views:",
            f"{_convolutions(config.depth)}, on {photographs - held_out} photographs with "
            f"{config.fixations} random fixations each, by the loss of YOLOv3 (Redmon and Farhadi 2018).",
            f"{held_out} photographs were held out to choose learning rate and epoch.",
            said,
            f"Looking took {seconds / 60:.1f} minutes of processors, training {training / 60:.1f}.",
            "",
            *table(rows),
            "",
            "Settings: " + json.dumps(settings, sort_keys=True),
            "",
        ]
    )


def _convolutions(depth: int) -> str:
    return "the last convolution before each head" if depth == 1 else f"the last {depth} convolutions before each head"
