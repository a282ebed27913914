"""Spaces, observations and infos of the environments as arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import interpolate

from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.envs.gazes import Explorations, Gazes, Searches
from semfov.envs.scenery import Scenery
from semfov.errors import check_whole

Arrays = dict[str, Any]

GAZES: dict[str, type[Gazes]] = {"search": Searches, "exploration": Explorations}


def observation_space(scenery: Scenery, task: str, *, belief: bool, glimpse: int | None) -> spaces.Dict:
    """The space of the observations of one episode, for the arguments of `GazeEnv`."""
    shown: dict[str, spaces.Space[Any]] = {
        "gaze": spaces.Box(0, 1, (2,), np.float32),
        "target": spaces.Discrete(len(scenery.classes)),
        "step": spaces.Discrete(scenery.shifts + 1),
    }
    if belief:
        shown["belief"] = belief_space(scenery, task)
    if glimpse is not None:
        shown["glimpse"] = glimpse_space(glimpse)
    return spaces.Dict(shown)


def belief_space(scenery: Scenery, task: str) -> spaces.Box:
    """Space of the belief's planes: probability of the target, or of all classes in an exploration, and two more."""
    probabilities = 1 if task == "search" else len(scenery.classes)
    return spaces.Box(0, 1, (probabilities + 2, *scenery.shape), np.float32)


def glimpse_space(side: int) -> spaces.Box:
    """Space of the foveated image, `side` pixels wide and high."""
    check_whole(side, "glimpse", 1, 4096)
    return spaces.Box(0, 255, (side, side, 3), np.uint8)


def observations_of(gazes: Gazes, rows: Tensor, *, belief: bool, glimpse: int | None) -> Arrays:
    """Observations of the episodes in rows `(n,)`, each array `(n, ...)`."""
    shown: Arrays = {
        "gaze": gazes.places(rows).float().numpy(),
        "target": gazes.targets[rows].numpy(),
        "step": gazes.shift[rows].numpy(),
    }
    if belief:
        shown["belief"] = belief_planes(gazes, rows)
    if glimpse is not None:
        shown["glimpse"] = glimpses(gazes, rows, glimpse)
    return shown


@torch.inference_mode()
def belief_planes(gazes: Gazes, rows: Tensor) -> NDArray[np.float32]:
    """Planes of probabilities, of the fixated cells and of the cell of the gaze, `(n, C+2, Y, X)`."""
    visited = gazes.memory.visited[rows]
    here = torch.zeros_like(visited).scatter(1, gazes.cell[rows, None], True)
    more = torch.stack([visited, here], 1).reshape(len(rows), 2, *gazes.scenery.shape)
    found: NDArray[np.float32] = torch.cat([gazes.map(rows).float().clamp(0, 1), more.float()], 1).numpy()
    return found


@torch.inference_mode()
def glimpses(gazes: Gazes, rows: Tensor, side: int) -> NDArray[np.uint8]:
    """Foveated images that the eye sees, `(n, side, side, 3)`."""
    eye, found = gazes.scenery.run.eye, []
    for row, point in zip(rows.tolist(), gazes.points(rows), strict=True):
        view = gazes.scenery.view(gazes.episodes[row].scene)
        left, top = view.placement.offset
        wide, high = (round(n * s) for n, s in zip(view.placement.size, view.placement.scale, strict=True))
        seen = eye.foveated(view, point[None])[..., top : top + high, left : left + wide]
        found.append(interpolate(seen, (side, side), mode="bilinear", antialias=True)[0])
    pixels: NDArray[np.uint8] = torch.stack(found).clamp(0, 1).mul(255).round().byte().permute(0, 2, 3, 1).numpy()
    return np.ascontiguousarray(pixels)


def infos_of(gazes: Gazes, rows: Tensor, *, detections: bool) -> Arrays:
    """Infos of the episodes in rows `(n,)`, each array `(n, ...)`."""
    passes = gazes.shift[rows] + 1
    infos: Arrays = {
        "passes": passes.numpy(),
        "pixels": (passes * gazes.scenery.pixels).numpy(),
        "action_mask": (~gazes.memory.visited[rows]).to(torch.int8).numpy(),
        "result": gazes.result(rows).float().numpy(),
        "scene": np.array([gazes.episodes[row].scene for row in rows.tolist()]),
    }
    if detections:
        infos["detections"] = detection_arrays(gazes.seen(rows), gazes.scenery.run.eye.detector)
    return infos


def detection_arrays(seen: Detections, detector: Detector) -> Arrays:
    """Detections as arrays of one shape, padded to the largest number L that the detector gives.

    Gymnasium's own vectorised environments require infos of constant shape.

    Args:
        seen: detections of n looks.
        detector: the detector, which limits their number.

    Returns:
        `boxes` `(n, L, 4)`, `scores` `(n, L, K+1)` and `mask` `(n, L)`, which is true for entries that are detections.
    """
    number, count = seen.mask.shape
    limit, components = max(detector.selection.limit, count), seen.scores.shape[-1]
    boxes = np.zeros((number, limit, 4), np.float32)
    scores = np.zeros((number, limit, components), np.float32)
    mask = np.zeros((number, limit), bool)
    boxes[:, :count], scores[:, :count], mask[:, :count] = seen.boxes.numpy(), seen.scores.numpy(), seen.mask.numpy()
    return {"boxes": boxes, "scores": scores, "mask": mask}


def first(arrays: Arrays) -> Arrays:
    """The first entry of each array."""
    one = {name: first(value) if isinstance(value, dict) else value[0] for name, value in arrays.items()}
    return {name: value.item() if isinstance(value, np.generic) else value for name, value in one.items()}
