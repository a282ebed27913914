"""Film of a camera that flies over photographs: what one look at each frame finds there, and what stays in memory."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from semfov import ActivePerception, example
from semfov.agents.window_episode import LIKELY
from semfov.motion import Motion
from semfov.observation.matching import inside_frame
from semfov.paths import WindowMoment
from semfov.report.episode import pillow

_Bytes = NDArray[np.uint8]
_Floats = NDArray[np.float64]
_Colour = tuple[int, int, int]

_ROWS = (("beach", "lifeboat"), ("farm", "aeroplane"))  # how the photographs lie on the table
_TABLE = (56, 56, 56)  # its colour
_MARGIN = 30  # pixels of it around each photograph
_UNVISITED, _VISITED = 0.12, 0.4  # lightness of what was never in view, and of what has left it
_WINDOW: _Colour = (255, 191, 0)
_IN_VIEW: _Colour = (0, 220, 160)
_OUT_OF_VIEW: _Colour = (0, 150, 115)
_FINE = 3  # lines are drawn so many times as large, and reduced
_FOUND: _Colour = (0, 128, 96)  # of the words about what was found
_CAPTION = 36  # height in pixels of the line below the picture


class FilmFrame(NamedTuple):
    """What is known at a frame of a flight, in pixels of the picture.

    Attributes:
        frame: `(4, 2)`, corners of the frame.
        window: `(4, 2)`, corners of the window that was looked at.
        boxes: `(N, 4)`, the objects that are probably there, in the frame or not, where they probably are.
        numbers: their numbers, which stay.
        in_view: `(N,)` boolean, those in the frame.
    """

    frame: _Floats
    window: _Floats
    boxes: Tensor
    numbers: list[int]
    in_view: Tensor


def table_of_photographs() -> _Bytes:
    """Lay photographs that come with the package on a dark table, `(H, W, 3)` bytes."""
    rows = [[pillow(example(name)) for name in names] for names in _ROWS]
    heights = [max(photograph.height for photograph in row) + _MARGIN for row in rows]
    widths = [max(photograph.width for photograph in column) + _MARGIN for column in zip(*rows, strict=True)]
    table = Image.new("RGB", (sum(widths) + _MARGIN, sum(heights) + _MARGIN), _TABLE)
    for row, bottom, height in zip(rows, np.cumsum(heights), heights, strict=True):
        for photograph, right, width in zip(row, np.cumsum(widths), widths, strict=True):
            left = int(right) - width + (_MARGIN + width - photograph.width) // 2
            top = int(bottom) - height + (_MARGIN + height - photograph.height) // 2
            table.paste(photograph, (left, top))
    return np.asarray(table)


def round_trip(points: Sequence[tuple[float, float]], size: tuple[int, int], count: int, turn: float) -> list[Motion]:
    """Plan the poses of a camera that flies from point to point, and back to the first one.

    Args:
        points: `(x, y)` of the picture that its frame has in the middle.
        size: `(width, height)` of a frame.
        count: number of frames.
        turn: degrees by which the camera leans to either side on its way.

    Returns:
        The maps from the picture to each frame.
    """
    corners = np.array([*points, points[0]], np.float64)
    way = np.concatenate([[0.0], np.linalg.norm(np.diff(corners, axis=0), axis=1).cumsum()])
    poses = []
    for share in np.arange(count) / count:
        x, y = (float(np.interp(share * way[-1], way, line)) for line in corners.T)
        lean = Motion.similarity(turn=turn * float(np.sin(2 * np.pi * share)))
        to_middle = Motion.similarity(shift=(size[0] / 2, size[1] / 2))
        poses.append(Motion.similarity(shift=(-x, -y)).then(lean).then(to_middle))
    return poses


def fly(
    agent: ActivePerception, picture: _Bytes, poses: Sequence[Motion], size: tuple[int, int], target: str
) -> Iterator[FilmFrame]:
    """Let an agent look once at each frame of a flight; it is not told where the camera is.

    Args:
        agent: the agent.
        picture: `(H, W, 3)` bytes.
        poses: the maps from the picture to each frame.
        size: `(width, height)` of a frame.
        target: class whose objects are to be found.

    Yields:
        What is known at each frame.
    """
    live = agent.live([target])
    for pose in poses:
        pixels = cv2.warpAffine(picture, pose.matrix[:2], size, flags=cv2.INTER_LINEAR, borderValue=_TABLE)
        moment = live.step(pixels)
        assert isinstance(moment, WindowMoment)
        tracks = moment.tracks[moment.tracks.existence >= LIKELY]
        to_picture = pose.inverse()
        yield FilmFrame(
            frame=_corners(to_picture, (0, 0, *size)),
            window=_corners(to_picture, moment.looks[-1].region),
            boxes=to_picture.boxes(tracks.boxes),
            numbers=tracks.track_ids.tolist(),
            in_view=inside_frame(tracks.boxes, size),
        )


def _corners(motion: Motion, box: Sequence[float]) -> _Floats:
    """Map the corners of a box; returns `(4, 2)`."""
    left, top, right, bottom = box
    corners = Tensor([[left, top], [right, top], [right, bottom], [left, bottom]]).double()
    return np.asarray(motion.points(corners).numpy())


def flight_frames(picture: _Bytes, film_frames: Sequence[FilmFrame], what: str, width: int) -> list[Image.Image]:
    """Draw what is known at each frame in the picture: bright in the frame, dim where it was before, else dark.

    Args:
        picture: `(H, W, 3)` bytes.
        film_frames: what is known at each frame.
        what: the objects in words, such as `people`.
        width: width of the film in pixels.

    Returns:
        A frame of the film for each frame of the flight.
    """
    scale = width / picture.shape[1]
    base = Image.fromarray(picture).resize((width, round(picture.shape[0] * scale)), Image.Resampling.LANCZOS)
    lightness = np.full((base.height, base.width, 1), _UNVISITED)
    frames = []
    for number, film_frame in enumerate(film_frames):
        in_frame = _cover(base.size, film_frame.frame * scale)
        shades = lightness + (1 - lightness) * in_frame
        lightness = np.maximum(lightness, _VISITED * in_frame)
        view = Image.fromarray(np.rint(np.asarray(base) * shades).astype(np.uint8))
        view = _with_lines(view, film_frame, scale)
        _write_numbers(view, film_frame, scale)
        frames.append(_with_caption(view, number, film_frame, what))
    return frames


def _cover(size: tuple[int, int], corners: _Floats) -> _Floats:
    """Tell how much of each pixel of a picture lies within four corners, `(height, width, 1)`."""
    mask = Image.new("L", (size[0] * _FINE, size[1] * _FINE))
    ImageDraw.Draw(mask).polygon(_fine(corners), fill=255)
    return np.asarray(mask.reduce(_FINE), np.float64)[..., None] / 255


def _with_lines(view: Image.Image, film_frame: FilmFrame, scale: float) -> Image.Image:
    """Draw the objects, the window and the frame."""
    # What no line touches stays as it is: a pixel of its own colour, many times.
    fine = view.resize((view.width * _FINE, view.height * _FINE), Image.Resampling.NEAREST)
    draw = ImageDraw.Draw(fine)
    for box, is_in_view in zip(film_frame.boxes.tolist(), film_frame.in_view.tolist(), strict=True):
        place = [edge * scale * _FINE for edge in box]
        draw.rectangle(place, outline=_IN_VIEW if is_in_view else _OUT_OF_VIEW, width=2 * _FINE)
    _draw_outline(draw, film_frame.frame * scale, (255, 255, 255), _FINE)
    _draw_outline(draw, film_frame.window * scale, _WINDOW, 3 * _FINE)
    return fine.reduce(_FINE)


def _draw_outline(draw: ImageDraw.ImageDraw, corners: _Floats, colour: _Colour, width: int) -> None:
    """Draw a line through four corners, and back to the first one."""
    points = _fine(corners)
    draw.line([*points, *points[:2]], fill=colour, width=width, joint="curve")


def _fine(corners: _Floats) -> list[tuple[float, float]]:
    """Convert corners `(4, 2)` to pixels of the picture in which lines are drawn."""
    return [(x * _FINE, y * _FINE) for x, y in corners.tolist()]


def _write_numbers(view: Image.Image, film_frame: FilmFrame, scale: float) -> None:
    """Write the number of each object in view above its box."""
    draw = ImageDraw.Draw(view)
    font = ImageFont.load_default(11)
    for number, box, is_in_view in zip(
        film_frame.numbers, film_frame.boxes.tolist(), film_frame.in_view.tolist(), strict=True
    ):
        if is_in_view:
            x = box[0] * scale
            y = box[1] * scale - 13
            draw.text((x, y), str(number), fill="white", font=font, stroke_width=1, stroke_fill="black")


def _with_caption(view: Image.Image, number: int, film_frame: FilmFrame, what: str) -> Image.Image:
    """Add a line with the number of the frame and of the objects."""
    frame = Image.new("RGB", (view.width, view.height + _CAPTION), "white")
    frame.paste(view)
    draw = ImageDraw.Draw(frame)
    font = ImageFont.load_default(22)
    y = view.height + 5
    draw.text((8, y), f"frame {number + 1}", fill="black", font=font)
    counts = f"{len(film_frame.numbers)} {what} known, {int(film_frame.in_view.sum())} in view"
    draw.text((130, y), counts, fill=_FOUND, font=font)
    return frame
