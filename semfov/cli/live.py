"""Subcommand live: looks at a video, a camera or a network stream, and writes a video of the looks."""

import shutil
import sys
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import fields
from pathlib import Path
from shlex import quote
from time import perf_counter

import torch

from semfov.cli.agent import detector_classes, make_agent, several_classes
from semfov.cli.options import LiveOptions, white_of
from semfov.cli.results import held_outputs
from semfov.data.classes import amount, counted, known_class, several_known
from semfov.data.sources import Picture, Stream, open_stream
from semfov.detection import Detections
from semfov.errors import InputError, check
from semfov.io.files import check_apart, check_writable, write_text
from semfov.live import LivePerception
from semfov.paths import Moment, WindowMoment
from semfov.paths.look import detections_in_words
from semfov.settings import StreamSettings
from semfov.viz.live import VIDEO_CODECS, draw_moment, video, video_suffix

_UNKNOWN_RATE = 15.0  # frames per second of the written video if the source does not give its own

_RECENT = 20  # number of frames over which the present rate is taken

_WARM_UP = 3
"""Number of first frames that take longer than the others, because the detector gets ready; they have no rate."""


def look_live(options: LiveOptions) -> int:
    """Look at the frames of a video, a camera or a stream.

    Args:
        options: the options of the command.

    Returns:
        The exit code, 1 if a frame was left out.
    """
    source = _source_of(options)
    if options.target is not None:
        check(options.find is None, "find", "a target or classes to find, not both", options.find)
    _check_outputs(options)
    # What is wrong with the target is reported before the agent is loaded, where its classes are known by then.
    _sought(options, detector_classes(options))
    check_writable(options.tracks)
    stream = open_stream(source, options.frames, white_of(options.white))
    agent = make_agent(options)
    settings = {setting.name: getattr(options, setting.name) for setting in fields(StreamSettings)}
    live = agent.live(_sought(options, agent.classes[1:]), **settings)
    have_tracks = options.tracks is None or live.how != "fovea"
    check(have_tracks, "tracks", "looks at windows, as with --how windows, for objects with numbers", live.how)
    path = _video_path(options.out)
    if isinstance(source, str):  # and no number of a camera
        check_apart(path, [Path(source)])
    with held_outputs(options):
        _watch(live, stream, path, options.tracks)
    written = [str(file) for file in (path, options.tracks) if file is not None]
    if written:
        print("\n  ".join(["written:", *written]))
    return int("skipped" in stream.gaps)


def _source_of(options: LiveOptions) -> str | int:
    """Take the video or address, or the number of the camera; `semfov live 0` is a camera, too, as in OpenCV."""
    source = options.source
    camera = options.camera
    if camera is not None:
        check(source is None, "camera", "a video or a camera, not both", camera)
        return camera
    if source is None:
        raise InputError("source: expected a video, an address or --camera 0, got none")
    is_number = source.isdecimal() and not Path(source).exists()
    return int(source) if is_number else source


def _check_outputs(options: LiveOptions) -> None:
    """Raise `InputError` for files of another kind than a video and a text of tracks."""
    out = options.out
    if out is not None:
        is_video = out.is_dir() or out.suffix.lower() in ("", *VIDEO_CODECS)
        check(is_video, "out", f"a folder, or a file that ends in {' or '.join(VIDEO_CODECS)}", out)
    tracks = options.tracks
    if tracks is not None:
        check(tracks.suffix.lower() == ".txt", "tracks", "a file that ends in .txt", tracks)


def _video_path(out: Path | None) -> Path | None:
    """Name the video that is written: the file that is given, or one in the folder; None for none."""
    if out is None or (out.suffix and not out.is_dir()):
        return out
    return out / f"live{video_suffix()}"


def _sought(options: LiveOptions, classes: Sequence[str] | None) -> str | list[str] | None:
    """Take the class that is searched for, or the list of those to be found; it is checked by the names of classes."""
    if options.find is not None:
        return several_classes(options.find, classes)
    if options.target is None or classes is None:
        return options.target
    try:
        return known_class(options.target, classes, "target")
    except InputError as error:
        if not several_known(options.target, classes):
            raise
        raise InputError(f"{error}; --find {quote(options.target)} takes several") from None


