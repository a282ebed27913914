"""Comparison of both saliency models with the same models in OpenCV, and of where people look with the detector alone.

The OpenCV programs do the same work in the same order; they, too, average maps before enlarging them.
"""

from collections.abc import Callable, Iterable
from functools import reduce
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.machine import photograph
from benchmarks.timing import Comparison
from semfov.detection.load import load_detector
from semfov.gaze.saliency import VOCUS2, FixationDensity, IttiKoch

Array = NDArray[Any]


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
    """Return the normalisation operator N(.) of Itti, Koch and Niebur for one map `(h, w)`."""
    image = stretch(image)
    # Among equal neighbours only the first counts as a peak.
    earlier = np.array([[1, 1, 1], [1, 0, 0], [0, 0, 0]], np.uint8)
    above, level = cv2.dilate(image, earlier), cv2.dilate(image, np.ascontiguousarray(earlier[::-1, ::-1]))
    peaks = image[(image > above) & (image >= level) & (image > 0.1)]
    others = (peaks.sum() - 1) / (len(peaks) - 1) if len(peaks) > 1 else 0.0
    return image * np.float32((1 - others) ** 2)


def total(images: Iterable[Array]) -> Array:
    """Compute the sum of images."""
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


def saliency(name: str) -> Comparison:
    """Compare the computation of a saliency map."""
    image = photograph()
    pixels, filters = np.ascontiguousarray(image[0].permute(1, 2, 0).numpy()), gabor_filters()
    programs: dict[str, tuple[Callable[[Tensor], Tensor], Callable[[], Array]]] = {
        "VOCUS2": (VOCUS2(), lambda: vocus2_opencv(pixels, 2, 6)),
        "Itti-Koch": (IttiKoch(), lambda: itti_koch_opencv(pixels, filters)),
    }
    model, peer = programs[name]

    def agree() -> None:
        torch.testing.assert_close(model(image)[0], torch.from_numpy(peer()), rtol=0, atol=1e-5)

    return Comparison(f"saliency, {name}", lambda: model(image), {"OpenCV": peer}, {}, agree)


def where_people_look(name: str = "yolov3-tiny") -> Comparison:
    """Compare detections and density of fixations from one pass over a photograph with detections alone."""
    image, detector = photograph(), load_detector(name)
    density = FixationDensity.for_detector(detector)

    def looked() -> Tensor:
        return density(detector.features(image, [*density.layers]))

    def agree() -> None:
        seen = detector.features(image, [*density.layers]).detections
        torch.testing.assert_close(seen.scores, detector(image).scores)
        torch.testing.assert_close(looked().exp().sum((1, 2)), torch.ones(1))

    return Comparison(f"where people look, {name}", looked, {"the detector alone": lambda: detector(image)}, {}, agree)
