"""Cost of a frame of a stream beside a plain loop: `python -m benchmarks.live`.

The agent searches frames of 640 x 480 for a person, by windows and by a fovea, while the camera moves. In the same
repetition a plain loop of onnxruntime and OpenCV (`benchmarks.bare`), and semfov's detector alone, get the same frames
as whole pictures.
"""

from collections.abc import Sequence
from dataclasses import asdict
from typing import Literal

import numpy as np
import torch

from benchmarks.bare import BareYolox
from benchmarks.tables import begin, command, comparison_rows, page, table, write
from benchmarks.timing import Comparison, measure
from semfov import ActivePerception, as_image
from semfov.data.examples import example
from semfov.data.images import to_bytes
from semfov.detection.weights import fetch

FRAMES = 30
TEXT = f"""\
Written by `python -m benchmarks.live`. YOLOX-nano, {FRAMES} frames of a camera that moves over a sheet of photographs
by 12 px a frame, one look at each. The plain loop is onnxruntime with OpenCV's letterbox and its suppression of boxes
(`benchmarks/bare.py`). Ratios with quartiles; above 1, semfov is faster."""


def frames() -> list[np.ndarray]:
    """Frames of a camera that moves over a sheet of photographs, 12 px a frame, `(480, 640, 3)` bytes."""
    sheet = to_bytes(example("sheet"))
    corners = [(40 + 12 * number, 200) for number in range(FRAMES)]
    return [np.ascontiguousarray(sheet[top : top + 480, left : left + 640]) for left, top in corners]


def stream(how: Literal["windows", "fovea"], threads: int) -> Comparison:
    """Compare a search in a stream with the detector on every frame."""
    agent = ActivePerception.recommended("yolox-nano")
    pictures = frames()
    detector = agent.eye.detector
    bare = BareYolox(fetch("yolox-nano"), threads)

    def ours() -> object:
        live = agent.live("person", how=how)
        return [live.step(picture) for picture in pictures]

    def alone() -> object:
        return [detector(as_image(picture)[None]) for picture in pictures]

    def loop() -> object:
        return [bare(picture) for picture in pictures]

    return Comparison(f"{FRAMES} frames, {how}", ours, {"a plain loop": loop, "semfov's detector": alone})


@torch.inference_mode()
def main(arguments: Sequence[str] | None = None) -> None:
    """Measure, and write the table."""
    parser = command("benchmarks.live", __doc__, seconds=20.0)
    options = parser.parse_args(arguments)
    clock, about = begin(options)
    measured = [measure(stream(how, options.threads), options.seconds, clock) for how in ("windows", "fovea")]
    head = ["work", "peer", "semfov, ms", "peer, ms", "peer / semfov"]
    rows = [row for one in measured for row in comparison_rows(one)]
    text = page("Frames of a stream", TEXT, about, table(head, rows))
    write(options.out, "live", text, {"machine": about, "comparisons": [asdict(one) for one in measured]})


if __name__ == "__main__":
    main()
