"""Cost of a frame of a stream beside the detector: `python -m benchmarks.live --weights yolox_nano_416.onnx`.

The agent searches frames of 640 x 480 by a fovea for a person. In the same repetition the detector alone gets the same
frames as whole pictures.
"""

from dataclasses import asdict

import numpy as np
import torch

from benchmarks.tables import begin, command, comparison_rows, page, table, write
from benchmarks.timing import Comparison, measure
from semfov import ActivePerception, EmbeddedScenes, as_image
from semfov.data.images import to_bytes

FRAMES = 30
TEXT = f"""\
Written by `python -m benchmarks.live`. YOLOX-nano, {FRAMES} frames of embedded scenes. Ratios with quartiles; above 1,
semfov is faster."""


def frames(classes: tuple[str, ...]) -> list[np.ndarray]:
    """Embedded scenes as a camera gives them, `(480, 640, 3)` bytes."""
    scenes = EmbeddedScenes(classes, count=FRAMES)
    return [to_bytes(scenes[number].image) for number in range(FRAMES)]


def stream(weights: str | None) -> Comparison:
    """A search in a stream, compared with the detector on every frame."""
    agent = ActivePerception.recommended("yolox-nano", weights=weights)
    pictures, detector = frames(agent.classes[1:]), agent.eye.detector

    def ours() -> object:
        live = agent.live("person", how="fovea")
        return [live.step(picture) for picture in pictures]

    def alone() -> object:
        return [detector(as_image(picture)[None]) for picture in pictures]

    return Comparison(f"{FRAMES} frames", ours, {"the detector": alone})


@torch.inference_mode()
def main() -> None:
    """Measure, and write the table."""
    parser = command("benchmarks.live", __doc__, seconds=20.0)
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano")
    options = parser.parse_args()
    clock, about = begin(options)
    measured = measure(stream(options.weights), options.seconds, clock)
    head = ["work", "peer", "semfov, ms", "peer, ms", "peer / semfov"]
    text = page("Frames of a stream", TEXT, about, table(head, comparison_rows(measured)))
    write(options.out, "live", text, {"machine": about, "comparisons": [asdict(measured)]})


if __name__ == "__main__":
    main()
