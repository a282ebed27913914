"""Closer looks at an image that are made once and remembered."""

from collections.abc import Callable

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.experiments.looks import one_thread
from semfov.experiments.store import tight
from semfov.eye import Eye


class CloseUps:
    """Closer looks at one image (`semfov.Eye.close_up`), each made only once, whatever is searched for.

    Args:
        eye: the eye.
        image: gives the image, `(1, 3, H, W)`; called for looks that have not been made yet.

    Attributes:
        seen: the closer looks by examined box.
    """

    def __init__(self, eye: Eye, image: Callable[[], Tensor]) -> None:
        self.eye, self.image = eye, image
        self.seen: dict[tuple[float, ...], Detections] = {}

    def __call__(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`, or remember; returns the detections, a batch of one."""
        key = tuple(box.tolist())
        if key not in self.seen:
            with one_thread(), torch.inference_mode():
                self.seen[key] = tight(self.eye.close_up(self.image(), box))
        return self.seen[key]
