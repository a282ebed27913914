"""Cost of a look at a large picture beside the detector: `python -m benchmarks.zoom --weights yolox_nano_416.onnx`.

The agent explores mosaics of embedded scenes, finds all objects of a class in them, and searches them for a class. In
the same repetition the detector alone, with the selection of its boxes, gets the same canvases. The rest of a pass is
reading and resampling the window, pooling hints, merging boxes, updating the belief and choosing the next window.
"""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from benchmarks.images import use_threads
from benchmarks.machine import describe
from benchmarks.tables import RESULTS, number, spread, table, write
from benchmarks.timing import Clock, Run, Spread, clock_for, interleaved
from semfov import EmbeddedScenes, ZoomAgent
from semfov.data.large import to_bytes
from semfov.data.mosaics import Mosaics
from semfov.detection.selection import select
from semfov.paths import ZoomPath

PASSES = 17
SIZES = {"2560 × 1920 px": (4, 4), "3840 × 2880 px": (6, 6), "10240 × 7680 px": (16, 16)}


def programs(agent: ZoomAgent, columns: int, rows: int) -> dict[str, tuple[Run, Run, int]]:
    """For each task: the program of the agent, that of the detector alone, and the number of passes."""
    scenes = EmbeddedScenes(agent.classes[1:], count=16)
    picture = to_bytes(Mosaics(scenes, columns, rows, tile=(640, 480), count=1)[0].image)
    eye, detector = agent.eye, agent.eye.detector
    view = eye.open(picture)

    def alone(path: ZoomPath) -> Run:
        fixations = torch.tensor([glance.window.fixation for glance in path.glances], dtype=torch.float64)
        # Bytes, channels last, as the eye passes them on.
        floats = eye.glimpse(view, fixations)[0]
        canvases = floats.mul(255).round().to(torch.uint8, memory_format=torch.channels_last)

        def run() -> object:
            return [
                select(detector.propose_bytes(canvas[None]), None, detector.selection, detector.background)
                for canvas in canvases
            ]

        return run

    tasks = {
        "explore": lambda: agent.explore(picture, passes=PASSES, worth=0.0),
        "find all": lambda: agent.find_all(picture, "person", passes=PASSES, worth=0.0),
        # Without closer looks, which would end it early.
        "search": lambda: agent.search(picture, "person", passes=PASSES, confirm=1.0, give_up=0.0, closer=0),
    }
    return {name: (task, alone(path := task()), path.passes) for name, task in tasks.items()}


def share(task: Run, detector: Run, seconds: float, clock: Clock) -> tuple[Spread, Spread, Spread]:
    """Milliseconds of a task and of the detector alone, and the share of the task that is not the detector."""
    found = interleaved({"task": task, "detector": detector}, seconds, clock)
    rest = [1 - theirs / ours for ours, theirs in zip(found["task"], found["detector"], strict=True)]
    return Spread.of(found["task"]), Spread.of(found["detector"]), Spread.of(rest)


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all tasks and write the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.zoom", description=__doc__.splitlines()[0])
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano")
    parser.add_argument("--threads", type=int, default=1, help="number of threads")
    parser.add_argument("--seconds", type=float, default=10.0, help="shortest duration for each task")
    parser.add_argument("--out", type=Path, default=RESULTS, help="folder of the result files")
    options = parser.parse_args(arguments)
    use_threads(options.threads)
    clock, times = clock_for(options.threads)
    agent = ZoomAgent.recommended("yolox-nano", weights=options.weights)
    rows, figures = [], {}
    for size, (columns, lines) in SIZES.items():
        for name, (task, detector, passes) in programs(agent, columns, lines).items():
            whole, alone, rest = share(task, detector, options.seconds, clock)
            rows.append([f"{name}, {size}", number(whole.middle / passes), number(alone.middle / passes), spread(rest)])
            figures[f"{name}, {size}"] = {"task": asdict(whole), "detector": asdict(alone), "rest": asdict(rest)}
            print(" | ".join(rows[-1]), flush=True)
    about = describe() | {"times": times}
    head = ["task", "pass, ms", "detector, ms", "share of a pass that is not the detector"]
    text = "\n".join(
        [
            "# Large pictures",
            "",
            f"Written by `python -m benchmarks.zoom`. YOLOX-nano, {PASSES} passes over mosaics of embedded scenes.",
            "Medians over repetitions; shares with quartiles.",
            "",
            *(f"- {key}: {value}" for key, value in about.items()),
            "",
            table(head, rows),
            "",
        ]
    )
    write(options.out, "zoom", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
