"""Frames of animated pictures (GIF and WebP), with the time for which each is shown."""

from collections.abc import Iterator
from contextlib import ExitStack
from itertools import count
from pathlib import Path

from torch import Tensor

from semfov.data.images import check_proportion, from_pillow, open_pillow, opening
from semfov.data.tone import White

_UNTIMED = 0.1  # seconds of a frame that states none, as browsers show it


def animation(path: Path, white: White | None = None) -> Iterator[tuple[Tensor, float]]:
    """Read the frames of an animation.

    Args:
        path: the file.
        white: as for `semfov.read_image`.

    Yields:
        A frame, `(3, H, W)`, and the seconds for which it is shown.

    Raises:
        DataError: the file, or a frame of it, cannot be read.
    """
    with ExitStack() as stack:
        with opening(path, "opened"):
            image = stack.enter_context(open_pillow(path))
            check_proportion(image.size, path.stat().st_size, path)
        for number in count():
            with opening(path, "decoded"):
                try:
                    image.seek(number)
                except EOFError:
                    return
                picture = from_pillow(image, f"image {path}", white)
            yield picture, image.info.get("duration", 0) / 1000 or _UNTIMED
