"""A faster image pyramid for Kornia: the same numbers from sums of shifted lines instead of a 5 × 5 convolution.

`kornia.geometry.transform.pyrdown` blurs every pixel with 25 taps and then throws three quarters of them away. The blur
[1 4 6 4 1] / 16 followed by the mean of two neighbours is one filter, [1 5 10 10 5 1] / 32, which is needed at every
second pixel only, first along the columns and then along the rows. `pyrup` blurs separably, too. On a CPU, sums of
shifted views are faster than convolutions of few channels. The functions need nothing but PyTorch, keep Kornia's
borders (`reflect`), and are differentiable.

Run it from a checkout: python -m examples.kornia_pyramid
"""

import argparse
import time
from collections.abc import Callable
from statistics import median

import torch
from kornia.geometry import transform
from torch import Tensor
from torch.nn import functional as F

HALVING = (1 / 32, 5 / 32, 10 / 32)  # the outer, middle and inner pair of six taps
BLUR = (1 / 16, 4 / 16, 6 / 16)  # the outer and inner pair of five taps, and the tap in the middle
SHAPES = ((1, 3, 480, 640), (4, 3, 416, 416), (16, 3, 64, 64))


def pyrdown(image: Tensor) -> Tensor:
    """Blur images and halve their size, as `kornia.geometry.transform.pyrdown`.

    Args:
        image: `(B, C, H, W)`, with even H and W of at least 4 pixels.

    Returns:
        `(B, C, H / 2, W / 2)`.
    """
    padded = F.pad(image, (2, 2, 2, 2), mode="reflect")
    return _halve(_halve(padded.mT).mT)


def pyrup(image: Tensor) -> Tensor:
    """Double the size of images and blur them, as `kornia.geometry.transform.pyrup`.

    Args:
        image: `(B, C, H, W)`, with H and W of at least 2 pixels.

    Returns:
        `(B, C, 2 H, 2 W)`.
    """
    doubled = F.interpolate(image, scale_factor=2.0, mode="bilinear", align_corners=False)
    padded = F.pad(doubled, (2, 2, 2, 2), mode="reflect")
    return _blur(_blur(padded.mT).mT)


def _halve(padded: Tensor) -> Tensor:
    """Filter rows that are padded by two pixels on both sides, and keep every second pixel of each."""
    length = padded.shape[-1] - 4
    taps = [padded[..., first : first + length : 2] for first in range(6)]
    outer, middle, inner = HALVING
    return outer * (taps[0] + taps[5]) + middle * (taps[1] + taps[4]) + inner * (taps[2] + taps[3])


def _blur(padded: Tensor) -> Tensor:
    """Filter rows that are padded by two pixels on both sides."""
    length = padded.shape[-1] - 4
    taps = [padded[..., first : first + length] for first in range(5)]
    outer, inner, centre = BLUR
    return outer * (taps[0] + taps[4]) + inner * (taps[1] + taps[3]) + centre * taps[2]


def milliseconds(function: Callable[[Tensor], Tensor], image: Tensor, repeats: int) -> float:
    """Measure the median time of a call on the processor."""
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function(image)
        times.append(1000 * (time.process_time() - start))
    return median(times)


@torch.inference_mode()
def main() -> None:
    """Compare the time of both pyramids, and check that they are equal."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repeats", type=int, default=15, help="calls of each function (default: 15)")
    repeats = parser.parse_args().repeats
    torch.set_num_threads(1)  # the time of a processor is then the time of a call
    pairs = {"pyrdown": (pyrdown, transform.pyrdown), "pyrup": (pyrup, transform.pyrup)}
    for shape in SHAPES:
        image = torch.rand(shape)
        for name, (ours, kornias) in pairs.items():
            torch.testing.assert_close(ours(image), kornias(image), rtol=0, atol=1e-6)
            fast = milliseconds(ours, image, repeats)
            slow = milliseconds(kornias, image, repeats)
            print(f"{name} of {tuple(shape)}: {fast:.2f} ms, Kornia {slow:.2f} ms ({slow / fast:.1f} times)")


if __name__ == "__main__":
    main()
