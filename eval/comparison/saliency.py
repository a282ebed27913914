"""Stores the saliency of every cell of a scene, from every fixation or once for the whole photograph."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detector import Detector
from semfov.detection.placement import resize
from semfov.errors import lookup
from semfov.gaze.saliency import VOCUS2, FixationDensity, IttiKoch, cell_saliency
from semfov.gaze.saliency.cells import Reduction
from semfov.io.code import modules_digest
from semfov.io.schema import Field, Schema
from semfov.runs.looks import LOOK_SOURCES
from semfov.runs.store import SceneStore
from semfov.sensor.base import Sensor
from semfov.threads import one_thread

_SaliencyMap = Callable[[Tensor], Tensor]

_SOURCES = ("semfov.gaze.saliency", "semfov.belief.grid", __name__)
"""Modules that saliency depends on, in addition to those of a look."""

SALIENCY_CLASSES: dict[str, Callable[[], _SaliencyMap]] = {"vocus2": VOCUS2, "itti-koch": IttiKoch}


_SaliencyView = Literal["foveated", "picture"]
"""What saliency is computed of: the foveated view from each fixation, or the whole photograph once."""


class SaliencyStore(SceneStore):
    """Saliency of a scene's cells on disk, `(F, X·Y)` for F = X·Y fixations, or F = 1 for the whole photograph.

    Shapes: grid `(columns, rows)`.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        view: _SaliencyView,
        reduction: Reduction,
        sensor: Mapping[str, Any],
        grid: tuple[int, int],
        detector: Mapping[str, Any] | None = None,
    ) -> None:
        what: dict[str, Any] = {
            "model": name,
            "view": view,
            "reduction": reduction,
            "sensor": sensor if view == "foveated" else None,
            "grid": list(grid),
        }
        if name not in SALIENCY_CLASSES:  # which see the pixels alone
            what["detector"] = detector
        cells = grid[0] * grid[1]
        schema = Schema({"saliency": Field(("F", cells), low=0)})
        super().__init__(folder, what, modules_digest(*LOOK_SOURCES, *_SOURCES), schema)
        self.fixations = cells if view == "foveated" else 1

    def load(self, digest: str) -> Tensor | None:
        """Read the saliency of a scene; None if it is missing or incomplete."""
        tensors = self.read(digest)
        return None if tensors is None or len(tensors["saliency"]) != self.fixations else tensors["saliency"]

    def save(self, digest: str, saliency: Tensor) -> None:
        """Store the saliency of a scene."""
        self.write(digest, {"saliency": saliency})


def saliency_map(name: str, detector: Detector) -> _SaliencyMap:
    """Return what gives the saliency of pictures `(B, 3, H, W)` → `(B, H, W)`.

    Args:
        name: a model of `SALIENCY_CLASSES`, or `people` for the density of fixations.
        detector: its features give the density.

    Returns:
        The map of pictures.

    Raises:
        InputError: the name is unknown.
    """
    if name in SALIENCY_CLASSES:
        return SALIENCY_CLASSES[name]()
    lookup(name, [*SALIENCY_CLASSES, "people"], "saliency model")
    density = FixationDensity.for_detector(detector).requires_grad_(False)
    return lambda image: density(detector.features(image, [*density.layers])).exp()


def saliency_table(
    model: _SaliencyMap,
    view: _SaliencyView,
    reduction: Reduction,
    sensor: Sensor,
    reference: float,
    image: Tensor,
    grid: Grid,
) -> Tensor:
    """Compute the saliency of every cell of a photograph.

    Args:
        model: gives the saliency of pictures.
        view: whether it sees the foveated view from each cell, or the photograph as it is.
        reduction: how the saliency of pixels becomes that of cells.
        sensor: the sensor of the views.
        reference: longer side of a photograph for which the sensor is made.
        image: the photograph, `(3, H, W)`.
        grid: the cells.

    Returns:
        `(X·Y, X·Y)`, a row for each fixated cell; for the photograph as it is `(1, X·Y)`.
    """
    with one_thread(), torch.inference_mode():
        if view == "picture":
            return cell_saliency(model(image[None]), grid.columns, grid.rows, reduction)
        state, fixations = open_at_reference(sensor, reference, image, grid.centres)
        # One view at a time: rounding then does not depend on which views share a batch.
        rows = []
        for fixation in fixations:
            foveated = sensor.picture(state, fixation[None])
            rows.append(cell_saliency(model(foveated), grid.columns, grid.rows, reduction))
        return torch.cat(rows)


def open_at_reference(sensor: Sensor, reference: float, image: Tensor, points: Tensor) -> tuple[Any, Tensor]:
    """Open a photograph `(3, H, W)`, resized to a longer side of `reference`, and move `points` `(F, 2)` there."""
    height, width = image.shape[-2:]
    scale = reference / max(height, width)
    size = (round(width * scale), round(height * scale))
    ratio = points.new_tensor(size) / points.new_tensor((width, height))
    state = sensor.open(resize(image[None], size), ratio.new_ones(2))
    return state, (points + 0.5) * ratio - 0.5
