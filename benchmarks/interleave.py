"""What a fixation costs in addition to its detection, and whether sensor and detector slow each other down.

Two thread pools alternate: torch's in the sensor and onnxruntime's in the detector. First, sensor and detector are
timed each alone and then alternately; alternating should cost no more than the sum of both alone. It costs more if the
threads of onnxruntime spin while they wait, so semfov turns spinning off; the table shows both settings. Second, whole
fixations are timed part by part: sensor, detector, belief and policy.

Repetitions are interleaved, each in another order. Times are medians over repetitions; ratios and shares are given with
quartiles. The observation model changes no score, but costs as much as a fitted one.

python -m benchmarks.interleave
python -m benchmarks.interleave --model yolox_nano.onnx

On a machine with other work, `--processor-time` measures the CPU time of the calling thread instead of elapsed time,
with one thread.
"""

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import semfov
from benchmarks.machine import photograph
from benchmarks.tables import number, spread, table
from benchmarks.timing import Clock, Comparison, Spread, interleaved
from semfov.detection import Detections
from semfov.detection.export import export_onnx
from semfov.detection.load import load_yolo
from semfov.detection.onnx import OnnxDetector, load_onnx
from semfov.detection.onnx_session import OnnxSession
from semfov.eye import Eye, View
from semfov.gaze.choice import select_fixation
from semfov.strategy import Strategy

COLUMNS, ROWS, TARGET = 10, 10, 1
EDGES = [50 * level / 640 for level in range(1, 8)]
STAGES = ("sensor", "detector", "belief", "policy")


def load(path: Path, threads: int, spinning: bool) -> OnnxDetector:
    """Load a detector with `threads` threads, which spin while they wait if `spinning`."""
    detector = load_onnx(path, threads=threads)
    # In this process, whose time is measured: a model of open size would run in another one.
    detector.session = OnnxSession(path, threads=threads, spinning=spinning, open_ended=False)
    return detector


def random_cells(count: int, size: tuple[int, int]) -> tuple[Tensor, ...]:
    """Centres of random cells of an image, each `(1, 2)`."""
    grid = semfov.Grid(COLUMNS, ROWS, size)
    order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))
    return grid.centres[order[:count]].split(1)


def taking_turns(eye: Eye, view: View, gazes: Sequence[Tensor]) -> dict[str, Callable[[], list[Any]]]:
    """Programs that fixate all of `gazes`: the sensor alone, the detector alone, and both in turn."""
    canvases = [eye.foveated(view, gaze) for gaze in gazes]
    return {
        "sensor": lambda: [eye.foveated(view, gaze) for gaze in gazes],
        "detector": lambda: [eye.detector.detect(canvas, view.placement) for canvas in canvases],
        "in turn": lambda: [eye.look(view, gaze) for gaze in gazes],
    }


