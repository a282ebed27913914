"""Cost of a look at a large picture beside a plain loop: `python -m benchmarks.zoom`.

The agent explores mosaics of embedded scenes, finds all objects of a class in them, and searches them for a class, and
does the same in a photograph, which is one embedded scene. In the same repetition a plain loop of onnxruntime and
OpenCV (`benchmarks.bare`) looks at the same windows. The rest of a task is pooling hints, updating the belief, choosing
the next windows, merging boxes and the record. With one thread the agent does a part of it in a second one, on another
core, while the detector works: times of the calling thread are what is left to wait for, and times of the processor
have both.
"""

import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from PIL import Image

from benchmarks.bare import BareYolox, Pixels, bare_looks
from benchmarks.tables import begin, command, number, page, spread, table, write
from benchmarks.timing import Clock, Run, Spread, interleaved_by
from semfov import EmbeddedScenes, ZoomAgent
from semfov.data.images import to_bytes
from semfov.data.mosaics import Mosaics
from semfov.detection.weights import fetch
from semfov.paths import ZoomPath
from semfov.settings import ExploreSettings, FindSettings, SearchSettings

PASSES = 16
TILES = {"a photograph": (1, 480), "2560 × 1920 px": (4, 480), "3840 × 2160 px": (6, 360), "10240 × 7680 px": (16, 480)}
"""For each picture its tiles along a side, which are 640 pixels wide, and their height."""
FILES = "a photograph", "3840 × 2160 px"
"""Pictures that are also read from a JPEG."""
TEXT = f"""\
Written by `python -m benchmarks.zoom`. YOLOX-nano, {PASSES} passes over mosaics of embedded scenes. A photograph of
640 × 480 px takes five, the whole and four quarters, and a search of it the whole and closer looks. The plain loop
looks at the same windows by onnxruntime, OpenCV's letterbox and its suppression of boxes (`benchmarks/bare.py`), and a
JPEG is decoded by OpenCV. Medians over repetitions; ratios with quartiles, both of the same repetitions. With one
thread for the detector, windows are resampled ahead by a second thread: the calling thread has what is left to wait for
where a second core is free."""


def programs(agent: ZoomAgent, bare: BareYolox, side: int, height: int) -> dict[str, tuple[Run, Run, int]]:
    """For each task: the program of the agent, the plain loop, and the number of passes."""
    picture = mosaic(agent, side, height)
    tasks = {
        "explore": lambda: agent.explore(picture, ExploreSettings(passes=PASSES, min_gain=0.0)),
        "find all": lambda: agent.find_all(picture, "person", FindSettings(passes=PASSES, min_gain=0.0)),
        # In mosaics without closer looks, which would end it early.
        "search": lambda: agent.search(
            picture,
            "person",
            SearchSettings(passes=PASSES, confirm=1.0, stop_below=0.0, closer=0 if side > 1 else None),
        ),
    }
    made: dict[str, tuple[Run, Run, int]] = {}
    for name, task in tasks.items():
        path = task()
        made[name] = (task, bare_looks(bare, picture, windows(path)), path.passes)
    return made


def mosaic(agent: ZoomAgent, side: int, height: int) -> Pixels:
    """Make a picture of embedded scenes, `side` along each side."""
    scenes = EmbeddedScenes(agent.classes[1:], count=16)
    picture: Pixels = to_bytes(Mosaics(scenes, side, side, tile=(640, height), count=1)[0].image)
    return picture


def windows(path: ZoomPath) -> list[tuple[float, ...]]:
    """List the windows of a record, `x1 y1 x2 y2` in pixels."""
    return [tuple(look.region) for look in path.looks]


def from_file(agent: ZoomAgent, bare: BareYolox, path: Path) -> tuple[Run, Run, int]:
    """Find all people in a JPEG: the program of the agent, the plain loop, and the number of passes."""

    def task() -> ZoomPath:
        return agent.find_all(path, "person", FindSettings(passes=PASSES, min_gain=0.0))

    record = task()
    places = windows(record)

    def loop() -> object:
        pixels = np.asarray(cv2.imread(str(path)))[:, :, ::-1]
        return bare_looks(bare, pixels, places)()

    return task, loop, record.passes


class Cost(NamedTuple):
    """Cost of a task beside the plain loop.

    Attributes:
        repetitions: how often both ran.
        task: milliseconds of the task.
        loop: milliseconds of the plain loop.
        ratio: task by loop.
        waiting: the same by the times of the calling thread.
    """

    repetitions: int
    task: Spread
    loop: Spread
    ratio: Spread
    waiting: Spread


def cost(task: Run, loop: Run, seconds: float, clocks: tuple[Clock, Clock]) -> Cost:
    """Measure a task and the plain loop by a clock, and by one of the calling thread."""
    by_clock, by_thread = interleaved_by(clocks, {"task": task, "loop": loop}, seconds)
    return Cost(
        len(by_clock["task"]),
        Spread.of(by_clock["task"]),
        Spread.of(by_clock["loop"]),
        _ratio(by_clock),
        _ratio(by_thread),
    )


def _ratio(durations: Mapping[str, list[float]]) -> Spread:
    """Divide the times of the task by those of the loop in the same repetitions."""
    return Spread.of([ours / theirs for ours, theirs in zip(durations["task"], durations["loop"], strict=True)])


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure all tasks and write the table."""
    parser = command("benchmarks.zoom", __doc__, seconds=4.0)
    options = parser.parse_args(arguments)
    clock, about = begin(options)
    agent = ZoomAgent.recommended("yolox-nano")
    bare = BareYolox(fetch("yolox-nano"), options.threads)
    rows, figures = [], {}

    clocks = (clock, time.thread_time if options.threads == 1 else clock)

    def measured(name: str, task: Run, loop: Run, passes: int) -> None:
        found = cost(task, loop, options.seconds, clocks)
        each = [number(found.task.middle / passes), number(found.loop.middle / passes)]
        rows.append([name, *each, spread(found.ratio), spread(found.waiting), str(found.repetitions)])
        figures[name] = {
            "repetitions": found.repetitions,
            "task": asdict(found.task),
            "loop": asdict(found.loop),
            "ratio": asdict(found.ratio),
            "waiting": asdict(found.waiting),
        }
        print(" | ".join(rows[-1]), flush=True)

    for size, (side, height) in TILES.items():
        for name, program in programs(agent, bare, side, height).items():
            measured(f"{name}, {size}", *program)
    with tempfile.TemporaryDirectory() as folder:
        for size in FILES:
            path = Path(folder, f"{len(rows)}.jpg")
            Image.fromarray(mosaic(agent, *TILES[size])).save(path, quality=90)
            measured(f"find all, {size}, from a JPEG", *from_file(agent, bare, path))
    head = ["task", "pass, ms", "plain loop, ms", "task by loop", "in the calling thread", "repetitions"]
    text = page("Large pictures", TEXT, about, table(head, rows))
    write(options.out, "zoom", text, {"machine": about, "milliseconds": figures})


if __name__ == "__main__":
    main()
