"""Time of the pyramid, the sensor and the blur of saliency by matrices and by Kornia, with and without gradients.

`semfov.sensor.pyramid` uses Kornia's functions on devices on which this benchmark does not show its own matrices to be
faster. Here both are run, whatever the device. Ratios divide Kornia's time by the matrices' time in the same
repetition, as median and quartiles: above 1, the matrices are faster. With one thread, times are CPU times.

python -m benchmarks.pyramid
"""

import argparse
from collections.abc import Callable, Collection
from unittest import mock

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from benchmarks.machine import use_threads
from benchmarks.tables import comparison_rows, table
from benchmarks.timing import Clock, Comparison, clock_for, measure
from semfov.baselines.saliency.blur import _gaussian_kernel, gaussian_blur
from semfov.sensor import foveate, laplacian_pyramid, pyramid

LEVELS = 4
# Blur of VOCUS2 from its centre to its surround.
SIGMA = (6.0**2 - 2.0**2) ** 0.5
# All sizes can be halved `LEVELS` times without remainder, as Kornia needs.
SHAPES = ((1, 3, 480, 640), (4, 3, 416, 416), (16, 3, 64, 64))


def split(image: Tensor) -> Tensor:
    """Return a number that depends on every level of the pyramid."""
    bands = laplacian_pyramid(image, LEVELS)
    return torch.stack([level.square().sum() for level in (*bands.details, bands.base)]).sum()


def view(image: Tensor) -> Tensor:
    """Return a number that depends on the sensor's view, including its pyramid."""
    gaze = torch.tensor([image.shape[-1] / 3, image.shape[-2] / 2], device=image.device)
    return foveate(image, gaze, sigma=image.shape[-1] / 6, levels=LEVELS).square().sum()


def blur(image: Tensor) -> Tensor:
    """Return a number that depends on the blur of VOCUS2's surround."""
    if image.device.type in pyramid._AHEAD:
        blurred = gaussian_blur(image, SIGMA)
    else:
        taps = len(_gaussian_kernel(SIGMA))
        blurred = gaussian_blur2d(image, (taps, taps), (SIGMA, SIGMA), "replicate")
    return blurred.square().sum()


WORKS: dict[str, Callable[[Tensor], Tensor]] = {"pyramid": split, "sensor": view, "blur": blur}


def run(work: Callable[[Tensor], Tensor], image: Tensor, ahead: Collection[str], gradients: bool) -> Tensor:
    """Return the value or gradient of `work`; by matrices if the device is in `ahead`, else by Kornia."""
    with mock.patch.object(pyramid, "_AHEAD", ahead), torch.inference_mode(not gradients):
        if gradients:
            fresh = image.detach().requires_grad_()
            result = torch.autograd.grad(work(fresh), fresh)[0]
        else:
            result = work(image)
    if image.device.type != "cpu":
        torch.accelerator.synchronize()
    return result


def compare(name: str, shape: tuple[int, ...], device: str, gradients: bool) -> Comparison:
    """Comparison of matrices with Kornia."""
    work, image = WORKS[name], torch.rand(shape, generator=torch.Generator().manual_seed(0)).to(device)

    def ours() -> Tensor:
        return run(work, image, (device,), gradients)

    def kornia() -> Tensor:
        return run(work, image, (), gradients)

    how = "forwards and backwards" if gradients else "inference"
    return Comparison(
        f"{name}, {' x '.join(map(str, shape))}, {how}",
        ours,
        {"Kornia": kornia},
        agree=lambda: torch.testing.assert_close(ours(), kornia(), rtol=1e-4, atol=1e-5),
    )


def rows(device: str, seconds: float, clock: Clock) -> list[list[str]]:
    """Table rows, one for each work, shape and kind of run."""
    comparisons = (
        compare(name, shape, device, gradients) for name in WORKS for shape in SHAPES for gradients in (True, False)
    )
    return [[name, *row] for each in comparisons for name, _, *row in comparison_rows(measure(each, seconds, clock))]


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu", help="type of the device, `cpu` or `cuda`")
    parser.add_argument("--threads", type=int, default=1, help="number of threads")
    parser.add_argument("--seconds", type=float, default=3.0, help="shortest duration for each row")
    options = parser.parse_args()
    use_threads(options.threads)
    on_cpu = options.device == "cpu"
    clock, times = clock_for(options.threads if on_cpu else 0)
    print(f"{options.device}, {options.threads} thread{'s' * (options.threads > 1)}, times {times}\n")
    head = ["work", "matrices, ms", "Kornia, ms", "Kornia / matrices"]
    print(table(head, rows(options.device, options.seconds, clock)))


if __name__ == "__main__":
    main()
