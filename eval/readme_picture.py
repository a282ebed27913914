"""Make the film of the README from the photographs that come with the package, and two pictures of other pages.

python -m eval.readme_picture
python -m eval.readme_picture --zoom    # the picture of docs/zoom.md
python -m eval.readme_picture --gaze    # the picture of docs/guides/gaze-prediction.md
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from semfov import ActivePerception, example
from semfov.io.files import replacing
from semfov.paths import Record
from semfov.viz import plot_scanpath
from semfov.viz.animation import render

_PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
_FILM_WIDTH = 800
_CAPTION = 36  # height of the line below the film
_SECONDS_A_LOOK = 0.9
_SECONDS_AT_THE_ENDS = (2.0, 4.0)
_LOOK, _FOUND = (255, 191, 0), (0, 128, 96)


def _make_film(path: Path) -> None:
    """Draw how a large picture is searched for people: what each look has made sharp, and who is found with it."""
    sheet = example("sheet")
    records: list[Record] = []
    agent = ActivePerception.recommended()
    record = agent.find_all(sheet, "person", passes=20, on_look=records.append)
    _, height, width = sheet.shape
    scale = _FILM_WIDTH / width
    picture = Image.fromarray((sheet.permute(1, 2, 0) * 255).round().byte().numpy())
    view = Image.new("RGB", (_FILM_WIDTH, round(height * scale)))
    frames = []
    for number, (look, so_far) in enumerate(zip(record.looks, records, strict=True), 1):
        left, top, right, bottom = (round(edge) for edge in look.region)
        window = (left, top, right, bottom)
        _show_window(view, picture, window, agent.eye.detector.input_size, scale)
        frames.append(_film_frame(view, window, so_far.objects.boxes * scale, number, scale))
    times = [_SECONDS_A_LOOK] * len(frames)
    times[0], times[-1] = _SECONDS_AT_THE_ENDS
    with replacing(path) as temporary:
        frames[0].save(
            temporary, format="WEBP", save_all=True, append_images=frames[1:], quality=70, method=6, loop=0,
            duration=[round(1000 * seconds) for seconds in times],
        )  # fmt: skip


def _show_window(
    view: Image.Image,
    picture: Image.Image,
    window: tuple[int, int, int, int],
    input_size: tuple[int, int],
    scale: float,
) -> None:
    """Paste a window of the picture into a view of it, as sharp as the detector has seen it."""
    left, top, right, bottom = (round(edge * scale) for edge in window)
    part = picture.crop(window)
    magnification = min(1.0, *(side / length for side, length in zip(input_size, part.size, strict=True)))
    seen = part.resize([max(1, round(side * magnification)) for side in part.size], Image.Resampling.LANCZOS)
    view.paste(seen.resize((right - left, bottom - top), Image.Resampling.BICUBIC), (left, top))


def _film_frame(
    view: Image.Image, window: tuple[int, int, int, int], boxes: Tensor, number: int, scale: float
) -> Image.Image:
    """One frame of the film: the view, the window that is looked at, the people found so far, and their number."""
    frame = Image.new("RGB", (view.width, view.height + _CAPTION), "white")
    frame.paste(view)
    draw = ImageDraw.Draw(frame)
    for box in boxes.tolist():
        draw.rectangle(box, outline=_FOUND, width=2)
    draw.rectangle([edge * scale for edge in window], outline=_LOOK, width=3)
    looks, people = f"look {number}", f"{len(boxes)} people found"
    font = ImageFont.load_default(22)
    draw.text((8, view.height + 6), looks, fill="black", font=font)
    draw.text((130, view.height + 6), people, fill=_FOUND, font=font)
    return frame


def _make_gaze_picture(path: Path) -> None:
    """Where people look in a photograph."""
    figure, ax = plt.subplots(figsize=(6, 4.6), layout="constrained")
    ActivePerception.recommended().gaze(example("beach")).plot(ax=ax)
    ax.set_title("where people look")
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
    parser.add_argument("--gaze", action="store_true", help="make the picture of docs/guides/gaze-prediction.md")
    parser.add_argument("--out", type=Path, help="file to write (none: the picture's file in docs/pictures)")
    options = parser.parse_args(arguments)
    name, make = "looking.webp", _make_film
    if options.zoom:
        name, make = "zoom.png", _make_zoom_picture
    if options.gaze:
        name, make = "gaze.png", _make_gaze_picture
    path = options.out or _PICTURES / name
    make(path)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
