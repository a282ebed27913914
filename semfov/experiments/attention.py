"""Attention by class templates, computed for a whole scene from the centre of every cell."""

from __future__ import annotations

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.experiments.looks import one_thread
from semfov.eye import Eye
from semfov.gaze.templates import ClassTemplates, at_points


def attend_all(eye: Eye, templates: ClassTemplates, image: Tensor, grid: Grid) -> Tensor:
    """Attention to every class in every cell of `image` `(3, H, W)`, seen from each cell's centre: `(X·Y, K, X·Y)`."""
    with one_thread(), torch.inference_mode():
        view, points = eye.open(image[None]), grid.centres.to(image)
        found = []
        for point in points:
            canvas = eye.foveated(view, point[None])
            maps = templates(eye.detector.features(canvas))
            found.append(at_points(maps, points, view.placement, (canvas.shape[-1], canvas.shape[-2])))
        return torch.cat(found)
