"""Computes the looks that are stored, bit for bit the same with any number of threads and processes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.detection.detections import Detections
from semfov.eye import Eye

SOURCES = ("semfov.eye", "semfov.detection.load", "semfov.sensor.named", "semfov.data.images", __name__)
"""The modules that turn an image into detections; all modules that they import count, too."""


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread, because the last bits of a parallel sum depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def look_from(eye: Eye, image: Tensor, points: Tensor) -> Detections:
    """Look at an image from each of several fixations.

    The views pass through the detector one at a time and on one thread. The bits then depend neither on which views
    share a batch nor on the number of CPU cores. The eye must have been made on one thread, too (`setup.make_eye`):
    a session of onnxruntime keeps the number of threads that it was opened with.

    Args:
        eye: the eye.
        image: `(3, H, W)`.
        points: `(F, 2)`, the fixations in pixels of the image.

    Returns:
        The detections from each fixation, a batch of F.
    """
    with one_thread(), torch.inference_mode():
        view = eye.open(image[None])
        return Detections.stack([eye.look(view, point[None]) for point in points])


def see_all(eye: Eye, image: Tensor, grid: Grid) -> Detections:
    """Detections in `image` `(3, H, W)` from the centre of every cell, a batch of X·Y (`look_from`)."""
    return look_from(eye, image, grid.centres.to(image))
