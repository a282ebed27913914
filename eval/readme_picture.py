"""Make the picture of the README from a photograph that scikit-image carries: `python -m eval.readme_picture`."""

from pathlib import Path

import numpy as np
import skimage
import torch

from semfov import ActivePerception
from semfov.io.files import replacing
from semfov.viz import plot_belief_strip, plot_foveated_strip
from semfov.viz.animation import Frame, in_palette, render

PATH = Path(__file__).parents[1] / "docs" / "pictures" / "search.png"
PHOTOGRAPH = Path(skimage.__file__).parent / "data" / "coffee.png"  # by Rachel Michetti, CC0
TARGET, START = "cup", 99


def make_picture(path: Path = PATH) -> None:
    """Search the photograph, and draw what was seen above what was believed, in a small file."""
    agent = ActivePerception.recommended("yolov3-tiny")
    with torch.inference_mode():
        scanpath = agent.search(PHOTOGRAPH, TARGET, start=START)
    seen = plot_foveated_strip(scanpath, most=3)
    believed = plot_belief_strip(scanpath, most=3)
    with replacing(path) as temporary:
        in_palette(stacked(render([seen, believed], dpi=105)), refine=3).save(temporary, format="PNG", optimize=True)


def stacked(frames: list[Frame]) -> Frame:
    """Frames one below the other, on white."""
    width = max(frame.shape[1] for frame in frames)
    pads = [((0, 0), (0, width - frame.shape[1]), (0, 0)) for frame in frames]
    padded = [np.pad(frame, pad, constant_values=255) for frame, pad in zip(frames, pads, strict=True)]
    return np.concatenate(padded)


if __name__ == "__main__":
    make_picture()
    print(PATH)
