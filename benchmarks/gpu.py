"""Work on a GPU beside the same work on the processor of the same machine: `python -m benchmarks.gpu`.

Besides times, the kernels that a call launches are counted, and how often it waits until the GPU is done: a value that
is read waits, and launches nothing in the meantime. Work of few elements takes as long as its launches.
"""

import time
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import torch
from torch import Tensor
from torch.profiler import ProfilerActivity, profile

from benchmarks.beliefs import CLASSES, make_belief, make_look, make_model, unvisited
from benchmarks.fits import draw
from benchmarks.machine import GAZE, SIGMA, photograph
from benchmarks.pyramid import rows as pyramids
from benchmarks.tables import begin, command, comparison_rows, page, table, write
from benchmarks.timing import Comparison, measure
from semfov import ActivePerception, DirichletBelief, EmbeddedScenes, Grid, acquisition, foveate
from semfov.belief import fuse
from semfov.gaze.saliency import VOCUS2, IttiKoch
from semfov.observation.dirichlet import mle

Work = Callable[[torch.device], Callable[[], Any]]
TEXT = """\
Written by `python -m benchmarks.gpu`. Ratios of times are taken within one repetition and given as median (quartiles).
Above 1, the GPU is faster than the processor with all its threads. `Launches` are kernels, copies and fills of one
call. `Waits` are the operations of one call that wait for the GPU, as PyTorch reports them
(`torch.cuda.set_sync_debug_mode`)."""
COMPILATION = """\
## Compiled

`torch.compile`, beside the same functions without it. Above 1, compilation is faster."""
PYRAMIDS = """\
## Pyramids

By matrices, as semfov does on the processor, and by Kornia, as semfov does on a GPU. Above 1, matrices are faster."""


def numbers(*shape: int) -> Tensor:
    """Random numbers from 0 to 1, the same each time."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(0))


def foveation(device: torch.device, count: int = 1) -> Callable[[], Tensor]:
    """Return views of `count` photographs, `(count, 3, 480, 640)`."""
    images, gaze = photograph().repeat(count, 1, 1, 1).to(device), torch.tensor(GAZE, device=device).repeat(count, 1)
    return lambda: foveate(images, gaze, sigma=SIGMA)


def fixations(device: torch.device, count: int = 100) -> Callable[[], Tensor]:
    """Return views of one photograph for `count` fixations."""
    image, gaze = photograph(416, 416).to(device), 416 * numbers(1, count, 2).to(device)
    return lambda: foveate(image, gaze, sigma=SIGMA)


def calibration(device: torch.device, compiled: bool = False) -> Callable[[], Tensor]:
    """Likelihoods of 30 detections."""
    model, (likelihood, _) = make_model().to(device), make_look(100)
    scores, distance = likelihood.to(device), numbers(*likelihood.shape[:2]).to(device)
    run = torch.compile(model.calibrate, fullgraph=True) if compiled else model.calibrate
    return lambda: run(scores, distance)


def fusion(device: torch.device, episodes: int = 1, compiled: bool = False) -> Callable[[], Tensor]:
    """Kaplan's rule for 30 detections in the maps of many episodes."""
    beta = make_belief(100, batch=episodes).beta.to(device)
    likelihood, footprint = (each.to(device) for each in make_look(100, batch=episodes))
    run = torch.compile(fuse, fullgraph=True) if compiled else fuse
    return lambda: run(beta, likelihood, footprint)


def exploration(device: torch.device, side: int = 10, classes: int = CLASSES, batch: int = 1) -> Callable[[], Tensor]:
    """Compute expected KL divergence of every next fixation."""
    belief = DirichletBelief(make_belief(side**2, classes, batch).beta.to(device))
    value = acquisition.KLDivergence(make_model(classes), Grid(side, side, (640, 480))).to(device)
    visited = unvisited(belief)
    return lambda: value(belief, visited)


def dirichlets(device: torch.device) -> Callable[[], Tensor]:
    """Fit of 648 Dirichlets of 81 dimensions from the means of logarithms."""
    logs = draw(100, seed=0).log().mean(1).to(device)
    return lambda: mle(logs)


def saliency(device: torch.device, model: Callable[[], torch.nn.Module], count: int = 1) -> Callable[[], Tensor]:
    """Saliency of `count` photographs."""
    images, run = photograph().repeat(count, 1, 1, 1).to(device), model().to(device)
    return lambda: run(images)


def search(device: torch.device, how: Literal["fovea", "windows"], weights: str | None = None) -> Callable[[], object]:
    """Return a search of a photograph by YOLOv3-tiny, five passes of the detector at most."""
    agent = ActivePerception.recommended("yolov3-tiny", weights=weights).to(device)
    image = EmbeddedScenes(agent.classes[1:], count=1)[0].image
    return lambda: agent.search(image, "cup", how=how, passes=5)


