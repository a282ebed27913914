"""Milliseconds of both saliency models for one photograph, compared with the same models in OpenCV, in one run.

The OpenCV programs do the same work in the same order; they, too, average maps before enlarging them. Repetitions are
interleaved. The table gives median and quartiles of the times, and of their ratios within a repetition.

python -m benchmarks.saliency --size 640 480 --threads 2
"""

import argparse
import statistics
import time
from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from semfov.gaze.saliency import VOCUS2, IttiKoch

Array = NDArray[Any]


def photograph(width: int, height: int) -> Tensor:
    """A photograph that scikit-image ships, `(1, 3, height, width)`."""
    from skimage import data

    image = torch.from_numpy(data.coffee()).permute(2, 0, 1)[None] / 255
    return F.interpolate(image, (height, width), mode="area")


def blur(image: Array, sigma: float) -> Array:
    """Blur a map by a Gaussian."""
    return cv2.GaussianBlur(image, (0, 0), sigma, borderType=cv2.BORDER_REPLICATE)


def stretch(image: Array) -> Array:
    """Scale a map to the range from 0 to 1; a constant map becomes 0."""
    low, high = image.min(), image.max()
    return (image - low) / (high - low) if high > low else image - low


def vocus2_opencv(image: Array, centre: float, surround: float, layers: int = 5, scales: int = 2) -> Array:
    """VOCUS2 saliency of an image `(H, W, 3)`."""
    red, green, blue = cv2.split(image)
    base = cv2.merge([(red + green + blue) / 3, red - green, blue - (red + green) / 2])
    height, width = image.shape[:2]
    wider = (surround**2 - centre**2) ** 0.5
    saliency = np.zeros((height, width), np.float32)
    base = blur(base, centre)
    for layer in range(layers):
        total = np.zeros(base.shape[:2], np.float32)
        for scale in range(scales):
            growth = 2 ** (scale / scales)
            difference = cv2.absdiff(base, blur(base, growth * wider))
            total += cv2.transform(difference, np.full((1, 3), 1 / 6, np.float32))
            base = blur(base, growth * centre * (2 ** (2 / scales) - 1) ** 0.5)
        saliency += (
            cv2.resize(total / scales, (width, height), interpolation=cv2.INTER_CUBIC) if layer else total / scales
        )
        base = cv2.resize(base, (base.shape[1] // 2, base.shape[0] // 2), interpolation=cv2.INTER_NEAREST)
    return stretch(saliency / layers)


def promote(image: Array) -> Array:
    """The normalisation operator N(.) of Itti, Koch and Niebur for one map `(h, w)`."""
    image = stretch(image)
    # Among equal neighbours only the first counts as a peak.
    earlier = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 0]], np.uint8)
    above, level = cv2.dilate(image, earlier), cv2.dilate(image, np.ascontiguousarray(earlier[::-1, ::-1]))
    peaks = image[(image > above) & (image >= level) & (image > 0.1)]
    others = (peaks.sum() - 1) / (len(peaks) - 1) if len(peaks) > 1 else 0.0
    return image * np.float32((1 - others) ** 2)


def total(images: Iterable[Array]) -> Array:
    """The sum of images."""
    return reduce(np.add, images)


def gabor_filters() -> list[Array]:
    """Even and odd Gabor filters of four orientations."""
    y, x = np.mgrid[-4:5, -4:5].astype(np.float32)
    filters = []
    for angle in np.deg2rad([0, 45, 90, 135]):
        wave = 2 * np.pi / 7 * (x * np.cos(angle) + y * np.sin(angle))
        for phase in (0, np.pi / 2):
            kernel = np.cos(wave + phase) * np.exp(-(x**2 + y**2) / (2 * (7 / 3) ** 2))
            kernel -= kernel.mean()
            filters.append((kernel / np.abs(kernel).sum()).astype(np.float32))
    return filters


