"""Saliency of every cell of a scene, from every fixation or once for the whole photograph."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from eval.config import SaliencyConfig
from eval.store import SceneStore, code_digest
from semfov import Grid
from semfov.detection.placement import Placement
from semfov.eye import Eye, View
from semfov.gaze.saliency import VOCUS2, IttiKoch, cell_saliency

Model = Callable[[Tensor], Tensor]

SALIENCY_MODELS: dict[str, Callable[[], Model]] = {"vocus2": VOCUS2, "itti-koch": IttiKoch}


class SaliencyStore(SceneStore):
    """Saliency of a scene's cells, `(F, X·Y)` with F = X·Y fixations or 1.

    Args:
        folder: where the store lies.
        name: of the model.
        saliency: settings of the baselines.
        settings: `Eye.settings()`; what the whole photograph shows does not depend on them.
        grid: `(columns, rows)`.
    """

    def __init__(
        self, folder: Path, name: str, saliency: SaliencyConfig, settings: Mapping[str, Any], grid: tuple[int, int]
    ) -> None:
        what = {
            "model": name,
            "view": saliency.view,
            "reduction": saliency.reduction,
            "eye": settings if saliency.view == "foveated" else None,
            "grid": list(grid),
        }
        super().__init__(folder, what, code_digest("gaze/saliency/*.py"))

    def load(self, digest: str) -> Tensor | None:
        """Saliency of a scene, or None if the store does not have it whole."""
        tensors = self.read(digest)
        return None if tensors is None else tensors["saliency"]

    def save(self, digest: str, saliency: Tensor) -> None:
        """Keep the saliency of a scene."""
        self.write(digest, {"saliency": saliency})


def saliency_table(name: str, saliency: SaliencyConfig, eye: Eye, image: Tensor, grid: Grid) -> Tensor:
    """Saliency of every cell: seen from the centre of every cell `(X·Y, X·Y)`, or of the photograph `(1, X·Y)`.

    Args:
        name: of the model.
        saliency: settings of the baselines.
        eye: what the scene is seen through.
        image: `(3, H, W)`.
        grid: the grid over it.
    """
    model = SALIENCY_MODELS[name]()
    with torch.inference_mode():
        if saliency.view == "picture":
            return cells_of(model, image[None], grid, saliency)
        view = eye.open(image[None])
        # One view at a time: the bits then do not depend on which views share a batch.
        rows = [cells_of(model, foveated(eye, view, fixation[None]), grid, saliency) for fixation in grid.centres]
        return torch.cat(rows)


def cells_of(model: Model, pictures: Tensor, grid: Grid, saliency: SaliencyConfig) -> Tensor:
    """Saliency of the cells of pictures `(B, 3, h, w)`, `(B, X·Y)`."""
    return cell_saliency(model(pictures), grid.columns, grid.rows, saliency.reduction)


def foveated(eye: Eye, view: View, fixations: Tensor) -> Tensor:
    """What the detector is shown from fixations `(F, 2)`, without the canvas around the picture: `(F, 3, h, w)`."""
    return cut(eye.foveated(view, fixations), view.placement)


def cut(canvases: Tensor, placement: Placement) -> Tensor:
    """The picture on canvases `(F, 3, H, W)`."""
    left, top = placement.offset
    width, height = (round(n * s) for n, s in zip(placement.size, placement.scale, strict=True))
    return canvases[..., top : top + height, left : left + width]


def milliseconds_per_map(
    name: str, saliency: SaliencyConfig, eye: Eye, image: Tensor, grid: Grid, repetitions: int = 7
) -> float:
    """Median time for the saliency of the cells of one picture, that is seen from the first cell or whole."""
    model, times = SALIENCY_MODELS[name](), []
    with torch.inference_mode():
        picture = image[None]
        if saliency.view == "foveated":
            picture = foveated(eye, eye.open(picture), grid.centres[:1])
        for _ in range(repetitions):
            began = time.perf_counter()
            cells_of(model, picture, grid, saliency)
            times.append(time.perf_counter() - began)
    return 1000 * sorted(times)[len(times) // 2]