WORKS: dict[str, Work] = {
    "foveation of a photograph": foveation,
    "foveation of 32 photographs": partial(foveation, count=32),
    "foveation for 100 fixations": fixations,
    "calibration of 30 detections": calibration,
    "Kaplan's rule, 30 detections": fusion,
    "Kaplan's rule, 30 detections in 1,000 episodes": partial(fusion, episodes=1000),
    f"KL divergence, 10 x 10 cells, {CLASSES} classes": exploration,
    f"KL divergence, 10 x 10 cells, {CLASSES} classes, 64 episodes": partial(exploration, batch=64),
    "KL divergence, 64 x 64 cells, 365 classes": partial(exploration, side=64, classes=365),
    "KL divergence, 64 x 64 cells, 1,203 classes": partial(exploration, side=64, classes=1203),
    "648 Dirichlets of 81 dimensions": dirichlets,
    "VOCUS2": partial(saliency, model=VOCUS2),
    "VOCUS2 of 32 photographs": partial(saliency, model=VOCUS2, count=32),
    "Itti-Koch": partial(saliency, model=IttiKoch),
}
COMPILED: dict[str, Callable[..., Callable[[], Tensor]]] = {
    "calibration of 30 detections": calibration,
    "Kaplan's rule, 30 detections": fusion,
}


def finished(run: Callable[[], object]) -> Callable[[], object]:
    """Return a run that ends when the GPU is done."""

    def timed() -> object:
        result = run()
        torch.accelerator.synchronize()
        return result

    return timed


def counted(run: Callable[[], object]) -> tuple[int, int]:
    """Return launches and waits of one call."""
    with profile(activities=[ProfilerActivity.CPU, ProfilerActivity.CUDA]) as profiled:
        run()
        torch.cuda.synchronize()
    # Kernels, copies and fills alone run on the GPU.
    launches = sum(each.device_type.name == "CUDA" for each in profiled.events())
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return launches, sum("synchroniz" in str(each.message) for each in caught)


def rows(name: str, make: Work, device: torch.device, seconds: float, equal: bool = True) -> list[list[str]]:
    """Table rows of one work: the processor's time, the GPU's, their ratio, launches and waits."""
    with torch.inference_mode(False):  # as models are loaded
        ours, there = make(torch.device("cpu")), make(device)

    def agree() -> None:
        if equal:
            torch.testing.assert_close(there().cpu(), ours(), rtol=1e-3, atol=1e-4)

    print(f"{name} …", flush=True)
    measured = measure(Comparison(name, finished(there), {"processor": ours}, agree=agree), seconds, time.perf_counter)
    launches, waits = counted(there)
    return [[name, *row, str(launches), str(waits)] for _, _, *row in comparison_rows(measured)]


def compiled(name: str, make: Callable[..., Callable[[], Tensor]], device: torch.device, seconds: float) -> list[str]:
    """Write the table row of a compiled function."""
    with torch.inference_mode(False):
        ours, eager = make(device, compiled=True), make(device)
    comparison = Comparison(
        name, finished(ours), {"eager": finished(eager)}, agree=lambda: torch.testing.assert_close(ours(), eager())
    )
    ((_, _, *row),) = comparison_rows(measure(comparison, seconds, time.perf_counter, times=10))
    return [name, *row]


def main() -> None:
    """Measure, and write the page."""
    parser = command("benchmarks.gpu", __doc__, seconds=2.0, threads=torch.get_num_threads())
    parser.add_argument("--weights", help="weights of YOLOv3-tiny")
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("no GPU that torch can use")
    device = torch.device("cuda")
    _, about = begin(options)
    about |= {"GPU": torch.cuda.get_device_name(), "times": "of the clock"}
    searches: dict[str, Work] = {
        f"search of a photograph by {how}, YOLOv3-tiny": partial(search, how=how, weights=options.weights)
        for how in ("fovea", "windows")
    }
    with torch.inference_mode():
        works = [row for name, make in WORKS.items() for row in rows(name, make, device, options.seconds)]
        works += [row for name, make in searches.items() for row in rows(name, make, device, options.seconds, False)]
        compilations = [compiled(name, make, device, options.seconds) for name, make in COMPILED.items()]
    kornia = pyramids("cuda", options.seconds / 2, time.perf_counter)
    head = ["work", "GPU, ms", "processor, ms", "processor / GPU", "launches", "waits"]
    with_compiler = ["work", "compiled, ms", "eager, ms", "eager / compiled"]
    with_kornia = ["work", "matrices, ms", "Kornia, ms", "Kornia / matrices"]
    text = page(
        "Work on a GPU",
        TEXT,
        about,
        table(head, works),
        COMPILATION,
        table(with_compiler, compilations),
        PYRAMIDS,
        table(with_kornia, kornia),
    )
    write(options.out, "gpu", text, {"machine": about, "works": works})


if __name__ == "__main__":
    main()
