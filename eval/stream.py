"""The demonstration on a video or a camera: prints detections and belief at every frame, and draws them into it."""

import time
from collections import deque
from pathlib import Path

from semfov import viz
from semfov.data.sources import Stream
from semfov.live import LivePerception
from semfov.paths import Moment, detections_in_words
from semfov.viz.live import draw_moment, video, video_suffix

UNKNOWN_RATE = 15.0
"""Frames per second of the written video if the source does not give its own."""


def watch(live: LivePerception, stream: Stream, path: Path) -> Path:
    """Look at every frame, print detections and belief, and write a video of them; Ctrl-C ends it in good order.

    Args:
        live: the running agent.
        stream: the frames.
        path: path of the video to write, without its suffix.

    Returns:
        The path of the video.
    """
    path = path.with_suffix(video_suffix())
    began, looking, shown = time.perf_counter(), 0.0, 0
    lately = deque([began], maxlen=20)
    print(f"{stream.name}: {'exploring' if live.target is None else f'searching for “{live.classes[live.target]}”'}")
    with video(path, stream.rate or UNKNOWN_RATE) as add:
        try:
            for picture in stream.frames:
                moment = live.step(picture.image)
                shown += 1
                looking += sum(moment.seconds.values())
                lately.append(time.perf_counter())
                speed = f"{(len(lately) - 1) / (lately[-1] - lately[0]):.1f} frames/s"
                print(f"  {moment_line(moment)}  {speed}", flush=True)
                add(draw_moment(picture.image, moment, f"{moment.describe()}   {speed}"))
        except KeyboardInterrupt:
            print("  stopped")
    whole = time.perf_counter() - began
    alone = shown / max(looking, 1e-9)
    print(f"{shown} frames, {shown / whole:.1f} per second, {alone:.1f} per second without reading and drawing")
    return path


def moment_line(moment: Moment) -> str:
    """Detections and belief at a frame, as one line."""
    best = int(moment.probability.argmax())
    row, column = divmod(moment.cell, moment.grid.columns)
    seen = detections_in_words(moment.detections, moment.classes, 2, viz.CONFIDENT)
    look = f"{moment.number:4d}  at ({column}, {row}): {seen}"
    if moment.closer is not None:
        look = f"{moment.number:4d}  closely at ({column}, {row}): p {moment.closer.place:.2f} there"
    row, column = divmod(best, moment.grid.columns)
    return f"{look:60s}  {moment.describe()}, most likely at ({column}, {row})"
