"""The photograph on which benchmarks run, a fixation in it, and the number of threads."""

import cv2
import torch
from torch import Tensor

from semfov.detection.placement import resize

GAZE, SIGMA = (290.0, 280.0), 100.0


def photograph(width: int = 640, height: int = 480) -> Tensor:
    """A photograph that scikit-image ships, `(1, 3, height, width)`."""
    from skimage import data

    return resize(torch.from_numpy(data.coffee()).permute(2, 0, 1)[None] / 255, (width, height)).clamp(0, 1)


def use_threads(count: int) -> None:
    """Set the number of threads of torch and of OpenCV."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
