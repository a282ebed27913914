"""Comparison of the foveal sensor with the same sensor written with OpenCV and with Kornia.

The peers build their pyramid for every fixation:

- `OpenCV, plain`: a straightforward version with `cv2.pyrDown`, `cv2.pyrUp`, and windows and sums in numpy;
- `OpenCV, tuned`: every step is a fused OpenCV call that writes into allocated memory; windows are outer products;
- `Kornia's pyramid`: `kornia.geometry.transform.pyrdown` and `pyrup`.
"""

from collections.abc import Callable

import cv2
import kornia.geometry.transform as kornia
import numpy as np
import torch
from torch import Tensor

from benchmarks.machine import GAZE, SIGMA, photograph
from benchmarks.timing import Comparison
from semfov.sensor import foveate, laplacian_pyramid
from semfov.sensor.pyramid import Convention

LEVELS = 5
GROWTH = 2.0


def line(count: int, centre: float, sigma: float, step: int) -> np.ndarray:
    """Gaussian window along one axis, at every `step`-th pixel."""
    return np.exp(-((np.arange(count, dtype=np.float32) * step - centre) ** 2) / np.float32(2 * sigma**2))


def plain(image: np.ndarray, gaze: tuple[float, float], sigma: float) -> np.ndarray:
    """Return the sensor with OpenCV's pyramid, `(H, W, 3)`."""
    gaussian = [image]
    for _ in range(LEVELS):
        gaussian.append(cv2.pyrDown(gaussian[-1]))
    result = gaussian[-1]
    for k in reversed(range(LEVELS)):
        height, width = gaussian[k].shape[:2]
        band = gaussian[k] - cv2.pyrUp(gaussian[k + 1], dstsize=(width, height))
        x, y = np.meshgrid(np.arange(width, dtype=np.float32) * 2**k, np.arange(height, dtype=np.float32) * 2**k)
        distance = (x - gaze[0]) ** 2 + (y - gaze[1]) ** 2
        window = np.exp(-distance / np.float32(2 * (sigma * GROWTH**k) ** 2))
        result = cv2.pyrUp(result, dstsize=(width, height)) + window[..., None] * band
    return result


def tuned(image: np.ndarray, gaze: tuple[float, float], sigma: float) -> np.ndarray:
    """Return the sensor with OpenCV's pyramid, `(H, W, 3)`, as fast as OpenCV's calls allow."""
    gaussian, bands = [image], []
    for k in range(LEVELS):
        gaussian.append(cv2.pyrDown(gaussian[k]))
        band = cv2.pyrUp(gaussian[k + 1], dstsize=gaussian[k].shape[1::-1])
        bands.append(cv2.subtract(gaussian[k], band, dst=band))
    result = gaussian[-1]
    for k in reversed(range(LEVELS)):
        height, width = bands[k].shape[:2]
        wide = sigma * GROWTH**k
        window = np.outer(line(height, gaze[1], wide, 2**k), line(width, gaze[0], wide, 2**k))
        result = cv2.pyrUp(result, dstsize=(width, height))
        cv2.accumulateProduct(bands[k], cv2.merge([window] * 3), result)
    return result


def with_kornia(image: Tensor, gaze: Tensor, sigma: float) -> Tensor:
    """Return the sensor with Kornia's pyramid, for sizes that can be halved `LEVELS` times without remainder."""
    gaussian = [image]
    for _ in range(LEVELS):
        gaussian.append(kornia.pyrdown(gaussian[-1]))
    result = gaussian[-1]
    for k in reversed(range(LEVELS)):
        height, width = gaussian[k].shape[-2:]
        y, x = ((torch.arange(n) + 0.5) * (m / n) - 0.5 for n, m in zip((height, width), image.shape[-2:], strict=True))
        distance = (x - gaze[0]) ** 2 + (y[:, None] - gaze[1]) ** 2
        window = torch.exp(-distance / (2 * (sigma * GROWTH**k) ** 2))
        result = kornia.pyrup(result) + window * (gaussian[k] - kornia.pyrup(gaussian[k + 1]))
    return result


def planes(view: np.ndarray | Tensor) -> Tensor:
    """Convert a peer's view to semfov's layout, `(1, 3, H, W)`."""
    return view if isinstance(view, Tensor) else torch.from_numpy(view).permute(2, 0, 1)[None]


def foveation(convention: Convention, *, reuse: bool) -> Comparison:
    """Foveation for one fixation; peers build their pyramid each time, and so does semfov unless `reuse`."""
    image = photograph()
    pixels, gaze = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), torch.tensor(GAZE)
    kinds: dict[Convention, dict[str, Callable[[], np.ndarray | Tensor]]] = {
        "opencv": {
            "OpenCV, plain": lambda: plain(pixels, GAZE, SIGMA),
            "OpenCV, tuned": lambda: tuned(pixels, GAZE, SIGMA),
        },
        "kornia": {"Kornia's pyramid": lambda: with_kornia(image, gaze, SIGMA)},
    }
    peers = kinds[convention]
    source = laplacian_pyramid(image, LEVELS, convention) if reuse else image

    def ours() -> Tensor:
        return foveate(source, gaze, sigma=SIGMA, levels=LEVELS, convention=convention)

    def agree() -> None:
        for peer in peers.values():
            torch.testing.assert_close(ours(), planes(peer()), rtol=0, atol=1e-5)

    how = "pyramid reused" if reuse else "pyramid included"
    return Comparison(f"foveation, {convention} pyramid, {how}", ours, peers, {}, agree)
