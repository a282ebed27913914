"""Subcommand live: looks at a video, a camera or a network stream, and writes a video of the looks."""

from collections import deque
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from shlex import quote
from time import perf_counter

from semfov.agents.fovea import cell_at
from semfov.cli.agent import detector_classes, make_agent, several_classes
from semfov.cli.options import LiveOptions, start_of, white_of
from semfov.cli.results import held_outputs
from semfov.data.classes import class_index
from semfov.data.sources import Stream, open_stream
from semfov.errors import InputError, check
from semfov.live import LivePerception
from semfov.paths import Moment
from semfov.paths.look import detections_in_words
from semfov.viz.live import VIDEO_CODECS, draw_moment, video, video_suffix

_UNKNOWN_RATE = 15.0  # frames per second of the written video if the source does not give its own

_WARM_UP = 3
"""Number of first frames that take longer than the others, because the detector gets ready; they have no rate."""


def look_live(options: LiveOptions) -> int:
    """Look at the frames of a video, a camera or a stream; returns the exit code, 1 if a frame was left out."""
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
    if isinstance(source, str) and source.isdecimal() and not Path(source).exists():
        source = int(source)  # `semfov live 0`, as in OpenCV
    stream = open_stream(source, options.frames, white_of(options.white))
    agent = make_agent(options)
    names = ("how", "rate", "seed", "confirm", "give_up", "closer", "prior")
    settings = {name: getattr(options, name) for name in names}
    first = cell_at(start, (agent.columns, agent.rows))
    running = agent.live(_sought(options, agent.classes[1:]), start=first, **settings)
    with held_outputs(options):
        written = _watch(running, stream, options.out)
    if written is not None:
        print(f"written:\n  {written}")
    return int("skipped" in stream.gaps)


def _sought(options: LiveOptions, classes: Sequence[str] | None) -> str | list[str] | None:
    """The class that is searched for, or the list of those to be found; without names of classes it is not checked."""
    if options.find is not None:
        return several_classes(options.find, classes)
    if options.target is None or classes is None:
        return options.target
    try:
        return classes[class_index(options.target, classes, "target") - 1]
    except InputError as error:
        several = f"; a search is for one class, and --find {quote(options.target)} takes several"
        raise InputError(f"{error}{several * (',' in options.target)}") from None


def _watch(live: LivePerception, stream: Stream, path: Path | None) -> Path | None:
    """Look at every frame, print detections and belief until Ctrl-C, and return the path of the video, if any."""
    if path is not None:
        path = path if path.suffix and not path.is_dir() else path / f"live{video_suffix()}"
    first, count, began, ends = "", 0, 0.0, deque[float](maxlen=20)
    print(f"{stream.name}: {live.describe()}")
    with nullcontext() if path is None else video(path, stream.rate or _UNKNOWN_RATE) as add:
        try:
            for picture in stream.frames:
                here = f"{picture.image.shape[-1]} × {picture.image.shape[-2]}"
                first = first or here
                remedy = "`semfov search`, `find` and `explore` take pictures of any size, each by itself"
                check(here == first, picture.name, f"{first} px, the size of the first frame", f"{here}; {remedy}")
                moment = live.step(picture.image, picture.passed)
                count += 1
                if count == 1 and live.criterion is not None:
                    print(f"  found: when {live.criterion} (--confirm)")
                    print("  absent: when p is below one half, and no look is worth a frame (--give-up)")
                if count >= _WARM_UP:
                    ends.append(perf_counter())
                    began = began or ends[0]
                rate = _rate(len(ends) - 1, ends[-1] - ends[0]) if ends else ""
                print(f"  {_moment_line(moment)}  {rate}", flush=True)
                if add is not None:
                    add(draw_moment(picture.image, moment, f"{moment.describe()}   {rate}"))
        except KeyboardInterrupt:
            print("  stopped")
    mean = _rate(count - _WARM_UP, ends[-1] - began) if ends else ""
    gaps = "".join(f", {number} {what}" for what, number in stream.gaps.items() if number)
    print(f"{count} frame{'' if count == 1 else 's'}{gaps}{mean and f', {mean} after the first {_WARM_UP}'}")
    return path


def _rate(frames: int, seconds: float) -> str:
    return f"{frames / seconds:.1f} frames/s" if frames > 0 and seconds > 0 else ""


def _moment_line(moment: Moment) -> str:
    """Detections and belief at a frame, as one line."""
    row, believed = moment.rows()[-1], moment.belief_map(len(moment) - 1)
    if believed is None:
        at, likely = f"({row['x']:.0f}, {row['y']:.0f}) × {row['magnification']:.2f}", ""
    else:
        columns = believed[0].columns
        at = f"cell ({row['column']}, {row['row']})"
        likely = f", most likely at cell ({row['highest_cell'] % columns}, {row['highest_cell'] // columns})"
    if moment.examined is None:
        look = f"at {at}: {detections_in_words(moment.seen, moment.classes, 2)}"
    else:
        look = f"closely at {at}: p {moment.examined.place:.2f} there"
    return f"{f'{moment.number:4d}  {look}':60s}  {moment.describe()}{likely}"
