"""Subcommand live: looks at a video, a camera or a network stream, and writes a video of the looks."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from semfov.agents.fovea import cell_at
from semfov.cli.agent import known_classes, make_agent, one_class
from semfov.cli.options import LiveOptions, start_of
from semfov.data.sources import Stream, open_stream
from semfov.errors import InputError, check
from semfov.live import FrameRate, LivePerception
from semfov.paths import Moment, detections_in_words
from semfov.viz.drawing import CONFIDENT
from semfov.viz.live import draw_moment, video, video_suffix

UNKNOWN_RATE = 15.0
"""Frames per second of the written video if the source does not give its own."""


def look_live(options: LiveOptions) -> int:
    """Look at the frames of a video, a camera or a stream.

    Args:
        options: the options.

    Returns:
        The exit code.

    Raises:
        InputError: there is no source, or an option does not fit.
    """
    check(options.source is None or options.camera is None, "camera", "a video or a camera, not both", options.camera)
    if options.source is None and options.camera is None:
        raise InputError("source: expected a video, an address or --camera 0, got none")
    start = start_of(options.start)
    one_class(options.target, known_classes(options))
    stream = open_live(options)
    agent = make_agent(options)
    target = one_class(options.target, agent.classes[1:])
    given = {name: getattr(options, name) for name in ("rate", "seed", "confirm", "give_up", "closer")}
    running = agent.live(target, start=cell_at(start, (agent.columns, agent.rows)), **given)
    written = watch(running, stream, options.out)
    if written is not None:
        print(f"written:\n  {written}")
    return 0


def open_live(options: LiveOptions) -> Stream:
    """Open the video, the camera or the stream that the options name."""
    source = options.source if options.camera is None else options.camera
    assert source is not None
    return open_stream(source, options.frames)


def watch(live: LivePerception, stream: Stream, path: Path | None) -> Path | None:
    """Look at every frame and print detections and belief; Ctrl-C ends it in good order.

    Args:
        live: the running agent.
        stream: the frames.
        path: video to write, with any suffix, or a folder for it; None writes none.

    Returns:
        The path of the video.
    """
    if path is not None:
        path = (path / "live" if path.is_dir() or not path.suffix else path).with_suffix(video_suffix())
    rate = FrameRate()
    print(f"{stream.name}: {'exploring' if live.target is None else f'searching for “{live.classes[live.target]}”'}")
    with nullcontext() if path is None else video(path, stream.rate or UNKNOWN_RATE) as add:
        try:
            for picture in stream.frames:
                moment = live.step(picture.image)
                rate.add()
                print(f"  {moment_line(moment)}  {rate}", flush=True)
                if add is not None:
                    add(draw_moment(picture.image, moment, f"{moment.describe()}   {rate}"))
        except KeyboardInterrupt:
            print("  stopped")
    print(rate.summary())
    return path


def moment_line(moment: Moment) -> str:
    """Detections and belief at a frame, as one line.

    Args:
        moment: the frame.

    Returns:
        The line.
    """
    best = int(moment.probability.argmax())
    row, column = divmod(moment.cell, moment.grid.columns)
    seen = detections_in_words(moment.detections, moment.classes, 2, CONFIDENT)
    look = f"{moment.number:4d}  at ({column}, {row}): {seen}"
    if moment.closer is not None:
        look = f"{moment.number:4d}  closely at ({column}, {row}): p {moment.closer.place:.2f} there"
    row, column = divmod(best, moment.grid.columns)
    return f"{look:60s}  {moment.describe()}, most likely at ({column}, {row})"
