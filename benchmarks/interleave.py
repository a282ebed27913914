"""What a fixation costs in addition to its detection, and whether sensor and detector slow each other down.

Two thread pools alternate: torch's in the sensor and onnxruntime's in the detector. First, sensor and detector are
timed each alone and then alternately; alternating should cost no more than the sum of both alone. It costs more if the
threads of onnxruntime spin while they wait, so semfov turns spinning off; the table shows both settings. Second, whole
fixations are timed part by part: sensor, detector, belief and policy.

Repetitions are interleaved, each in another order. Times are medians over repetitions; ratios and shares are given with
quartiles. The observation model changes no score, but costs as much as a fitted one.

If a ratio stays above 1 without spinning, memory is the cause: glibc returns freed blocks of several MB to the system,
and every fixation has to request its pages again. `--keep-memory` frees one block of 31 MB at the start, after which
glibc keeps up to 62 MB.

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
from pathlib import Path

import torch
from torch import Tensor

import semfov
from benchmarks.images import photograph
from benchmarks.timing import Clock, Comparison, Spread, interleaved
from semfov.detection import Detections
from semfov.detection.export import export_onnx
from semfov.detection.load import load_yolo
from semfov.detection.onnx import OnnxDetector, load_onnx
from semfov.detection.onnx_session import OnnxSession
from semfov.eye import Eye, View
from semfov.gaze.selection import select_fixation
from semfov.strategy import Strategy

COLUMNS, ROWS, TARGET = 10, 10, 1
EDGES = [50 * level / 640 for level in range(1, 8)]
STAGES = ("sensor", "detector", "belief", "policy")


def load(path: Path, threads: int, spinning: bool) -> OnnxDetector:
    """Load a detector with `threads` threads, which spin while they wait if `spinning`."""
    detector = load_onnx(path, threads=threads)
    detector.session = OnnxSession(path, threads=threads, spinning=spinning)
    return detector


def taking_turns(eye: Eye, view: View, fixations: Tensor, repetitions: int, clock: Clock) -> dict[str, list[float]]:
    """Milliseconds per fixation of the sensor alone, of the detector alone and of both in turn, by repetition."""
    gazes = fixations.split(1)
    canvases = [eye.foveated(view, gaze) for gaze in gazes]
    runs: dict[str, Callable[[], object]] = {
        "sensor": lambda: [eye.foveated(view, gaze) for gaze in gazes],
        "detector": lambda: [eye.detector.detect(canvas, view.placement) for canvas in canvases],
        "in turn": lambda: [eye.look(view, gaze) for gaze in gazes],
    }
    times = interleaved(runs, 0, clock, least=repetitions)
    return {name: [each / len(gazes) for each in values] for name, values in times.items()}


def in_turn(fixations: int = 10) -> Comparison:
    """Fixations in which sensor and detector alternate, compared with all sensor work first and then all detection."""
    image = photograph()
    grid = semfov.Grid(COLUMNS, ROWS, (640, 480))
    order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))
    gazes = grid.centres[order[:fixations]].split(1)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "yolov3-tiny.onnx"
        with torch.inference_mode(False), torch.no_grad():
            export_onnx(load_yolo("yolov3-tiny"), path)
        eye = Eye(semfov.Foveation(100.0), load(path, torch.get_num_threads(), spinning=False))
    view = eye.open(image)

    def apart() -> list[Detections]:
        canvases = [eye.foveated(view, gaze) for gaze in gazes]
        return [eye.detector.detect(canvas, view.placement) for canvas in canvases]

    def ours() -> list[Detections]:
        return [eye.look(view, gaze) for gaze in gazes]

    def agree() -> None:
        for one, other in zip(ours(), apart(), strict=True):
            torch.testing.assert_close(one.boxes, other.boxes)
            torch.testing.assert_close(one.scores, other.scores)

    return Comparison(f"{fixations} fixations, sensor and detector in turn", ours, {"each alone": apart}, {}, agree)


def strategies(classes: Sequence[str]) -> dict[str, Strategy]:
    """Strategies of different cost, from the cheapest search to exploration."""
    model = semfov.FovealObservationModel.identity(classes, EDGES).eval()
    raw, calibrated = (semfov.observers.Semantic(1 + len(classes), observation) for observation in (None, model))
    return {
        "search, non-predictive, raw": Strategy(raw, semfov.policies.NonPredictive()),
        "search, predictive, calibrated": Strategy(calibrated, semfov.policies.Predictive(model)),
        "exploration, KL divergence, calibrated": Strategy(calibrated, semfov.policies.KL(model)),
    }


def scanpath(
    eye: Eye, view: View, grid: semfov.Grid, strategy: Strategy, fixations: int, seed: int, clock: Clock
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


def spread(values: Sequence[float], scale: float = 1.0, digits: int = 2) -> str:
    """Median and quartiles, as text."""
    quartiles = Spread.of([scale * value for value in values])
    return f"{quartiles.middle:.{digits}f} ({quartiles.low:.{digits}f}-{quartiles.high:.{digits}f})"


def report_turns(path: Path, image: Tensor, options: argparse.Namespace, clock: Clock) -> None:
    """Print the times of sensor and detector, each alone and both in turn."""
    grid = semfov.Grid(COLUMNS, ROWS, (image.shape[-1], image.shape[-2]))
    order = torch.randperm(len(grid), generator=torch.Generator().manual_seed(0))
    fixations = grid.centres[order[: options.fixations]]
    print(f"\n{options.repetitions} repetitions of {len(fixations)} fixations, ms per fixation\n")
    print("| threads | spinning | sensor | detector | in turn | in turn / (sensor + detector) |")
    print("|---|---|---|---|---|---|")
    for threads in options.threads:
        torch.set_num_threads(threads)
        for spinning in (False, True) if threads > 1 else (False,):
            eye = Eye(semfov.Foveation(100.0), load(path, threads, spinning))
            times = taking_turns(eye, eye.open(image), fixations, options.repetitions, clock)
            ratios = [together / (a + b) for a, b, together in zip(*times.values(), strict=True)]
            cells = " | ".join(f"{statistics.median(values):.2f}" for values in times.values())
            print(f"| {threads} | {'on' if spinning else 'off'} | {cells} | {spread(ratios)} |")


def report_stages(path: Path, image: Tensor, options: argparse.Namespace, clock: Clock) -> None:
    """Print the times of the parts of a fixation."""
    grid = semfov.Grid(COLUMNS, ROWS, (image.shape[-1], image.shape[-2]))
    opened: dict[int, float] = {}
    print("\nparts of a fixation, ms; overhead is the share of all parts except the detector\n")
    print("| threads | policy | sensor | detector | belief | policy | overhead, % |")
    print("|---|---|---|---|---|---|---|")
    for threads in options.threads:
        torch.set_num_threads(threads)
        eye = Eye(semfov.Foveation(100.0), load(path, threads, spinning=False))
        kinds = strategies(eye.detector.classes)
        opening: list[float] = []
        rows: dict[str, list[list[float]]] = {name: [] for name in kinds}
        for repetition in range(-1, options.repetitions):
            start = clock()
            view = eye.open(image)
            opening.append(1e3 * (clock() - start))
            for name, strategy in kinds.items():
                row = scanpath(eye, view, grid, strategy, options.fixations, repetition + 1, clock)
                if repetition >= 0:
                    rows[name].append(row)
        for name, measured in rows.items():
            cells = " | ".join(f"{statistics.median(column):.2f}" for column in zip(*measured, strict=True))
            shares = [1 - row[STAGES.index("detector")] / sum(row) for row in measured]
            print(f"| {threads} | {name} | {cells} | {spread(shares, 100, 1)} |")
        opened[threads] = statistics.median(opening)

    openings = ", ".join(f"{time:.2f} ({threads})" for threads, time in opened.items())
    print(f"\nletterbox and pyramid, once per image, ms (threads): {openings}")


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--model", type=Path, help="any ONNX file that load_detector accepts (default: YOLOv3-tiny)")
    parser.add_argument("--threads", type=int, nargs="+", help="threads of torch and onnxruntime (default: 1 and all)")
    parser.add_argument("--repetitions", type=int, default=20, help="number of repetitions")
    parser.add_argument("--fixations", type=int, default=10, help="number of fixations in every repetition")
    parser.add_argument("--keep-memory", action="store_true", help="make the C library keep freed memory")
    parser.add_argument(
        "--processor-time", action="store_true", help="measure CPU time of the calling thread; 1 thread"
    )
    options = parser.parse_args()
    options.threads = options.threads or sorted({1, torch.get_num_threads()})
    clock = time.perf_counter
    if options.processor_time:
        options.threads, clock = [1], time.thread_time
    if options.keep_memory:
        torch.empty(31 << 20, dtype=torch.uint8)
    image = photograph()
    with torch.no_grad(), tempfile.TemporaryDirectory() as folder:
        path = options.model
        if path is None:
            path = Path(folder) / "yolov3-tiny.onnx"
            export_onnx(load_yolo("yolov3-tiny"), path)
        print(path.name)
        report_turns(path, image, options, clock)
        report_stages(path, image, options, clock)


if __name__ == "__main__":
    main()
