"""Make the picture of the README from embedded scenes and a photograph of scikit-image.

With the weights of YOLOX-nano in a file:

python -m eval.readme_picture --weights yolox_nano_416.onnx
python -m eval.readme_picture --zoom --weights yolox_nano_416.onnx    # the picture of docs/zoom.md
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import skimage
from numpy.typing import NDArray
from PIL import Image
from torchvision.ops import box_iou

from semfov import ActivePerception, EmbeddedScenes
from semfov.data import Scene
from semfov.data.mosaics import Mosaics
from semfov.io.files import replacing
from semfov.viz import plot_scanpath
from semfov.viz.animation import render

_PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
_PHOTOGRAPH = Path(skimage.__file__).parent / "data" / "astronaut.png"  # NASA, public domain


def _mosaic(agent: ActivePerception) -> Scene:
    """A picture of 2560 × 1920 px, put together from embedded scenes."""
    return Mosaics(EmbeddedScenes(agent.classes[1:], count=16), 4, 4, tile=(640, 480), count=1)[0]


def _make_picture(path: Path, weights: str | None) -> None:
    """People in a large picture after a few passes and after more, and where people look in a photograph."""
    agent = ActivePerception.recommended("yolox-nano", weights=weights)
    mosaic = _mosaic(agent)
    figure, axes = plt.subplots(2, 2, figsize=(9, 7.2), layout="constrained")
    people = mosaic.boxes[mosaic.labels == agent.classes.index("person")]
    for passes, ax in zip((1, 3, 20), axes.flat, strict=False):
        found = agent.find_all(mosaic.image, "person", passes=passes)
        plot_scanpath(found, mosaic.image, ax=ax)
        right = int((box_iou(people, found.objects.boxes) >= 0.5).any(1).sum())
        ax.set_title(f"{passes} pass{'es' * (passes > 1)}: {right} of {len(people)} people")
    gaze = agent.gaze(_PHOTOGRAPH)
    gaze.plot(ax=axes[1, 1])
    axes[1, 1].set_title("where people look")
    _write_picture(render([figure], dpi=92)[0], path)


def _make_zoom_picture(path: Path, weights: str | None) -> None:
    """Find people in a mosaic of embedded scenes, and draw the windows that the eye looked at."""
    agent = ActivePerception.recommended("yolox-nano", weights=weights)
    mosaic = _mosaic(agent).image
    figure = plot_scanpath(agent.find_all(mosaic, "person", passes=10), mosaic)
    _write_picture(render([figure], dpi=110)[0], path)


def _write_picture(frame: NDArray[np.uint8], path: Path) -> None:
    """Write a picture as a small PNG, atomically."""
    with replacing(path) as temporary:
        image = Image.fromarray(frame)
        # 256 colours of its own; each round of refinement takes seconds.
        image.quantize(palette=image.quantize(256, kmeans=3)).save(temporary, format="PNG", optimize=True)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m eval.readme_picture", description=__doc__.splitlines()[0])
    parser.add_argument("--zoom", action="store_true", help="make the picture of docs/zoom.md")
    parser.add_argument("--weights", help="ONNX file of YOLOX-nano (none: the registered weights)")
    parser.add_argument("--out", type=Path, help="file to write (none: the picture's file in docs/pictures)")
    options = parser.parse_args(arguments)
    path = options.out or _PICTURES / ("zoom.png" if options.zoom else "looking.png")
    if options.zoom:
        _make_zoom_picture(path, options.weights)
    else:
        _make_picture(path, options.weights)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