def in_turn(fixations: int = 10) -> Comparison:
    """Fixations in which sensor and detector alternate, compared with all sensor work first and then all detection."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "yolov3-tiny.onnx"
        with torch.inference_mode(False), torch.no_grad():
            export_onnx(load_yolo("yolov3-tiny"), path)
        eye = Eye(semfov.Foveation(100.0), load(path, torch.get_num_threads(), spinning=False))
    programs = taking_turns(eye, eye.open(photograph()), random_cells(fixations, (640, 480)))

    def apart() -> list[Detections]:
        programs["sensor"]()
        return programs["detector"]()

    def agree() -> None:
        for one, other in zip(programs["in turn"](), apart(), strict=True):
            torch.testing.assert_close(one.boxes, other.boxes)
            torch.testing.assert_close(one.scores, other.scores)

    name = f"{fixations} fixations, sensor and detector in turn"
    return Comparison(name, programs["in turn"], {"each alone": apart}, {}, agree)


def strategies(classes: Sequence[str]) -> dict[str, Strategy]:
    """Strategies of different cost, from the cheapest search to exploration."""
    model = semfov.FovealObservationModel.identity(classes, EDGES).eval()
    raw, calibrated = (semfov.observers.Semantic(1 + len(classes), observation) for observation in (None, model))
    return {
        "search, non-predictive, raw": Strategy(raw, semfov.policies.Policy("non-predictive")),
        "search, predictive, calibrated": Strategy(calibrated, semfov.policies.Policy("predictive", model)),
        "exploration, KL divergence, calibrated": Strategy(calibrated, semfov.policies.Policy("kl", model)),
    }


def scanpath(
    eye: Eye,
    view: View,
    grid: semfov.Grid,
    strategy: Strategy,
    fixations: int,
    seed: int,
    clock: Clock,
) -> list[float]:
    """Milliseconds per fixation of each of `STAGES`, over one scanpath."""
    generator = torch.Generator().manual_seed(seed)
    acquisition = strategy.policy(TARGET, grid)
    visited = torch.zeros(1, len(grid), dtype=torch.bool)
    belief = strategy.observer.start(1, grid, torch.zeros(()))
    cell = torch.randint(len(grid), (1,), generator=generator)
    totals = torch.zeros(len(STAGES), dtype=torch.float64)
    for _ in range(fixations):
        fixation = grid.centres[cell]
        stamps = [clock()]
        canvas = eye.foveated(view, fixation)
        stamps.append(clock())
        detections = eye.detector.detect(canvas, view.placement)
        stamps.append(clock())
        belief = strategy.observer(belief, detections, fixation, grid)
        stamps.append(clock())
        visited = visited.scatter(-1, cell[:, None], True)
        noise = torch.rand(1, len(grid), generator=generator)
        cell = select_fixation(acquisition(belief, visited), visited, noise)
        stamps.append(clock())
        totals += torch.tensor(stamps, dtype=torch.float64).diff()
    return (1e3 * totals / fixations).tolist()


def turns(path: Path, image: Tensor, options: argparse.Namespace, clock: Clock) -> list[list[str]]:
    """Table rows: times of sensor and detector, each alone and both in turn, and their ratio."""
    gazes = random_cells(options.fixations, (image.shape[-1], image.shape[-2]))
    rows = []
    for threads in options.threads:
        torch.set_num_threads(threads)
        for spinning in (False, True) if threads > 1 else (False,):
            eye = Eye(semfov.Foveation(100.0), load(path, threads, spinning))
            times = interleaved(taking_turns(eye, eye.open(image), gazes), 0, clock, least=options.repetitions)
            ratios = [together / (a + b) for a, b, together in zip(*times.values(), strict=True)]
            medians = [number(statistics.median(values) / len(gazes)) for values in times.values()]
            rows.append([str(threads), "on" if spinning else "off", *medians, spread(Spread.of(ratios))])
    return rows


def stages(path: Path, image: Tensor, options: argparse.Namespace, clock: Clock) -> list[list[str]]:
    """Table rows: times of the parts of a fixation, and of letterbox and pyramid, once per image."""
    grid = semfov.Grid(COLUMNS, ROWS, (image.shape[-1], image.shape[-2]))
    rows = []
    for threads in options.threads:
        torch.set_num_threads(threads)
        eye = Eye(semfov.Foveation(100.0), load(path, threads, spinning=False))
        view = eye.open(image)
        opening = interleaved({"open": partial(eye.open, image)}, 0, clock, options.repetitions)["open"]
        kinds = strategies(eye.detector.classes)
        times: dict[str, list[list[float]]] = {name: [] for name in kinds}
        for repetition in range(-1, options.repetitions):
            for name, strategy in kinds.items():
                row = scanpath(eye, view, grid, strategy, options.fixations, repetition + 1, clock)
                if repetition >= 0:
                    times[name].append(row)
        for name, measured in times.items():
            medians = [number(statistics.median(column)) for column in zip(*measured, strict=True)]
            shares = Spread.of([100 * (1 - row[STAGES.index("detector")] / sum(row)) for row in measured])
            rows.append([str(threads), name, *medians, spread(shares), number(statistics.median(opening))])
    return rows


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="any ONNX file that load_detector accepts (default: YOLOv3-tiny)")
    parser.add_argument("--threads", type=int, nargs="+", help="threads of torch and onnxruntime (default: 1 and all)")
    parser.add_argument("--repetitions", type=int, default=20, help="number of repetitions")
    parser.add_argument("--fixations", type=int, default=10, help="number of fixations in every repetition")
    parser.add_argument("--processor-time", action="store_true", help="CPU time of the calling thread; 1 thread")
    options = parser.parse_args()
    options.threads = options.threads or sorted({1, torch.get_num_threads()})
    clock = time.perf_counter
    if options.processor_time:
        options.threads, clock = [1], time.thread_time
    image = photograph()
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        path = options.model
        if path is None:
            path = Path(folder) / "yolov3-tiny.onnx"
            export_onnx(load_yolo("yolov3-tiny"), path)
        print(f"{path.name}, {options.repetitions} repetitions of {options.fixations} fixations, ms per fixation\n")
        head = ["threads", "spinning", "sensor", "detector", "in turn", "in turn / (sensor + detector)"]
        print(table(head, turns(path, image, options, clock)))
        head = ["threads", "policy", *STAGES, "overhead: all but the detector, %", "letterbox and pyramid, once"]
        print("", table(head, stages(path, image, options, clock)), sep="\n")


if __name__ == "__main__":
    main()
