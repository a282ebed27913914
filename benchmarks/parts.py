"""Where the time of pictures goes: `python -m benchmarks.parts --photographs FOLDER --pictures FOLDER`.

Photographs are fixated as for a fit of an observation model, and large pictures are searched for all people, both with
YOLOX-nano in one thread. Times are those of the processor, for files that the system has in its memory.
"""

import json
import time
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from statistics import mean
from typing import TypeVar

import torch
from torch import Tensor

from benchmarks.tables import begin, command, number, page, table, write
from benchmarks.timing import Run
from semfov import ActivePerception, Detections, Detector, ZoomAgent, as_image
from semfov.data.large import open_large
from semfov.detection.selection import select
from semfov.errors import check
from semfov.eye import Eye, View
from semfov.paths import ZoomPath
from semfov.settings import FindSettings
from semfov.zoom.eye import WindowView

FIXATIONS, PASSES = 8, 24
TEXT = f"""\
Written by `python -m benchmarks.parts`. Milliseconds of one core for each picture, with YOLOX-nano: {FIXATIONS}
fixations of a photograph, and {PASSES} passes over a large picture. Means over the pictures."""

_Made = TypeVar("_Made")


class _Parts(dict[str, list[float]]):
    """Milliseconds of each part, for each picture."""

    def timed(self, part: str, work: Callable[..., _Made], *arguments: object) -> _Made:
        """Do some work, and note what it took."""
        began = time.process_time()
        made = work(*arguments)
        self.setdefault(part, []).append(1e3 * (time.process_time() - began))
        return made

    def rows(self, kind: str) -> list[list[str]]:
        """Table rows with the mean and the share of each part."""
        means = {part: mean(times) for part, times in self.items()}
        whole = sum(means.values())
        shares = [[kind, part, number(each), f"{100 * each / whole:.0f} %"] for part, each in means.items()]
        return [*shares, [kind, "all", number(whole), f"{1e3 / whole:.2g} a second"]]


def detector_alone(agent: ZoomAgent, view: WindowView, path: ZoomPath) -> Run:
    """Run the detector with the selection of its boxes, on the canvases of a path."""
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


def photographs(files: Iterable[Path], weights: str | None) -> _Parts:
    """Decode photographs and fixate them at random points."""
    eye, parts = ActivePerception.recommended("yolox-nano", weights=weights).fovea.eye, _Parts()
    for file in files:
        image = parts.timed("decoding", as_image, file)
        view = parts.timed("letterbox, pyramid", eye.open, image)
        gazes = (torch.rand(FIXATIONS, 2) * torch.tensor([image.shape[-1], image.shape[-2]])).split(1)
        canvases = parts.timed("foveation", foveated, eye, view, gazes)
        parts.timed("detector", detected, eye.detector, canvases, view)
    return parts


def foveated(eye: Eye, view: View, gazes: Sequence[Tensor]) -> list[Tensor]:
    """Foveate a photograph at points, one after another."""
    return [eye.foveated(view, gaze) for gaze in gazes]


def detected(detector: Detector, canvases: Sequence[Tensor], view: View) -> list[Detections]:
    """Detect in canvases one after another."""
    return [detector.detect(canvas, view.placement) for canvas in canvases]


def large_pictures(files: Iterable[Path], weights: str | None) -> _Parts:
    """Find all people in large pictures, and write the records as JSON."""
    agent, parts = ZoomAgent.recommended("yolox-nano", weights=weights), _Parts()
    find = partial(agent.find_all, target="person", settings=FindSettings(passes=PASSES, min_gain=0.0))
    for file in files:
        picture = open_large(file)
        parts.timed("decoding", picture.read, (0, 0, 1, 1))
        path = parts.timed("windows, choices, merging", find, picture)
        parts.timed("detector", detector_alone(agent, agent.eye.open(picture), path))
        parts["windows, choices, merging"][-1] -= parts["detector"][-1]
        parts.timed("record as JSON", json.dumps, path.to_dict())
    return parts


@torch.inference_mode()
def main() -> None:
    """Measure, and write the table."""
    parser = command("benchmarks.parts", __doc__, seconds=0.0)
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano")
    parser.add_argument("--photographs", type=Path, required=True, help="folder of photographs (JPEG)")
    parser.add_argument("--pictures", type=Path, required=True, help="folder of large pictures (JPEG)")
    parser.add_argument("--limit", type=int, default=40, help="largest number of files of each folder")
    options = parser.parse_args()
    _, about = begin(options)
    kinds = {"photograph": (photographs, options.photographs), "large picture": (large_pictures, options.pictures)}
    rows, figures = [], {}
    found = {kind: sorted(folder.glob("*.jpg"))[: options.limit] for kind, (_, folder) in kinds.items()}
    for kind, files in found.items():
        check(len(files) > 0, kind, f"files *.jpg in {kinds[kind][1]}", "none")
    for kind, files in found.items():
        measure = kinds[kind][0]
        measure(files[:1], options.weights)  # first calls take longer
        figures[kind] = measure(files, options.weights)
        rows += figures[kind].rows(kind)
    head = ["picture", "part", "ms", "share"]
    write(
        options.out, "parts", page("Parts", TEXT, about, table(head, rows)), {"machine": about, "milliseconds": figures}
    )


if __name__ == "__main__":
    main()
