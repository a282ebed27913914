"""Make the film of the README from the photographs that come with the package, and pictures of other pages.

python -m eval.readme_picture
python -m eval.readme_picture --zoom    # the picture of docs/zoom.md
python -m eval.readme_picture --gaze    # the picture of docs/guides/gaze-prediction.md
python -m eval.readme_picture --flight  # the film of docs/guides/live.md
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from eval.flight_film import flight_frames, fly, round_trip, table_of_photographs
from semfov import ActivePerception, example
from semfov.io.files import replacing
from semfov.paths import Record
from semfov.report.episode import pillow
from semfov.viz import plot_scanpath
from semfov.viz.animation import render, write_webp
from semfov.viz.opening import opening_frames

_PICTURES = Path(__file__).parents[1] / "docs" / "pictures"
_SECONDS_A_LOOK = 0.9
_SECONDS_AT_THE_ENDS = (2.0, 4.0)
_ROUTE = ((360, 290), (870, 250), (870, 740), (340, 740))  # over the beach, the lifeboat, the aeroplane and the farm
_CAMERA = (640, 440)  # width and height of its frames
_FLIGHT_FRAMES = 90
_SECONDS_A_FRAME = 0.1


def _make_film(path: Path) -> None:
    """Draw how a large picture is searched for people: what each look has made sharp, and who is found with it."""
    sheet = example("sheet")
    records: list[Record] = []
    agent = ActivePerception.recommended()
    agent.find_all(sheet, "person", passes=20, on_look=records.append)
    captions = [f"{len(record.objects)} people found" for record in records]
    frames = opening_frames(records, pillow(sheet), agent.eye.detector.input_size, captions)
    seconds = [_SECONDS_A_LOOK] * len(frames)
    seconds[0], seconds[-1] = _SECONDS_AT_THE_ENDS
    with replacing(path) as temporary, temporary.open("wb") as file:
        write_webp(frames, file, seconds, 70, effort=6)


def _make_flight(path: Path) -> None:
    """Draw what is known while a camera flies over photographs, of which it shows about a quarter at a time."""
    table = table_of_photographs()
    poses = round_trip(_ROUTE, _CAMERA, _FLIGHT_FRAMES, turn=3.0)
    film_frames = [*fly(ActivePerception.recommended(), table, poses, _CAMERA, "person")]
    frames = flight_frames(table, film_frames, "people", width=640)
    seconds = [_SECONDS_A_FRAME] * len(frames)
    with replacing(path) as temporary, temporary.open("wb") as file:
        write_webp(frames, file, seconds, 45, effort=6)


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
    parser.add_argument("--flight", action="store_true", help="make the film of docs/guides/live.md")
    parser.add_argument("--out", type=Path, help="file to write (none: the picture's file in docs/pictures)")
    options = parser.parse_args(arguments)
    name = "looking.webp"
    make = _make_film
    if options.zoom:
        name = "zoom.png"
        make = _make_zoom_picture
    if options.gaze:
        name = "gaze.png"
        make = _make_gaze_picture
    if options.flight:
        name = "flight.webp"
        make = _make_flight
    path = options.out or _PICTURES / name
    make(path)
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main())
