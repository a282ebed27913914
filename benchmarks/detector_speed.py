"""Milliseconds per photograph of a Darknet detector in onnxruntime and in torch, side by side.

Two canvases are measured: the photograph's (padded to a multiple of 32 pixels, the default) and the whole square.
`network` goes from the canvas to all candidates; `detect` adds non-maximum suppression and score vectors; `all` also
includes the letterbox. Repetitions are interleaved. Times are medians over repetitions. Ratios, torch over onnxruntime
within a repetition, are given with quartiles.

python -m benchmarks.detector_speed --detector yolov3-tiny --batch 1 4
"""

import argparse
import multiprocessing
from concurrent.futures import ProcessPoolExecutor

import torch
from torch import Tensor

from benchmarks.machine import photograph
from benchmarks.tables import number, spread, table
from benchmarks.timing import Run, Spread, interleaved
from semfov.detection import Detector
from semfov.detection.load import load_yolo
from semfov.detection.yolo import Runtime

RUNTIMES: tuple[Runtime, ...] = ("onnxruntime", "torch")


def programs(detector: Detector, images: Tensor) -> dict[str, Run]:
    """Return the programs to time, by name."""
    canvas, placement = detector.fit(images)
    return {
        "network": lambda: detector.propose(canvas),
        "detect": lambda: detector.detect(canvas, placement),
        "all": lambda: detector(images),
    }


@torch.inference_mode()
def measure(options: argparse.Namespace) -> list[list[str]]:
    """Measure, and return the rows of the table."""
    torch.set_num_threads(options.threads)
    rows = []
    for stride in (32, None):
        loaded = [load_yolo(options.detector, weights=options.weights, stride=stride, runtime=r) for r in RUNTIMES]
        for batch in options.batch:
            images = photograph(*options.size).expand(batch, -1, -1, -1).contiguous()
            height, width = loaded[0].fit(images)[0].shape[-2:]
            ours, theirs = (programs(detector, images) for detector in loaded)
            for name in ours:
                times = interleaved({"ours": ours[name], "theirs": theirs[name]}, 0, least=options.repetitions)
                ratio = Spread.of([torchs / onnxs for onnxs, torchs in zip(*times.values(), strict=True)])
                medians = [number(Spread.of(each).middle / batch) for each in times.values()]
                rows.append([f"{width} × {height}", str(batch), name, *medians, spread(ratio)])
    return rows


def main() -> None:
    """Measure in all processes, and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detector", default="yolov3-tiny", help="yolov3-tiny, yolov3, yolov3-spp, or a cfg file")
    parser.add_argument("--weights", help="weights file, for a cfg or instead of the published weights")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], help="width and height of the photograph")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4], help="batch sizes")
    parser.add_argument("--threads", type=int, default=1, help="threads of each process")
    parser.add_argument("--processes", type=int, default=1, help="processes that measure at the same time")
    parser.add_argument("--repetitions", type=int, default=25, help="number of repetitions")
    options = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(options.processes, mp_context=spawn) as pool:
        results = list(pool.map(measure, [options] * options.processes))
    head = ["canvas", "batch", "what", "onnxruntime, ms per photograph", "torch", "torch / onnxruntime"]
    for number_of, rows in enumerate(results, 1):
        print(f"\nprocess {number_of} of {options.processes}, {options.threads} threads, {options.repetitions} times\n")
        print(table(head, rows))


if __name__ == "__main__":
    main()
