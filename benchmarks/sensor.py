"""Time of the foveal sensor relative to the same sensor written with OpenCV and with Kornia, in one run.

The peers, each including its pyramid:

- `cv2, plain`: a straightforward version with `cv2.pyrDown`, `cv2.pyrUp`, and windows and sums in numpy;
- `cv2, tuned`: every step is a fused OpenCV call that writes into allocated memory; windows are outer products;
- `kornia`: `kornia.geometry.transform.pyrdown` and `pyrup`.

A repetition times all of them one after another, so that other work on the machine affects all alike. Results are
ratios of times within one repetition, as median and quartiles over repetitions. Below 1, semfov is faster.

python -m benchmarks.sensor
"""

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial

import cv2
import kornia.geometry.transform as kornia
import numpy as np
import torch
from torch import Tensor

from semfov.sensor import foveate, laplacian_pyramid
from semfov.sensor.pyramid import Convention

LEVELS = 5
GROWTH = 2.0
SIZES = ((480, 640), (416, 416))


def line(count: int, centre: float, sigma: float, step: int) -> np.ndarray:
    """Gaussian window along one axis, at every `step`-th pixel."""
    return np.exp(-((np.arange(count, dtype=np.float32) * step - centre) ** 2) / np.float32(2 * sigma**2))


def plain(image: np.ndarray, gaze: tuple[float, float], sigma: float) -> np.ndarray:
    """The sensor with OpenCV's pyramid, `(H, W, 3)`."""
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
    """The sensor with OpenCV's pyramid, `(H, W, 3)`, as fast as OpenCV's calls allow."""
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
    """The sensor with Kornia's pyramid, for sizes that can be halved `LEVELS` times without remainder."""
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


def interleaved(runs: dict[str, Callable[[], object]], repetitions: int) -> dict[str, list[float]]:
    """Milliseconds of every run in every repetition, after five warm-up repetitions."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for repetition in range(-5, repetitions):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if repetition >= 0:
                times[name].append(1e3 * (time.perf_counter() - start))
    return times


def measure(height: int, width: int, sigma: float, repetitions: int) -> None:
    """Measure one size with the current number of threads, and print its table."""
    torch.manual_seed(0)
    image, gaze = torch.rand(1, 3, height, width), torch.tensor([0.45 * width, 0.6 * height])
    array, point = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), (gaze[0].item(), gaze[1].item())
    peers: dict[str, Callable[[], np.ndarray | Tensor]] = {
        "cv2, plain": lambda: plain(array, point, sigma),
        "cv2, tuned": lambda: tuned(array, point, sigma),
        "kornia": lambda: with_kornia(image, gaze, sigma),
    }
    runs: dict[str, Callable[[], object]] = dict(peers)
    same: tuple[tuple[Convention, tuple[str, ...]], ...] = (
        ("kornia", ("kornia",)),
        ("opencv", ("cv2, plain", "cv2, tuned")),
    )
    for name, equals in same:
        bands = laplacian_pyramid(image, LEVELS, name)
        whole = partial(foveate, image, gaze, sigma=sigma, levels=LEVELS, convention=name)
        runs[f"semfov {name}, whole"] = whole
        runs[f"semfov {name}, pyramid reused"] = partial(foveate, bands, gaze, sigma=sigma)
        view = foveate(bands, gaze, sigma=sigma)
        for peer in equals:
            torch.testing.assert_close(view, planes(peers[peer]()), rtol=0, atol=1e-5)
    times = interleaved(runs, repetitions)
    threads = torch.get_num_threads()
    print(f"\n{width} x {height}, 3 channels, {threads} thread{'s' * (threads > 1)}, {repetitions} repetitions")
    print(
        f"{'ms: least, median':30s}", *(f"{min(times[p]):8.2f} {statistics.median(times[p]):8.2f}    " for p in peers)
    )
    print(f"{'time / time of':30s}", *(f"{p:21s}" for p in peers))
    for run in [run for run in runs if run not in peers]:
        cells = []
        for peer in peers:
            low, middle, high = statistics.quantiles([a / b for a, b in zip(times[run], times[peer], strict=True)], n=4)
            cells.append(f"{middle:5.2f} ({low:5.2f}-{high:5.2f})  ")
        print(f"{run:30s}", *cells, f"{min(times[run]):6.2f} {statistics.median(times[run]):6.2f} ms")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sigma", type=float, default=100.0, help="width of the fovea in pixels")
    parser.add_argument("--repetitions", type=int, default=100, help="number of repetitions")
    options = parser.parse_args()
    everything = torch.get_num_threads()
    with torch.inference_mode():
        for threads in sorted({1, everything}):
            torch.set_num_threads(threads)
            cv2.setNumThreads(threads)
            for height, width in SIZES:
                measure(height, width, options.sigma, options.repetitions)


if __name__ == "__main__":
    main()