def _watch(live: LivePerception, stream: Stream, path: Path | None, tracks: Path | None) -> None:
    """Look at every frame until Ctrl-C, print detections and belief, and write the video and the tracks, if wanted."""
    speed = _Speed()
    sums = _Sums()
    lines = _FrameLines()
    mot_lines: list[str] = []
    print(f"{stream.name}: {live.describe()}")
    written = nullcontext() if path is None else video(path, stream.rate or _UNKNOWN_RATE)
    with written as add_frame, lines.until_stopped():
        for picture, moment in _moments(live, stream):
            speed.count_frame()
            sums.add(moment)
            if tracks is not None:
                mot_lines.append(_mot_lines(moment))
            if speed.frames == 1:
                print("\n".join(_legend(live, moment)))
            rate = speed.recent()
            lines.show(f"  {_moment_line(moment)}  {rate}")
            if add_frame is not None:
                add_frame(draw_moment(picture.image, moment, f"{moment.describe()}   {rate}"))
    if tracks is not None:
        write_text(tracks, "".join(mot_lines))
    print(_totals(stream, speed))
    if speed.frames:
        print(sums.describe(), end="")


class _FrameLines:
    """The lines of the frames: one below the other, or on a terminal one line that is renewed."""

    def __init__(self) -> None:
        self._is_renewed = sys.stdout.isatty()
        self._is_open = False

    @contextmanager
    def until_stopped(self) -> Iterator[None]:
        """Open a block for the frames, which Ctrl-C ends in good order: what was written until then is whole."""
        try:
            yield
        except KeyboardInterrupt:
            self.end()
            print("  stopped")
        finally:
            self.end()

    def show(self, line: str) -> None:
        """Print the line of a frame; on a terminal as much of it as a line of it holds."""
        if not self._is_renewed:
            print(line, flush=True)
            return
        # A full line would make some terminals begin the next one.
        width = shutil.get_terminal_size().columns - 1
        print(f"\r{line[:width]:{width}}", end="", flush=True)
        self._is_open = True

    def end(self) -> None:
        """End the line that is renewed, after which others are printed."""
        if self._is_open:
            print()
        self._is_open = False


class _Sums:
    """What was listed in all frames: the different objects by their numbers, or in how many frames a target was found.

    An object whose class changes counts once, as what it was listed last.
    """

    def __init__(self) -> None:
        self._names: dict[int, str] = {}
        self._sought: list[str] = []
        self._target: str | None = None
        self._frames = 0
        self._frames_found = 0
        self._have_numbers = False

    def add(self, moment: Moment) -> None:
        """Add the objects or the decision of a frame."""
        self._frames += 1
        if moment.verdict:
            self._target = moment.target_name
            self._frames_found += moment.verdict == "found"
            return
        numbers = moment.objects.track_ids if isinstance(moment, WindowMoment) else None
        if numbers is None:
            return
        self._have_numbers = True
        self._sought = [moment.classes[label] for label in moment.sought]
        for number, label in zip(numbers.tolist(), moment.objects.labels.tolist(), strict=True):
            self._names[number] = moment.classes[label]

    def describe(self) -> str:
        """Say it in a line; empty where objects have no numbers."""
        if self._target is not None:
            return f"{self._target} found in {self._frames_found} of {amount(self._frames, 'frame')}\n"
        if not self._have_numbers:
            return ""
        counts = Counter(dict.fromkeys(self._sought, 0))
        counts.update(self._names.values())
        kinds = ", ".join(counted(number, name) for name, number in counts.most_common())
        limit = "; one that was lost for long may count again" if self._names else ""
        return f"different objects listed: {kinds or 'none'}{limit}\n"


def _moments(live: LivePerception, stream: Stream) -> Iterator[tuple[Picture, Moment]]:
    """Look at every frame of a stream; all frames have the size `(H, W)` of the first one."""
    size = None
    for picture in stream.frames:
        size = size or picture.image.shape[-2:]
        _check_same_size(picture, size)
        yield picture, live.step(picture.image, picture.passed)


def _totals(stream: Stream, speed: "_Speed") -> str:
    """Say how many frames were looked at, how many were not, and how fast it was."""
    totals = [amount(speed.frames, "frame")]
    totals += [f"{number} {kind}" for kind, number in stream.gaps.items() if number]
    mean = speed.mean()
    if mean:
        totals.append(f"{mean} after the first {_WARM_UP}")
    return ", ".join(totals)


