"""Time of one decision where to look next, compared with published times: `python -m benchmarks.decisions`."""

from collections.abc import Callable
from dataclasses import asdict, replace

import torch
from torch import Tensor

from benchmarks.beliefs import CLASSES, DETECTIONS, LEVELS, exploration, make_model, unvisited
from benchmarks.machine import GAZE, photograph
from benchmarks.tables import begin, command, comparison_rows, number, page, spread, table, write
from benchmarks.timing import Clock, Measured, Run, Spread, interleaved, measure
from semfov import (
    Detections,
    DirichletBelief,
    FovealObservationModel,
    Grid,
    acquisition,
    observers,
    policies,
    saliency,
)
from semfov.gaze import select_fixation
from semfov.sensor import Foveation

TARGET, LOOKS, TIMES = 5, 3, 10
KL = "KL divergence, raw"

TEXT = f"""\
Written by `python -m benchmarks.decisions`. Medians (quartiles) of one run. A decision from a belief is run {TIMES}
times in a row, and the mean is one value.

A decision is made for one episode, with {CLASSES + 1} classes on 10 x 10 cells and {LEVELS} levels of distance, from a
given belief. It evaluates every cell, draws the random numbers that break ties, and takes the best cell not visited
yet. Looking, detecting and updating the belief are not part of it. A decision by saliency foveates a photograph of
640 x 480 from its given pyramid, computes the saliency of the view, and averages it over the cells. Raw: map by
Kaplan's rule; calibrated: map by the modified rule. Published times are from another machine: only the peers below were
timed beside semfov."""
BRUTE_FORCE = """\
The published sum over the map, computed for every fixation by the formula. The loop evaluates one of the hundred
fixations, and its time is scaled up. It does not choose the next cell. Ratios are taken within one repetition."""

# Computational cost in ms from the tables of search and of exploration in Luzio, Bernardino and Moreno (2024), measured
# on another machine. Their "Kaplan" is raw here, their "modified Kaplan" calibrated. Their saliency model is VOCUS2.
PUBLISHED: dict[str, dict[str, float | None]] = {
    "search": {
        "random": 0.015,
        "VOCUS2": 762.3,
        "Itti-Koch": None,
        "non-predictive, raw": 0.144,
        "non-predictive, calibrated": 0.133,
        "predictive, raw": 77.81,
        "predictive, calibrated": 83.76,
    },
    "exploration": {
        "random": 0.017,
        "VOCUS2": 462.0,
        "Itti-Koch": None,
        KL: 9851.0,
        "KL divergence, calibrated": 9907.0,
        "negative entropy, raw": 9770.0,
        "negative entropy, calibrated": 9833.0,
        "two peaks, raw": 8971.0,
        "two peaks, calibrated": 8981.0,
    },
}


