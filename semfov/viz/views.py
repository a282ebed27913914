"""What the eye was shown during an episode."""

import torch
from torch import Tensor

from semfov.detection.placement import Placement
from semfov.eye import Eye


def foveated_views(eye: Eye, image: Tensor, fixations: Tensor) -> list[Tensor]:
    """What the detector is shown of an image `(3, H, W)` from each of the fixations `(n, 2)`: `(3, h, w)` each.

    At the detector's resolution, without the canvas around the picture.
    """
    with torch.inference_mode():
        view = eye.open(image[None])
        # One at a time: all views of a large canvas at once take gigabytes.
        return [cut(eye.foveated(view, fixation[None]), view.placement)[0] for fixation in fixations]


def cut(canvases: Tensor, placement: Placement) -> Tensor:
    """The picture on canvases `(F, 3, H, W)`, without what is around it."""
    left, top = placement.offset
    width, height = (round(n * s) for n, s in zip(placement.size, placement.scale, strict=True))
    return canvases[..., top : top + height, left : left + width]
