"""Comparison of sensor and saliency with OpenCV and Kornia, for one photograph of 640 × 480."""

from collections.abc import Callable

import cv2
import numpy as np
import torch

from benchmarks.saliency import Array, gabor_filters, itti_koch_opencv, vocus2_opencv
from benchmarks.sensor import LEVELS, plain, planes, tuned, with_kornia
from benchmarks.timing import Comparison
from semfov.detection.placement import resize
from semfov.gaze.saliency import VOCUS2, IttiKoch
from semfov.sensor import foveate, laplacian_pyramid
from semfov.sensor.pyramid import Convention

GAZE, SIGMA = (290.0, 280.0), 100.0


def photograph() -> torch.Tensor:
    """A photograph that scikit-image ships, `(1, 3, 480, 640)`."""
    from skimage import data

    return resize(torch.from_numpy(data.coffee()).permute(2, 0, 1)[None] / 255, (640, 480)).clamp(0, 1)


def foveation(convention: Convention, *, reuse: bool) -> Comparison:
    """Foveation for one fixation; peers build their pyramid each time, and so does semfov unless `reuse`."""
    image = photograph()
    pixels, gaze = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), torch.tensor(GAZE)
    kinds: dict[Convention, dict[str, Callable[[], Array | torch.Tensor]]] = {
        "opencv": {
            "OpenCV, plain": lambda: plain(pixels, GAZE, SIGMA),
            "OpenCV, tuned": lambda: tuned(pixels, GAZE, SIGMA),
        },
        "kornia": {"Kornia's pyramid": lambda: with_kornia(image, gaze, SIGMA)},
    }
    peers = kinds[convention]
    source = laplacian_pyramid(image, LEVELS, convention) if reuse else image

    def ours() -> torch.Tensor:
        return foveate(source, gaze, sigma=SIGMA, levels=LEVELS, convention=convention)

    def agree() -> None:
        for peer in peers.values():
            torch.testing.assert_close(ours(), planes(peer()), rtol=0, atol=1e-5)

    how = "pyramid reused" if reuse else "pyramid included"
    return Comparison(f"foveation, {convention} pyramid, {how}", ours, peers, {}, agree)


def saliency(name: str) -> Comparison:
    """Computation of a saliency map."""
    image = photograph()
    pixels, filters = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), gabor_filters()
    model = VOCUS2() if name == "VOCUS2" else IttiKoch()
    peer = (lambda: vocus2_opencv(pixels, 2, 6)) if name == "VOCUS2" else lambda: itti_koch_opencv(pixels, filters)
    return Comparison(f"saliency, {name}", lambda: model(image), {"OpenCV": peer})


def use_threads(count: int) -> None:
    """Set the number of threads of torch and of OpenCV."""
    torch.set_num_threads(count)
    cv2.setNumThreads(count)
