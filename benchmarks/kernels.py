"""Comparison of single functions with others' functions for the same work, and with themselves on less at once."""

from collections.abc import Callable

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.beliefs import CLASSES, LEVELS, make_belief, make_model, unvisited
from benchmarks.machine import GAZE, SIGMA, photograph
from benchmarks.timing import Comparison
from eval.presence import roc
from semfov import Grid, acquisition, foveate
from semfov.sensor import gaussian_pyramid, laplacian_pyramid

Array = NDArray[np.float32]
HALVED = 5


def pyramid() -> Comparison:
    """Return a Gaussian pyramid of a photograph, in OpenCV's convention."""
    image = photograph()
    pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())

    def opencv() -> Array:
        level = pixels
        for _ in range(HALVED):
            level = cv2.pyrDown(level)
        return level

    def ours() -> Tensor:
        return gaussian_pyramid(image, HALVED, "opencv")[-1]

    def agree() -> None:
        torch.testing.assert_close(ours(), torch.from_numpy(opencv()).permute(2, 0, 1)[None])

    return Comparison("Gaussian pyramid", ours, {"cv2.pyrDown": opencv}, {}, agree)


def at_once(name: str, ours: Callable[[], Tensor], one: Callable[[int], Tensor], count: int) -> Comparison:
    """Many views at once, compared with one at a time, as a list and as the same tensor."""

    def one_by_one() -> list[Tensor]:
        return [one(number) for number in range(count)]

    def joined() -> Tensor:
        return torch.cat(one_by_one())

    def agree() -> None:
        torch.testing.assert_close(ours().squeeze(), joined().squeeze())

    return Comparison(name, ours, {"one at a time": one_by_one, "one at a time, joined": joined}, {}, agree)


def pictures(count: int = 32) -> Comparison:
    """Foveation of many photographs."""
    images, gaze = photograph().repeat(count, 1, 1, 1), torch.tensor(GAZE).repeat(count, 1)

    def one(number: int) -> Tensor:
        return foveate(images[number : number + 1], gaze[number], sigma=SIGMA)

    return at_once(f"foveation of {count} photographs", lambda: foveate(images, gaze, sigma=SIGMA), one, count)


def fixations(count: int = 100) -> Comparison:
    """Foveation of a photograph for many fixations."""
    bands = laplacian_pyramid(photograph(416, 416), HALVED)
    gaze = 416 * torch.rand(1, count, 2, generator=torch.Generator().manual_seed(0))

    def one(number: int) -> Tensor:
        return foveate(bands, gaze[:, number], sigma=SIGMA)

    return at_once(f"foveation for {count} fixations", lambda: foveate(bands, gaze, sigma=SIGMA), one, count)


def half() -> Comparison:
    """Foveation in half precision, compared with single precision."""
    image, gaze = photograph(), torch.tensor(GAZE)
    small = image.half()
    return Comparison(
        "foveation in float16",
        lambda: foveate(small, gaze, sigma=SIGMA),
        {"float32": lambda: foveate(image, gaze, sigma=SIGMA)},
        {},
        lambda: torch.testing.assert_close(
            foveate(small, gaze, sigma=SIGMA).float(), foveate(image, gaze, sigma=SIGMA), rtol=0, atol=1e-2
        ),
    )


def lookahead(side: int = 64, classes: int = 365) -> Comparison:
    """Return a decision over many cells and classes, compared with small ones of as many elements in all."""

    def decision(cells: int, kinds: int) -> Callable[[], Tensor]:
        model, belief = make_model(kinds), make_belief(cells**2, kinds)
        value, visited = acquisition.KLDivergence(model, Grid(cells, cells, (640, 480))), unvisited(belief)
        return lambda: value(belief, visited)

    share = 10**2 * (CLASSES + 1) / (side**2 * (classes + 1))
    name = f"KL divergence, {side} x {side} cells, {classes} classes, {LEVELS} levels"
    few = f"10 x 10 cells, {CLASSES} classes, per element"
    return Comparison(name, decision(side, classes), {few: decision(10, CLASSES)}, {few: share})


def roc_curve(count: int = 16_000) -> Comparison:
    """Hit and false alarm rates at every threshold."""
    from sklearn.metrics import roc_curve as peer

    generator = torch.Generator().manual_seed(0)
    score = torch.rand(count, generator=generator)
    there = torch.rand(count, generator=generator) < score
    scores, truth = score.numpy(), there.numpy()

    def scikit() -> tuple[Array, ...]:
        return peer(truth, scores, drop_intermediate=False)

    def agree() -> None:
        for ours, theirs in zip(roc(score, there), scikit()[:2], strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-12)

    return Comparison(f"ROC curve of {count:,} scores", lambda: roc(score, there), {"scikit-learn": scikit}, {}, agree)
