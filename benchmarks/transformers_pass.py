"""Milliseconds and memory of a pass of RT-DETR-R18 and D-FINE-S with random weights, on which time does not depend.

A pass goes from the canvas to all candidates, with a batch of one. Milliseconds are the median of the processor's time
on one thread. Memory is the largest of a process that has done nothing else, PyTorch included. Hours
are those of the looks of `semfov fit` at 300 photographs, one from each of 100 cells, on one core.

python -m benchmarks.transformers_pass --side 640 416 320
"""

import argparse
import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import torch

from benchmarks.tables import number, table

HYBRID: dict[str, Any] = {"decoder_layers": 3, "hidden_expansion": 0.5, "num_denoising": 0}
STAGES: dict[str, Any] = {"out_features": ["stage2", "stage3", "stage4"]}


def rt_detr() -> Any:
    """RT-DETR with a ResNet-18, as `PekingU/rtdetr_r18vd`."""
    from transformers import RTDetrConfig, RTDetrForObjectDetection, RTDetrResNetConfig

    widths = [64, 128, 256, 512]
    backbone = RTDetrResNetConfig(hidden_sizes=widths, depths=[2, 2, 2, 2], layer_type="basic", **STAGES)
    config = RTDetrConfig(backbone_config=backbone, encoder_in_channels=widths[1:], **HYBRID)
    return RTDetrForObjectDetection(config)


def d_fine() -> Any:
    """D-FINE-S, with an HGNetV2-B0, as `ustc-community/dfine-small-coco`."""
    from transformers import DFineConfig, DFineForObjectDetection
    from transformers.models.hgnet_v2 import HGNetV2Config

    backbone = HGNetV2Config(
        hidden_sizes=[128, 256, 512, 1024],
        stem_channels=[3, 16, 16],
        stage_in_channels=[16, 64, 256, 512],
        stage_mid_channels=[16, 32, 64, 128],
        stage_out_channels=[64, 256, 512, 1024],
        stage_num_blocks=[1, 1, 2, 1],
        stage_downsample=[False, True, True, True],
        stage_light_block=[False, False, True, True],
        stage_kernel_size=[3, 3, 5, 5],
        stage_numb_of_layers=[3, 3, 3, 3],
        use_learnable_affine_block=True,
        **STAGES,
    )
    config = DFineConfig(backbone_config=backbone, encoder_in_channels=[256, 512, 1024], depth_mult=0.34, **HYBRID)
    return DFineForObjectDetection(config)


LOOKS = 300 * 100
"""Looks of `semfov fit` at 300 photographs, one from each of 100 cells."""


def hours(milliseconds: float) -> str:
    """Time of these looks on one core, in hours."""
    return number(LOOKS * milliseconds / 3.6e6)


MODELS: dict[str, Callable[[], Any]] = {"RT-DETR-R18": rt_detr, "D-FINE-S": d_fine}


@torch.inference_mode()
def measure(name: str, side: int, repetitions: int) -> list[str]:
    """Write the row of a model on a square canvas."""
    from semfov import load_detector

    torch.set_num_threads(1)
    model = MODELS[name]()
    parameters = sum(each.numel() for each in model.parameters())
    detector, canvas = load_detector(model), torch.rand(1, 3, side, side)
    detector.propose(canvas)
    times = []
    for _ in range(repetitions):
        start = time.process_time()
        detector.propose(canvas)
        times.append(1000 * (time.process_time() - start))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    middle = statistics.median(times)
    size = f"{side} × {side}"
    return [name, number(parameters / 1e6), size, number(middle), number(memory), hours(middle)]


def main() -> None:
    """Measure each model and canvas in a process of its own, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, nargs="+", default=[640, 416, 320], help="sides of the canvas, in pixels")
    parser.add_argument("--repetitions", type=int, default=25, help="number of passes")
    options = parser.parse_args()
    spawn = multiprocessing.get_context("spawn")
    rows = []
    for name in MODELS:
        for side in options.side:
            with ProcessPoolExecutor(1, mp_context=spawn) as pool:
                rows.append(pool.submit(measure, name, side, options.repetitions).result())
    rows.append(["any", "-", "-", "100", "-", hours(100)])
    print(table(["model", "million parameters", "canvas", "ms", "MiB", "hours of `semfov fit`"], rows))


if __name__ == "__main__":
    main()