def make_seen(seed: int) -> Detections:
    """Random detections of one look, with boxes of up to a tenth of the photograph."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor(photograph().shape[:1:-1])
    corner, extent = torch.rand(2, 1, DETECTIONS, 2, generator=generator) * size
    boxes = torch.cat([corner, corner + 0.3 * extent], -1)
    scores = (3 * torch.randn(1, DETECTIONS, CLASSES + 1, generator=generator)).softmax(-1)
    return Detections(boxes, scores, torch.ones(1, DETECTIONS, dtype=torch.bool))


def believe(observer: observers.Semantic, grid: Grid) -> DirichletBelief:
    """Return the belief after `LOOKS` looks."""
    belief = observer.start(1, grid, torch.zeros(()))
    for seed in range(LOOKS):
        belief = observer(belief, make_seen(seed), grid.centres[seed : seed + 1], grid)
    return belief


def decide(value: acquisition.AcquisitionFunction, belief: DirichletBelief) -> Run:
    """Make a program that makes one decision."""
    visited, generator = unvisited(belief), torch.Generator().manual_seed(0)
    visited[:, :LOOKS] = True

    def run() -> Tensor:
        noise = torch.rand(visited.shape, generator=generator)
        return select_fixation(value(belief, visited), visited, noise)

    return run


def on_the_map(model: FovealObservationModel, maps: dict[str, DirichletBelief], grid: Grid) -> dict[str, Run]:
    """Programs of decisions from a belief."""
    kinds = {
        "non-predictive": policies.Policy("non-predictive"),
        "predictive": policies.Policy("predictive", model),
        "KL divergence": policies.Policy("kl", model),
        "negative entropy": policies.Policy("negative-entropy", model),
        "two peaks": policies.Policy("two-peaks", model),
    }
    runs = {"random": decide(policies.Policy("random")(None, grid), maps["raw"])}
    for name, policy in kinds.items():
        runs |= {f"{name}, {scores}": decide(policy(TARGET, grid), belief) for scores, belief in maps.items()}
    return runs


def updates(model: FovealObservationModel, belief: DirichletBelief, grid: Grid) -> dict[str, Run]:
    """Programs of the steps that update a belief with one look of 30 detections."""
    observer, detections, fixation = observers.Semantic(CLASSES + 1), make_seen(LOOKS), torch.tensor([GAZE])
    look, distance = observer.weigh(detections, fixation, grid), grid.box_distance(detections.boxes, fixation)
    return {
        f"cells and distances of {DETECTIONS} detections": lambda: observer.weigh(detections, fixation, grid),
        f"calibration of {DETECTIONS} detections": lambda: model.calibrate(detections.scores, distance),
        f"Kaplan's rule for {DETECTIONS} detections": lambda: observer.update(belief, look),
    }


def on_the_view(grid: Grid) -> tuple[dict[str, Run], dict[str, Run]]:
    """Programs of decisions by the saliency of a foveated view, and of the preparations for them."""
    image, gaze, sensor = photograph(), torch.tensor(GAZE), Foveation(100.0, growth=1.0)
    bands, visited = sensor.pyramid(image), torch.zeros(1, len(grid), dtype=torch.bool)
    generator = torch.Generator().manual_seed(0)

    def decide_by(model: Callable[[Tensor], Tensor]) -> Run:
        def run() -> Tensor:
            values = saliency.cell_saliency(model(sensor(bands, gaze)), grid.columns, grid.rows)
            return select_fixation(values, visited, torch.rand(visited.shape, generator=generator))

        return run

    preparations = {
        "pyramid of the photograph, once for all decisions": lambda: sensor.pyramid(image),
        "foveated view, in every decision by saliency": lambda: sensor(bands, gaze),
    }
    return {"VOCUS2": decide_by(saliency.VOCUS2()), "Itti-Koch": decide_by(saliency.IttiKoch())}, preparations


def main() -> None:
    """Measure all rows and write the tables."""
    options = command("benchmarks.decisions", __doc__, seconds=30.0, threads=2).parse_args()
    clock, about = begin(options)
    # Made outside inference mode, like a loaded model, because only then it caches its tables.
    model = make_model()
    with torch.inference_mode():
        spreads, others, peers = measure_all(model, options.seconds / 3, clock)
    figures = {
        "machine": about,
        "milliseconds": {name: asdict(values) for name, values in spreads.items()},
        "published_milliseconds": PUBLISHED,
        "peers": asdict(peers),
    }
    write(options.out, "decisions", page("Decisions", TEXT, about, *sections(spreads, others, peers)), figures)


def measure_all(
    model: FovealObservationModel, seconds: float, clock: Clock
) -> tuple[dict[str, Spread], list[str], Measured]:
    """Milliseconds of all rows, the names of the rows that are not decisions, and the comparison with brute force."""
    grid = Grid(10, 10, (640, 480))
    maps = {
        "raw": believe(observers.Semantic(CLASSES + 1), grid),
        "calibrated": believe(observers.Semantic(CLASSES + 1, model), grid),
    }
    decisions, changes = on_the_map(model, maps, grid), updates(model, maps["raw"], grid)
    views, preparations = on_the_view(grid)
    durations = interleaved(decisions | changes, seconds, clock, times=TIMES)
    durations |= interleaved(views | preparations, seconds, clock)
    brute = replace(exploration("KL divergence", maps["raw"]), name=KL, ours=decisions[KL])
    spreads = {name: Spread.of(values) for name, values in durations.items()}
    return spreads, [*changes, *preparations], measure(brute, seconds, clock, TIMES)


def sections(spreads: dict[str, Spread], others: list[str], peers: Measured) -> list[str]:
    """Write the tables with their headings, as Markdown."""
    parts = []
    for experiment, published in PUBLISHED.items():
        rows = [[name, spread(spreads[name]), number(cost) if cost else ""] for name, cost in published.items()]
        parts += [f"## One decision of {experiment}", table(["decision", "semfov, ms", "published, ms"], rows)]
    return [
        *parts,
        "## Work that decisions need but do not include",
        table(["work", "semfov, ms"], [[name, spread(spreads[name])] for name in others]),
        "The foveated view is an exception: it is included in decisions by saliency.",
        "## Brute force",
        BRUTE_FORCE,
        table(["decision", "peer", "semfov, ms", "peer, ms", "peer / semfov"], comparison_rows(peers)),
    ]


if __name__ == "__main__":
    main()
