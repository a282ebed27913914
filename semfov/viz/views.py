"""What the eye was shown during an episode."""

from torch import Tensor

from semfov.eye import Eye
from semfov.scanpath import Stimulus


def foveated_views(eye: Eye, image: Tensor, fixations: Tensor) -> list[Tensor]:
    """What the detector is shown of an image `(3, H, W)` from each of the fixations `(n, 2)`: `(3, h, w)` each.

    At the detector's resolution, without the canvas around the picture. A scanpath of an agent's has them at hand
    (`Scanpath.views`).
    """
    return Stimulus.of(eye, image).views(fixations)
