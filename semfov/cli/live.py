"""Subcommand live: looks at a video, a camera or a network stream, and writes a video of the looks."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path

from semfov.agents.fovea import cell_at
from semfov.cli.agent import detector_classes, make_agent, one_class, several_classes
from semfov.cli.options import LiveOptions, start_of
from semfov.data.sources import Stream, open_stream
from semfov.errors import InputError, check
from semfov.live import FrameRate, LivePerception
from semfov.paths import FoveaMoment, Moment, WindowMoment, detections_in_words
from semfov.viz.drawing import CONFIDENT
from semfov.viz.live import VIDEO_CODECS, draw_moment, video, video_suffix

_UNKNOWN_RATE = 15.0
"""Frames per second of the written video if the source does not give its own."""


def look_live(options: LiveOptions) -> int:
    """Look at the frames of a video, a camera or a stream."""
    check(options.source is None or options.camera is None, "camera", "a video or a camera, not both", options.camera)
    if options.source is None and options.camera is None:
        raise InputError("source: expected a video, an address or --camera 0, got none")
    check(options.target is None or options.find is None, "find", "a target or classes to find, not both", options.find)
    fits = options.out is None or options.out.is_dir() or options.out.suffix.lower() in ("", *VIDEO_CODECS)
    check(fits, "out", f"a folder, or a file that ends in {' or '.join(VIDEO_CODECS)}", options.out)
    start = start_of(options.start)
    _sought(options, detector_classes(options))
    source = options.source if options.camera is None else options.camera
    assert source is not None
    stream = open_stream(source, options.frames)
    agent = make_agent(options)
    settings = {name: getattr(options, name) for name in ("how", "rate", "seed", "confirm", "give_up", "closer")}
    first = cell_at(start, (agent.columns, agent.rows))
    running = agent.live(_sought(options, agent.classes[1:]), start=first, **settings)
    written = _watch(running, stream, options.out)
    if written is not None:
        print(f"written:\n  {written}")
    return 0


def _sought(options: LiveOptions, classes: Sequence[str] | None) -> str | list[str] | None:
    """The class that is searched for, or the list of those whose objects are all to be found."""
    return one_class(options.target, classes) if options.find is None else several_classes(options.find, classes)


def _watch(live: LivePerception, stream: Stream, path: Path | None) -> Path | None:
    """Look at every frame, print detections and belief until Ctrl-C, and return the path of the video, if any."""
    if path is not None:
        path = path if path.suffix and not path.is_dir() else path / f"live{video_suffix()}"
    rate = FrameRate()
    print(f"{stream.name}: {live.describe()}")
    with nullcontext() if path is None else video(path, stream.rate or _UNKNOWN_RATE) as add:
        try:
            for picture in stream.frames:
                moment = live.step(picture.image)
                rate.add()
                print(f"  {_moment_line(moment)}  {rate}", flush=True)
                if add is not None:
                    add(draw_moment(picture.image, moment, f"{moment.describe()}   {rate}"))
        except KeyboardInterrupt:
            print("  stopped")
    print(rate.summary())
    return path


def _moment_line(moment: Moment) -> str:
    """Detections and belief at a frame, as one line."""
    if isinstance(moment, WindowMoment):
        x, y = moment.window.centre(moment.lattice)
        look = f"{moment.number:4d}  at ({x:.0f}, {y:.0f}) × {moment.window.fixation[2]:.2f}: "
        if moment.examined is None:
            look += detections_in_words(moment.seen, moment.classes, 2, CONFIDENT)
        else:
            look += f"closely, p {moment.examined.place:.2f} there"
        return f"{look:60s}  {moment.describe()}"
    assert isinstance(moment, FoveaMoment)
    best = int(moment.probability.argmax())
    row, column = divmod(moment.cell, moment.grid.columns)
    detections = detections_in_words(moment.detections, moment.classes, 2, CONFIDENT)
    look = f"{moment.number:4d}  at ({column}, {row}): {detections}"
    if moment.closer is not None:
        look = f"{moment.number:4d}  closely at ({column}, {row}): p {moment.closer.place:.2f} there"
    row, column = divmod(best, moment.grid.columns)
    return f"{look:60s}  {moment.describe()}, most likely at ({column}, {row})"
