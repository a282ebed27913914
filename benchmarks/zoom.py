"""Cost of a look at a large picture beside the detector: `python -m benchmarks.zoom --weights yolox_nano_416.onnx`.

The agent explores mosaics of embedded scenes, finds all objects of a class in them, and searches them for a class, and
does the same in a photograph, which is one embedded scene. In the same repetition the detector alone, with the
selection of its boxes, gets the same canvases. The rest of a task is reading and resampling windows, pooling hints,
updating the belief, choosing the next windows, merging boxes and the record. With one thread the agent does a part of
it in a second one, on another core, while the detector works: times of the calling thread are what is left to wait for,
and times of the processor have both.
"""

import time
from collections.abc import Sequence
from dataclasses import asdict

import torch

from benchmarks.tables import begin, command, number, page, spread, table, write
from benchmarks.timing import Clock, Run, Spread, interleaved
from semfov import EmbeddedScenes, ZoomAgent
from semfov.data.images import to_bytes
from semfov.data.mosaics import Mosaics
from semfov.detection.selection import select
from semfov.paths import ZoomPath
from semfov.zoom.eye import WindowView

PASSES = 16
TILES = {"a photograph": (1, 480), "2560 × 1920 px": (4, 480), "3840 × 2160 px": (6, 360), "10240 × 7680 px": (16, 480)}
"""For each picture its tiles along a side, which are 640 pixels wide, and their height."""
TEXT = f"""\
Written by `python -m benchmarks.zoom`. YOLOX-nano, {PASSES} passes over mosaics of embedded scenes. A photograph of
640 × 480 px takes five, the whole and four quarters, and a search of it the whole and closer looks. Medians over
repetitions; ratios with quartiles. With one thread for the detector, windows are resampled ahead by a second thread:
the calling thread has what is left to wait for where a second core is free."""


def programs(agent: ZoomAgent, side: int, height: int) -> dict[str, tuple[Run, Run, int]]:
    """For each task: the program of the agent, that of the detector alone, and the number of passes."""
    scenes = EmbeddedScenes(agent.classes[1:], count=16)
    picture = to_bytes(Mosaics(scenes, side, side, tile=(640, height), count=1)[0].image)
    view = agent.eye.open(picture)
    tasks = {
        "explore": lambda: agent.explore(picture, passes=PASSES, worth=0.0),
        "find all": lambda: agent.find_all(picture, "person", passes=PASSES, worth=0.0),
        # In mosaics without closer looks, which would end it early.
        "search": lambda: agent.search(
            picture, "person", passes=PASSES, confirm=1.0, give_up=0.0, closer=0 if side > 1 else None
        ),
    }
    return {name: (task, detector_alone(agent, view, path := task()), path.passes) for name, task in tasks.items()}


def detector_alone(agent: ZoomAgent, view: WindowView, path: ZoomPath) -> Run:
    """The detector with the selection of its boxes, on the canvases of a path."""
    detector = agent.eye.detector
    fixations = torch.tensor([look.window.fixation for look in path.window_looks], dtype=torch.float64)
    # Bytes, channels last, as the eye passes them on.
    canvases = agent.eye.glimpse(view, fixations)[0].mul(255).round().to(torch.uint8, memory_format=torch.channels_last)

    def run() -> object:
        return [
            select(detector.propose_bytes(canvas[None]), None, detector.selection, detector.background)
            for canvas in canvases
        ]

    return run


def cost(task: Run, detector: Run, seconds: float, clock: Clock) -> tuple[Spread, Spread, Spread]:
    """Milliseconds of a task and of the detector alone, and their ratio."""
    durations = interleaved({"task": task, "detector": detector}, seconds, clock)
    ratios = [ours / theirs for ours, theirs in zip(durations["task"], durations["detector"], strict=True)]
    return Spread.of(durations["task"]), Spread.of(durations["detector"]), Spread.of(ratios)


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all tasks and write the table."""
    parser = command("benchmarks.zoom", __doc__, seconds=10.0)
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano")
    options = parser.parse_args(arguments)
    clock, about = begin(options)
    agent = ZoomAgent.recommended("yolox-nano", weights=options.weights)
    rows, figures = [], {}
    for size, (side, height) in TILES.items():
        for name, (task, detector, passes) in programs(agent, side, height).items():
            whole, alone, ratio = cost(task, detector, options.seconds, clock)
            each = [number(whole.middle / passes), number(alone.middle / passes)]
            *_, waiting = cost(task, detector, options.seconds, time.thread_time if options.threads == 1 else clock)
            rows.append([f"{name}, {size}", *each, spread(ratio), spread(waiting)])
            figures[f"{name}, {size}"] = {
                "task": asdict(whole), "detector": asdict(alone), "ratio": asdict(ratio), "waiting": asdict(waiting)
            }  # fmt: skip
            print(" | ".join(rows[-1]), flush=True)
    head = ["task", "pass, ms", "detector, ms", "task by detector", "in the calling thread"]
    text = page("Large pictures", TEXT, about, table(head, rows))
    write(options.out, "zoom", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
