"""Closer looks at an image that are made once and remembered."""

from collections.abc import Callable

from torch import Tensor

from semfov.detection.detections import Detections
from semfov.eye import Eye


class CloseUps:
    """Closer looks at one image (`semfov.Eye.close_up`), each made only once, whatever is searched for.

    Args:
        eye: the eye.
        image: gives the image, `(1, 3, H, W)`; called for looks that have not been made yet.
    """

    def __init__(self, eye: Eye, image: Callable[[], Tensor]) -> None:
        self.eye, self.image = eye, image
        self._seen: dict[tuple[float, ...], Detections] = {}

    def __call__(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`, or remember; returns the detections, a batch of one."""
        key = tuple(box.tolist())
        if key not in self._seen:
            self._seen[key] = self.eye.close_up(self.image(), box)
        return self._seen[key]
