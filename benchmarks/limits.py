"""What a path must move through memory, and how near to that it comes."""

from dataclasses import dataclass

import torch

from benchmarks.beliefs import DETECTIONS, make_belief, make_look, make_model
from benchmarks.images import GAZE, SIGMA, photograph
from benchmarks.timing import Clock, Run, Spread, interleaved
from semfov import Grid, acquisition, foveate
from semfov.belief import fuse
from semfov.gaze.saliency import VOCUS2
from semfov.sensor import laplacian_pyramid


@dataclass(frozen=True)
class Path:
    """A hot path.

    Attributes:
        run: the program.
        bytes: of its inputs and results, each read or written once.
        what: they are.
    """

    run: Run
    bytes: int
    what: str


def paths() -> dict[str, Path]:
    """Hot paths, the larger ones beyond the caches."""
    image, gaze = photograph(), torch.tensor(GAZE)
    bands = laplacian_pyramid(image, 5)
    details = sum(band.numel() for band in (*bands.details, bands.base))
    batch = 256
    beta, (likelihood, footprint) = make_belief(100, batch=batch), make_look(100, batch=batch)
    model, grid = make_model(), Grid(10, 10, (640, 480))
    value, belief = acquisition.KLDivergence(model, grid), make_belief(100, batch=batch)
    vocus = VOCUS2()
    return {
        "foveation, pyramid included": Path(
            lambda: foveate(image, gaze, sigma=SIGMA), 4 * 2 * image.numel(), "image in, view out"
        ),
        "foveation, pyramid reused": Path(
            lambda: foveate(bands, gaze, sigma=SIGMA), 4 * (details + image.numel()), "bands in, view out"
        ),
        f"fusion, {DETECTIONS} detections, {batch} maps": Path(
            lambda: fuse(beta, likelihood, footprint),
            4 * (2 * beta.numel() + likelihood.numel()) + footprint.numel(),
            "maps in and out, likelihoods, footprints",
        ),
        f"exploration, KL divergence, {batch} maps": Path(
            lambda: value(belief),
            4 * (belief.numel() + belief.shape[0] * belief.shape[1] + model.alpha.numel()),
            "maps and expected scores in, values out",
        ),
        "saliency, VOCUS2": Path(lambda: vocus(image), 4 * (image.numel() + image.numel() // 3), "image in, map out"),
    }


def limits(bandwidth: float, seconds: float, clock: Clock) -> dict[str, tuple[Path, Spread, float]]:
    """For each path its milliseconds, and the share of the copy bandwidth at which it moves its bytes."""
    found = {}
    for name, path in paths().items():
        spread = Spread.of(interleaved({name: path.run}, seconds, clock)[name])
        found[name] = path, spread, path.bytes / (spread.middle / 1e3) / bandwidth
    return found
