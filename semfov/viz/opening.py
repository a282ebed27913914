"""Frames of a film in which windows open in a picture, each as sharp as the detector has seen it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from torch import Tensor

from semfov.paths import Record

if TYPE_CHECKING:
    from PIL.Image import Image as PillowImage

_CAPTION = 36  # height in pixels of the line below the picture
_LOOK, _FOUND = (255, 191, 0), (0, 128, 96)  # colours of the window of a look, and of what was found


def opening_frames(
    records: Sequence[Record],
    picture: PillowImage,
    input_size: tuple[int, int],
    captions: Sequence[str],
    width: int = 800,
) -> list[PillowImage]:
    """Draw after each look what the looks so far have made sharp, and the objects found with them.

    Args:
        records: the record after each look, as a task gives them to `on_look`.
        picture: the picture in full size.
        input_size: `(width, height)` of the detector's input, which bounds how sharp a window is seen.
        captions: for each look, what is written beside its number.
        width: width of a frame in pixels.

    Returns:
        A frame for each look.
    """
    from PIL import Image

    scale = width / picture.width
    view = Image.new("RGB", (width, round(picture.height * scale)))
    frames = []
    for number, (record, caption) in enumerate(zip(records, captions, strict=True), 1):
        left, top, right, bottom = (round(edge) for edge in record.looks[-1].region)
        window = (left, top, right, bottom)
        _open_window(view, picture, window, input_size, scale)
        frames.append(_frame(view, [edge * scale for edge in window], record.objects.boxes * scale, number, caption))
    return frames


def _open_window(
    view: PillowImage,
    picture: PillowImage,
    window: tuple[int, int, int, int],
    input_size: tuple[int, int],
    scale: float,
) -> None:
    """Paste a window of the picture into a view of it, as sharp as the detector has seen it."""
    from PIL.Image import Resampling

    left, top, right, bottom = (round(edge * scale) for edge in window)
    part = picture.crop(window)
    magnification = min(1.0, *(side / length for side, length in zip(input_size, part.size, strict=True)))
    # First to what the detector gets, then to the size in the view: what it does not see is blurred.
    input_pixels = part.resize([max(1, round(side * magnification)) for side in part.size], Resampling.LANCZOS)
    view.paste(input_pixels.resize((right - left, bottom - top), Resampling.BICUBIC), (left, top))


def _frame(view: PillowImage, window: Sequence[float], boxes: Tensor, number: int, caption: str) -> PillowImage:
    """Draw the window of a look and the boxes found so far over the view, and below it the number of the look."""
    from PIL import Image, ImageDraw, ImageFont

    frame = Image.new("RGB", (view.width, view.height + _CAPTION), "white")
    frame.paste(view)
    draw = ImageDraw.Draw(frame)
    for box in boxes.tolist():
        draw.rectangle(box, outline=_FOUND, width=2)
    draw.rectangle(window, outline=_LOOK, width=3)
    font = ImageFont.load_default(22)
    draw.text((8, view.height + 6), f"look {number}", fill="black", font=font)
    draw.text((130, view.height + 6), caption, fill=_FOUND, font=font)
    return frame
