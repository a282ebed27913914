"""Hot paths beside a program that takes a core: `python -m benchmarks.busy`.

PyTorch divides work among as many threads as there are cores. If another program uses one of them, the others wait at
every operation. Here each path runs with all threads and with one, in turn, first on the machine as it is and then
while a loop takes one core. Times are of the clock; run it on a machine that is otherwise quiet.
"""

import multiprocessing
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from itertools import cycle

import torch
from torch import Tensor

from benchmarks.beliefs import make_belief, make_look, make_model, unvisited
from benchmarks.machine import GAZE, SIGMA, photograph
from benchmarks.tables import begin, command, number, page, spread, table, write
from benchmarks.timing import Run, Spread, interleaved
from semfov import EmbeddedScenes, Grid, ZoomAgent, acquisition, foveate
from semfov.belief import fuse
from semfov.data.images import to_bytes
from semfov.data.mosaics import Mosaics
from semfov.detection.scores import Candidates
from semfov.paths import ZoomPath
from semfov.settings import SearchSettings

TEXT = "Written by `python -m benchmarks.busy`: milliseconds by the clock, medians (quartiles)."


def paths() -> dict[str, Run]:
    """Return the hot paths by name."""
    image, gaze = photograph(), torch.tensor(GAZE)
    grid = Grid(10, 10, (640, 480))
    belief, (likelihood, footprint) = make_belief(100, batch=1), make_look(100, batch=1)
    visited = unvisited(belief)
    value = acquisition.KLDivergence(make_model(), grid)
    return {
        "fixation, pyramid included": lambda: foveate(image, gaze, sigma=SIGMA),
        "Kaplan's rule, one look": lambda: fuse(belief.beta, likelihood, footprint),
        "decision by KL divergence": lambda: value(belief, visited),
        "search of 3840 × 2880 px, 16 passes without the detector": large_search(),
    }


def large_search() -> Run:
    """Return a search of a mosaic by windows, whose detector returns what it has returned before."""
    agent = ZoomAgent.recommended("yolov3-tiny")
    scenes = EmbeddedScenes(agent.classes[1:], count=16)
    picture = to_bytes(Mosaics(scenes, 6, 6, tile=(640, 480), count=1)[0].image)
    detector, candidates = agent.eye.detector, list[Candidates]()
    propose = detector.propose_likely

    def remembered(canvases: Tensor, least: float) -> Candidates:
        candidates.append(propose(canvases, least))
        return candidates[-1]

    def search() -> ZoomPath:
        return agent.search(picture, "person", SearchSettings(passes=16, confirm=1.0, stop_below=0.0, closer=0))

    vars(detector)["propose_likely"] = remembered
    search()
    again = cycle(candidates)
    vars(detector)["propose_likely"] = lambda canvases, least: next(again)
    return search


def with_threads(threads: int, run: Run) -> Run:
    """Return the program with so many threads."""

    def limited() -> object:
        torch.set_num_threads(threads)
        return run()

    return limited


def spin() -> None:
    """Take a core."""
    while True:
        pass


@contextmanager
def beside(busy: bool) -> Iterator[None]:
    """Have a program beside this one that takes a core."""
    if not busy:
        yield
        return
    program = multiprocessing.get_context("spawn").Process(target=spin, daemon=True)
    program.start()
    try:
        yield
    finally:
        program.kill()
        program.join()


def times(seconds: float) -> dict[str, dict[str, Spread]]:
    """Milliseconds of every path, by machine (quiet or busy) and number of threads."""
    cores = torch.get_num_threads()
    runs = {
        (name, label): with_threads(threads, run)
        for name, run in paths().items()
        for label, threads in (("one thread", 1), ("all threads", cores))
    }
    named = {f"{name}|{label}": run for (name, label), run in runs.items()}
    spreads: dict[str, dict[str, Spread]] = {}
    for machine, busy in (("quiet", False), ("busy", True)):
        with beside(busy):
            for key, values in interleaved(named, seconds, times=10).items():
                name, label = key.split("|")
                spreads.setdefault(name, {})[f"{machine}, {label}"] = Spread.of(values)
    torch.set_num_threads(cores)
    return spreads


@torch.inference_mode()
def main() -> None:
    """Measure, and write the table."""
    options = command("benchmarks.busy", __doc__, seconds=10.0, threads=torch.get_num_threads()).parse_args()
    _, about = begin(options)
    spreads = times(options.seconds)
    columns = list(next(iter(spreads.values())))
    rows = [
        [name, *map(spread, own.values()), number(own["busy, all threads"].middle / own["quiet, one thread"].middle)]
        for name, own in spreads.items()
    ]
    text = table(["milliseconds", *columns, "busy, all threads / quiet, one thread"], rows)
    figures = {name: {column: asdict(value) for column, value in own.items()} for name, own in spreads.items()}
    text = page("Beside a program that takes a core", TEXT, about, text)
    write(options.out, "busy", text, {"machine": about, **figures})


if __name__ == "__main__":
    main()
