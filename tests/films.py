"""Films in the containers of common codecs."""

from collections.abc import Iterable, Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np


def encode(
    path: Path, codec: str, times: Iterable[int], pictures: Sequence[np.ndarray] | None = None, **options: str
) -> Path:
    """Write a film of pictures `(h, w, 3)`, grey ones without any, at times in frames of 30 a second.

    Options are those of the codec, and `movflags` that of the container. Frames before 0 are in the file, and are not
    shown.
    """
    times = list(times)
    pictures = (
        [np.full((48, 64, 3), 10 * number, np.uint8) for number in range(len(times))] if pictures is None else pictures
    )
    of_file = {"movflags": options.pop("movflags")} if "movflags" in options else {}
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w", options=of_file) as film:
        stream = film.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.codec_context.time_base, stream.codec_context.thread_count = Fraction(1, 30), 1
        packets = []
        for time, picture in zip(times, pictures, strict=True):
            frame = av.VideoFrame.from_ndarray(picture, "rgb24")
            frame.pts, frame.time_base = time - times[0], Fraction(1, 30)
            packets += stream.encode(frame)
        for packet in [*packets, *stream.encode()]:
            packet.pts += times[0]
            packet.dts += times[0]
            film.mux(packet)
    return path
