"""Milliseconds per photograph of a Darknet detector, by three ways of computing its convolutions, in one run.

Winograd's algorithm (the default on a CPU), plain torch in channels-last memory, and the same network exported to
onnxruntime. Repetitions are interleaved and the least time is reported, so that other work on the machine disturbs
little. `network` is the network alone; `all` has letterbox, decoding, suppression and score vectors with it.

python -m benchmarks.detector_speed --detector yolov3-tiny --batch 1 4 --processes 2
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import torch
from torch import Tensor

from semfov.detection import Detector
from semfov.detection.export import export_onnx
from semfov.detection.load import load_detector, load_yolo
from semfov.detection.placement import resize

Run = Callable[[], object]


def photograph(width: int, height: int) -> Tensor:
    """A photograph that scikit-image carries, `(1, 3, height, width)`."""
    from skimage import data

    return resize(torch.from_numpy(data.coffee()).permute(2, 0, 1)[None] / 255, (width, height))


def detectors(name: str, weights: str | None, stride: int | None) -> dict[str, Detector]:
    """The same detector three times."""
    direct = load_yolo(name, weights=weights, stride=stride, winograd=False)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        export_onnx(direct, path)
        exported = load_detector(path)
    winograd = load_yolo(name, weights=weights, stride=stride, winograd=True)
    return {"torch, Winograd": winograd, "torch, direct": direct, "onnxruntime": exported}


def least_times(runs: dict[str, Run], repetitions: int) -> dict[str, float]:
    """Least seconds of each run, over interleaved repetitions."""
    best = dict.fromkeys(runs, float("inf"))
    for _ in range(repetitions + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            best[name] = min(best[name], time.perf_counter() - start)
    return best


@torch.no_grad()
def measure(arguments: argparse.Namespace) -> dict[tuple[str, int], tuple[float, float]]:
    """Milliseconds per photograph, of the network and of all, by backend and batch size."""
    torch.set_num_threads(arguments.threads)
    rows = {}
    loaded = detectors(arguments.detector, arguments.weights, arguments.stride or None)
    for batch in arguments.batch:
        images = photograph(*arguments.size).expand(batch, -1, -1, -1).contiguous()
        networks: dict[str, Run] = {}
        whole: dict[str, Run] = {}
        for name, detector in loaded.items():
            canvas = detector.fit(images)[0]
            networks[name] = lambda detector=detector, canvas=canvas: detector.propose(canvas)
            whole[name] = lambda detector=detector, images=images: detector(images)
        alone, together = least_times(networks, arguments.repetitions), least_times(whole, arguments.repetitions)
        for name in loaded:
            rows[name, batch] = (1e3 * alone[name] / batch, 1e3 * together[name] / batch)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description="milliseconds per photograph of a Darknet detector")
    parser.add_argument("--detector", default="yolov3-tiny", help="yolov3-tiny, yolov3, yolov3-spp, or a cfg")
    parser.add_argument("--weights", help="weights file, for a cfg or instead of the published weights")
    parser.add_argument("--size", type=int, nargs=2, default=[640, 480], help="width and height of the photograph")
    parser.add_argument("--stride", type=int, default=32, help="canvas padding; 0: the whole canvas")
    parser.add_argument("--batch", type=int, nargs="+", default=[1, 4], help="photographs at once")
    parser.add_argument("--threads", type=int, default=1, help="threads of each process")
    parser.add_argument("--processes", type=int, default=1, help="processes that measure at the same time")
    parser.add_argument("--repetitions", type=int, default=20)
    arguments = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(arguments.processes, mp_context=spawn) as pool:
        results = list(pool.map(measure, [arguments] * arguments.processes))
    print(f"{arguments.processes} processes of {arguments.threads} threads; milliseconds in one process")
    print("| backend | batch | network | all |\n|---|---|---|---|")
    for name, batch in results[0]:
        network, whole = (max(result[name, batch][column] for result in results) for column in range(2))
        print(f"| {name} | {batch} | {network:.1f} | {whole:.1f} |")


if __name__ == "__main__":
    main()