def itti_koch_opencv(image: Array, filters: list[Array]) -> Array:
    """Saliency of an image `(H, W, 3)` by the model of Itti, Koch and Niebur."""
    intensity = image.mean(2)
    visible = intensity > intensity.max() / 10
    gain = visible / np.where(visible, intensity, 1)
    red, green, blue = cv2.split(image * gain[..., None])
    mean = (red + green) / 2
    red_green = np.maximum(red - (green + blue) / 2, 0) - np.maximum(green - (red + blue) / 2, 0)
    yellow = np.maximum(mean - cv2.absdiff(red, green) / 2 - blue, 0)
    pyramid = [cv2.merge([intensity, red_green, np.maximum(blue - mean, 0) - yellow])]
    for _ in range(8):
        pyramid.append(cv2.pyrDown(pyramid[-1]))
    features: list[list[Array]] = []
    for level in pyramid:
        answers = []
        if len(features) >= 2:
            first = np.ascontiguousarray(level[..., 0])
            answers = [np.abs(cv2.filter2D(first, -1, f, borderType=cv2.BORDER_REPLICATE)) for f in filters]
            answers = [even + odd for even, odd in zip(answers[::2], answers[1::2], strict=True)]
        features.append([*cv2.split(level), *answers])
    totals = [np.zeros(pyramid[4].shape[:2], np.float32) for _ in range(7)]
    for centre in (2, 3, 4):
        size = features[centre][0].shape[::-1]
        for index in range(7):
            here, around = features[centre][index], [features[centre + delta][index] for delta in (3, 4)]
            both = total(promote(cv2.absdiff(here, cv2.resize(surround, size))) for surround in around)
            for _ in range(4 - centre):
                both = cv2.pyrDown(both)
            totals[index] += both
    maps = [totals[0], totals[1] + totals[2], total(promote(each) for each in totals[3:])]
    saliency = total(promote(each) for each in maps) / 3
    return stretch(cv2.resize(saliency, image.shape[1::-1]))


def measure(
    ours: Callable[[], object], theirs: Callable[[], object], repetitions: int
) -> tuple[list[float], list[float]]:
    """Milliseconds of both programs, run in turn."""
    times: tuple[list[float], list[float]] = ([], [])
    for repetition in range(repetitions + 2):
        for run, record in zip((ours, theirs), times, strict=True):
            start = time.perf_counter()
            run()
            if repetition >= 2:
                record.append(1e3 * (time.perf_counter() - start))
    return times


def spread(times: list[float]) -> str:
    """Median and quartiles, as text."""
    low, middle, high = statistics.quantiles(times, n=4)
    return f"{middle:.1f} ({low:.1f}-{high:.1f})"


@torch.inference_mode()
def main() -> None:
    """Measure, and print the table."""
    parser = argparse.ArgumentParser(description="milliseconds of the saliency models for one photograph")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], help="width and height of the photograph")
    parser.add_argument("--threads", type=int, default=2, help="threads of torch and of OpenCV")
    parser.add_argument("--repetitions", type=int, default=40, help="number of repetitions")
    arguments = parser.parse_args()
    torch.set_num_threads(arguments.threads)
    cv2.setNumThreads(arguments.threads)
    image = photograph(*arguments.size)
    pixels = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy())
    filters = gabor_filters()
    clutter, single, itti = VOCUS2(), VOCUS2(3.0, 13.0), IttiKoch()
    pairs: dict[str, tuple[Callable[[], Tensor], Callable[[], Array]]] = {
        "VOCUS2 2/6": (lambda: clutter(image), lambda: vocus2_opencv(pixels, 2, 6)),
        "VOCUS2 3/13": (lambda: single(image), lambda: vocus2_opencv(pixels, 3, 13)),
        "Itti-Koch": (lambda: itti(image), lambda: itti_koch_opencv(pixels, filters)),
    }
    print(
        f"{arguments.size[0]}x{arguments.size[1]}, {arguments.threads} threads, {arguments.repetitions} repetitions; ms"
    )
    print("| model | semfov | OpenCV | ratio | largest difference |\n|---|---|---|---|---|")
    for name, (ours, theirs) in pairs.items():
        difference = float(np.abs(ours()[0].numpy() - theirs()).max())
        here, there = measure(ours, theirs, arguments.repetitions)
        ratios = [a / b for a, b in zip(here, there, strict=True)]
        low, middle, high = statistics.quantiles(ratios, n=4)
        ratio = f"{middle:.2f} ({low:.2f}-{high:.2f})"
        print(f"| {name} | {spread(here)} | {spread(there)} | {ratio} | {difference:.1e} |")


if __name__ == "__main__":
    main()
