"""What the eye was shown during an episode."""

import torch
from torch import Tensor

from eval.saliency import foveated
from semfov import Eye


def foveated_views(eye: Eye, image: Tensor, fixations: Tensor) -> list[Tensor]:
    """What the detector is shown of an image `(3, H, W)` from each of the fixations `(n, 2)`: `(3, h, w)` each.

    At the detector's resolution, without the canvas around the picture.
    """
    with torch.inference_mode():
        view = eye.open(image[None])
        # One at a time: all views of a large canvas at once take gigabytes.
        return [foveated(eye, view, fixation[None])[0] for fixation in fixations]
