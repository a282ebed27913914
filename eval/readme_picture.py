"""Make the picture of the README from the photographs that come with the package.

python -m eval.readme_picture
python -m eval.readme_picture --zoom    # the picture of docs/zoom.md
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image
from torchvision.ops import box_iou

from semfov import ActivePerception, example
from semfov.data.examples import example_scene
from semfov.io.files import replacing
from semfov.viz import plot_scanpath
from semfov.viz.animation import render

_PICTURES = Path(__file__).parents[1] / "docs" / "pictures"


def _make_picture(path: Path) -> None:
    """People in a large picture after a few passes and after more, and where people look in a photograph."""
    agent = ActivePerception.recommended()
    sheet = example_scene("sheet", agent.classes[1:])
    figure, axes = plt.subplots(2, 2, figsize=(9, 7.2), layout="constrained")
    people = sheet.boxes[sheet.labels == agent.classes.index("person")]
    for passes, ax in zip((1, 3, 20), axes.flat, strict=False):
        found = agent.find_all(sheet.image, "person", passes=passes)
        plot_scanpath(found, sheet.image, ax=ax)
        right = int((box_iou(people, found.objects.boxes) >= 0.5).any(1).sum())
        ax.set_title(f"{passes} pass{'es' * (passes > 1)}: {right} of {len(people)} people")
    gaze = agent.gaze(example("beach"))
    gaze.plot(ax=axes[1, 1])
    axes[1, 1].set_title("where people look")
    _write_picture(render([figure], dpi=92)[0], path)


def _make_zoom_picture(path: Path) -> None:
    """Find people in a sheet of photographs, and draw the windows that the eye looked at."""
    sheet = example("sheet")
    found = ActivePerception.recommended().find_all(sheet, "person", passes=10)
    figure = plot_scanpath(found, sheet)
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
    parser.add_argument("--out", type=Path, help="file to write (none: the picture's file in docs/pictures)")
    options = parser.parse_args(arguments)
    path = options.out or _PICTURES / ("zoom.png" if options.zoom else "looking.png")
    if options.zoom:
        _make_zoom_picture(path)
    else:
        _make_picture(path)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