def _mot_lines(moment: Moment) -> str:
    """Write the objects of a frame in MOTChallenge's format; raises `InputError` where they have no numbers."""
    if not isinstance(moment, WindowMoment) or moment.candidates.track_ids is None:
        raise InputError("tracks: expected looks at windows, by an agent with evidence for them, got others")
    return moment.to_mot()


def _check_same_size(picture: Picture, size: Sequence[int]) -> None:
    """Raise `InputError` unless a frame has the size `(H, W)` of the first one."""
    height, width = picture.image.shape[-2:]
    expected = f"{size[1]} × {size[0]} px, the size of the first frame"
    remedy = "`semfov search`, `find` and `explore` take pictures of any size, each by itself"
    check((height, width) == tuple(size), picture.name, expected, f"{width} × {height}; {remedy}")


class _Speed:
    """Frames per second, in words: over the last frames, and over all but the first ones, which take longer.

    `_ends` has the times at which the last frames were done, and `_began` the first of all of them.
    """

    def __init__(self) -> None:
        self.frames = 0
        self._began = 0.0
        self._ends = deque[float](maxlen=_RECENT)

    def count_frame(self) -> None:
        """Count a frame that is done now."""
        self.frames += 1
        if self.frames < _WARM_UP:
            return
        # The end of the last frame of the warm-up is the beginning of those that count.
        now = perf_counter()
        if not self._ends:
            self._began = now
        self._ends.append(now)

    def recent(self) -> str:
        """Say the rate of the last frames; nothing is said before it is known."""
        return _rate(len(self._ends) - 1, self._ends[-1] - self._ends[0]) if self._ends else ""

    def mean(self) -> str:
        """Say the rate of all frames after the first ones."""
        return _rate(self.frames - _WARM_UP, self._ends[-1] - self._began) if self._ends else ""


def _rate(frames: int, seconds: float) -> str:
    """Write a number of frames in some seconds as a rate; nothing where there is none."""
    return f"{frames / seconds:.1f} frames/s" if frames > 0 and seconds > 0 else ""


def _legend(live: LivePerception, moment: Moment) -> list[str]:
    """Say what the line of a frame has in it, and when a search is decided."""
    place = "(x, y) × magnification" if moment.belief_map(len(moment) - 1) is None else "cell (column, row)"
    known = "what is known so far" if moment.decision is None else "what is decided so far"
    shown = "what it shows"
    if moment.sought:
        shown += f" of {', '.join(moment.classes[label] for label in moment.sought)}"
    lines = [f"  a line: frame, at {place} of the look: {shown}, with scores; then {known}"]
    if live.criterion is not None:
        lines.append(f"  found: when {live.criterion} (--confirm)")
        lines.append("  absent: when p is below one half, and no closer look is worth a frame (--stop-below)")
    if moment.decision is not None:
        lines.append("  p: the probability that the frame shows the target; there: that it is at the place found")
    return lines


def _moment_line(moment: Moment) -> str:
    """Write detections and belief at a frame in one line."""
    row = moment.rows()[-1]
    belief = moment.belief_map(len(moment) - 1)
    most_likely = ""
    if belief is None:
        place = f"({row['x']:z.0f}, {row['y']:z.0f}) × {row['magnification']:.2f}"
    else:
        highest_row, highest_column = divmod(row["highest_cell"], belief[0].columns)
        place = f"cell ({row['column']}, {row['row']})"
        most_likely = f", most likely at cell ({highest_column}, {highest_row})"
    if moment.examined is None:
        look = f"at {place}: {detections_in_words(_sought_of(moment), moment.classes, 2)}"
    else:
        look = f"closely at {place}: p {moment.examined.place:.2f} there"
    return f"{f'{moment.number:4d}  {look}':60s}  {moment.describe()}{most_likely}"


def _sought_of(moment: Moment) -> Detections:
    """Take the detections of the classes that are looked for; all where none is named."""
    if not moment.sought:
        return moment.seen
    labels = moment.seen.labels[0]
    return moment.seen.take(torch.isin(labels, labels.new_tensor(moment.sought)))
