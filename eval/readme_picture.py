"""Make the picture of the README from a photograph that scikit-image ships: `python -m eval.readme_picture`.

python -m eval.readme_picture
python -m eval.readme_picture --zoom --weights yolox_nano_416.onnx    # the picture of docs/zoom.md, of embedded scenes
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import skimage
import torch
from PIL import Image

from semfov import ActivePerception, EmbeddedScenes, Scanpath, ZoomAgent
from semfov.data.mosaics import Mosaics
from semfov.io.files import replacing
from semfov.viz import plot_belief_strip, plot_foveated_strip, plot_scanpath
from semfov.viz.animation import Frame, render

_PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
_PHOTOGRAPH = Path(skimage.__file__).parent / "data" / "coffee.png"  # by Rachel Michetti, CC0
TARGET, START = "cup", 99


def _make_picture(path: Path) -> None:
    """Search the photograph, and draw the foveated views above the beliefs, in a small file."""
    agent = ActivePerception.recommended("yolov3-tiny")
    with torch.inference_mode():
        scanpath = agent.search(_PHOTOGRAPH, TARGET, start=START)
    assert isinstance(scanpath, Scanpath)
    views = plot_foveated_strip(scanpath, most=3)
    beliefs = plot_belief_strip(scanpath, most=3)
    _write_picture(_stacked(render([views, beliefs], dpi=105)), path)


def _make_zoom_picture(path: Path, weights: str | None) -> None:
    """Find people in a mosaic of embedded scenes, and draw the windows that the eye looked at."""
    agent = ZoomAgent.recommended("yolox-nano", weights=weights)
    scenes = EmbeddedScenes(agent.classes[1:], count=16)
    mosaic = Mosaics(scenes, 4, 4, tile=(640, 480), count=1)[0].image
    figure = plot_scanpath(agent.find_all(mosaic, "person", passes=10), mosaic)
    _write_picture(render([figure], dpi=110)[0], path)


def _write_picture(frame: Frame, path: Path) -> None:
    """Write a picture as a small PNG, atomically."""
    with replacing(path) as temporary:
        image = Image.fromarray(frame)
        # 256 colours of its own; each round of refinement takes seconds.
        image.quantize(palette=image.quantize(256, kmeans=3)).save(temporary, format="PNG", optimize=True)


def _stacked(frames: list[Frame]) -> Frame:
    """Stack frames vertically on a white background."""
    width = max(frame.shape[1] for frame in frames)
    pads = [((0, 0), (0, width - frame.shape[1]), (0, 0)) for frame in frames]
    padded = [np.pad(frame, pad, constant_values=255) for frame, pad in zip(frames, pads, strict=True)]
    return np.concatenate(padded)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m eval.readme_picture", description=__doc__.splitlines()[0])
    parser.add_argument("--zoom", action="store_true", help="make the picture of docs/zoom.md, with YOLOX-nano")
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano (none: the registered weights)")
    parser.add_argument("--out", type=Path, help="file to write (none: the picture's file in docs/pictures)")
    options = parser.parse_args(arguments)
    path = options.out or _PICTURES / ("zoom.png" if options.zoom else "search.png")
    if options.zoom:
        _make_zoom_picture(path, options.weights)
    else:
        _make_picture(path)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
