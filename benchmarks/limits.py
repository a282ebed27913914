"""How many bytes a hot path must move through memory, and how close it comes to the memory bandwidth."""

from dataclasses import dataclass

import torch

from benchmarks.beliefs import DETECTIONS, make_belief, make_look, make_model, unvisited
from benchmarks.fits import draw
from benchmarks.images import GAZE, SIGMA, photograph
from benchmarks.rollouts import SHIFTS, searches
from benchmarks.timing import Clock, Run, Spread, interleaved
from semfov import Grid, acquisition, foveate
from semfov.belief import fuse
from semfov.gaze.saliency import VOCUS2
from semfov.observation.dirichlet import mle
from semfov.sensor import laplacian_pyramid


@dataclass(frozen=True)
class Path:
    """A hot path.

    Attributes:
        run: the program.
        bytes: number of bytes of its inputs and results, each read or written once.
        what: description of these bytes.
        stops: what keeps the path from moving them at the memory bandwidth.
    """

    run: Run
    bytes: int
    what: str
    stops: str


def paths() -> dict[str, Path]:
    """The hot paths by name; the larger ones exceed the processor's caches."""
    image, gaze = photograph(), torch.tensor(GAZE)
    bands = laplacian_pyramid(image, 5)
    details = sum(band.numel() for band in (*bands.details, bands.base))
    batch = 256
    belief, (likelihood, footprint) = make_belief(100, batch=batch), make_look(100, batch=batch)
    beta, visited = belief.beta, unvisited(belief)
    model, grid = make_model(), Grid(10, 10, (640, 480))
    value = acquisition.KLDivergence(model, grid)
    vocus = VOCUS2()
    logs = draw(100, seed=0).log().mean(1)
    episodes = 40
    detections, run = searches(episodes)
    scene = sum(t.numel() * t.element_size() for t in (detections.boxes, detections.scores, detections.mask))
    # Every look reads and writes an episode's map, and reads the detections from one of the scene's cells.
    looks = episodes * (SHIFTS + 1)
    moved = looks * (4 * 2 * beta[0].numel() + scene // len(detections.boxes))
    blurs = "the bands of the pyramid are written and read again, each time in newly allocated memory"
    newton = (
        "limited by computation: Newton's steps, each with digamma and trigamma of every parameter in double precision"
    )
    small = "each look takes dozens of operations on small tensors, whose calls cost more than the memory traffic"
    return {
        "foveation, pyramid included": Path(
            lambda: foveate(image, gaze, sigma=SIGMA), 4 * 2 * image.numel(), "image in, view out", blurs
        ),
        "foveation, pyramid reused": Path(
            lambda: foveate(bands, gaze, sigma=SIGMA), 4 * (details + image.numel()), "bands in, view out", blurs
        ),
        f"fusion, {DETECTIONS} detections, {batch} maps": Path(
            lambda: fuse(beta, likelihood, footprint),
            4 * (2 * beta.numel() + likelihood.numel()) + footprint.numel(),
            "maps in and out, likelihoods, footprints",
            "detections are fused one after another, and each of them reads and writes the maps once",
        ),
        f"exploration, KL divergence, {batch} maps": Path(
            lambda: value(belief, visited),
            4 * (beta.numel() + visited.numel() + model.alpha.numel()),
            "maps and expected scores in, values out",
            "limited by computation: every cell is updated for each level, and its divergence from the prior takes "
            f"ln Γ and ψ of {model.alpha.shape[1] * beta.numel() / 1e6:.1f} million numbers",
        ),
        "saliency, VOCUS2": Path(
            lambda: vocus(image),
            4 * (image.numel() + image.numel() // 3),
            "image in, map out",
            "limited by computation: about 20 Gaussian blurs of up to 65 taps, as matrix products that reach most of "
            "the processor's peak rate",
        ),
        f"{len(logs)} Dirichlets of {logs.shape[-1]} dimensions": Path(
            lambda: mle(logs), 2 * logs.numel() * logs.element_size(), "mean logarithms in, parameters out", newton
        ),
        f"{episodes} searches of {SHIFTS} shifts": Path(
            lambda: run(episodes, episodes), moved, "every look: map in and out, detections in", small
        ),
    }


def limits(bandwidth: float, seconds: float, clock: Clock) -> dict[str, tuple[Path, Spread, float]]:
    """For each path, its milliseconds, and the share of the copy bandwidth that it reaches."""
    reached = {}
    for name, path in paths().items():
        spread = Spread.of(interleaved({name: path.run}, seconds, clock)[name])
        reached[name] = path, spread, path.bytes / (spread.middle / 1e3) / bandwidth
    return reached
