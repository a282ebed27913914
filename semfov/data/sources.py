"""Sources of streams for the agent: videos, cameras, and folders of frames."""

import math
import time
import warnings
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
import torch
from torch import Tensor

from semfov.data.animations import animation
from semfov.data.containers import Container, container_of, frames_stated
from semfov.data.inputs import FRAME, STREAMS
from semfov.data.picture_files import picture_files
from semfov.data.reading import read_image
from semfov.data.tone import Values, White, black_and_white, bytes_between, check_white
from semfov.errors import DataError, SemfovError, check, check_data, needing

_WAIT = 10_000  # milliseconds that a stream may take to open, or to give a frame
_PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0)  # seconds between the attempts to open a stream again that broke off
_MOST_FRAMES = 1e9  # of a file; streams state numbers that mean nothing
_MOST_ATTEMPTS = 10_000  # to read a frame of a file; if none succeeds it has ended, whatever it states
_FASTEST = 1000  # frames per second
_LONGEST = 1e9  # seconds between two frames
_ROUNDING = 1e-3  # seconds by which differences of the time stamps of Matroska may be off

_SIXTEEN_BITS = {int.from_bytes(code, "little") for code in (b"Y1\0\x10", b"Y16 ")}
"""Codes of frames of 16 bits, grey, of FFmpeg and of a camera."""


class Picture(NamedTuple):
    """A picture from a source.

    Attributes:
        name: of the file, or of the frame.
        image: `(3, H, W)`.
        boxes: `(M, 4)`; None where they are not known.
        passed: seconds since the last frame of a stream.
    """

    name: str
    image: Tensor
    boxes: Tensor | None = None
    passed: float = FRAME


class Stream(NamedTuple):
    """A video or a camera.

    Attributes:
        name: for messages, without a password.
        rate: frames per second; None where nothing tells it.
        frames: in their order.
        gaps: how many frames were `lost` or `skipped` so far, and how often the source was `reconnected`.
    """

    name: str
    rate: float | None
    frames: Iterator[Picture]
    gaps: Mapping[str, int] = MappingProxyType({})


def open_stream(source: str | Path | int, most: int | None = None, white: White | None = None) -> Stream:
    """Open a stream of pictures.

    Args:
        source: the file of a video, a folder of frames, the number of a camera, or the address of a stream.
        most: largest number of frames; None for no limit.
        white: the values of 16 bits that are black and white, as for `semfov.read_image`.

    Returns:
        The stream, whose first frame is read.

    Raises:
        DataError: it cannot be opened.
        InputError: no stream has such an address.
    """
    check_white(white)
    if isinstance(source, int):
        return _open_recorder(_Camera(source), most, white)
    if isinstance(source, str) and "://" in source:
        return _open_recorder(_Address(source), most, white)
    path = Path(source)
    if path.is_dir():
        return _open_folder(path, most, white)
    container = container_of(path)
    got = "a text, such as a playlist, which names other files; give these"
    check_data(container != "text", path.name, "a video", got)
    if container == "animation":
        return _open_animation(path, most, white)
    return _open_recorder(_Film(path, container), most, white)


def has_frames(path: Path, count: int) -> bool:
    """Tell whether a video can be read up to its last frame.

    Args:
        path: its file, which was just written by OpenCV.
        count: number of frames that were written.
    """
    import cv2

    film = _Film(path).recorder(cv2)
    film.set(cv2.CAP_PROP_POS_FRAMES, count - 1)
    is_read, _ = film.read()
    stated = film.get(cv2.CAP_PROP_FRAME_COUNT)
    film.release()
    return is_read and stated >= count


def _open_folder(folder: Path, most: int | None, white: White | None) -> Stream:
    """Open a folder of frames, whose rate nothing tells."""
    gaps: Counter[str] = Counter()
    files = picture_files(folder, frames=True)
    return Stream(folder.name, None, _read_frames(files[:most], gaps, white), gaps)


def _open_animation(path: Path, most: int | None, white: White | None) -> Stream:
    """Open an animation, whose rate is that of its first frame."""
    gaps: Counter[str] = Counter()
    shown = animation(path, white)
    first = next(shown)
    _, seconds = first
    return Stream(path.name, 1 / seconds, _animate(chain([first], shown), path.name, most, gaps), gaps)


def _open_recorder(source: "_Source", most: int | None, white: White | None) -> Stream:
    """Open a source that OpenCV reads."""
    name = source.name
    with needing("OpenCV", name, "opencv-python-headless", DataError):
        import cv2
    recorder = _recorder(cv2, source)
    if not recorder.isOpened():
        raise DataError(f"{name}: cannot be opened; check that {source.remedy}")
    gaps: Counter[str] = Counter()
    recording = _Recording(cv2, recorder, source, gaps, white)
    frames = recording.frames(most)
    first = next(frames)
    return Stream(name, recording.rate, chain([first], frames), gaps)


def _read_frames(files: Sequence[Path], gaps: Counter[str], white: White | None) -> Iterator[Picture]:
    """Read frames from files; one that cannot be read, or is not as large as the first, is skipped with a warning."""
    size: tuple[int, int] | None = None
    passed = FRAME
    for file in files:
        try:
            image = read_image(file, white=white)
            height, width = image.shape[-2:]
            size = size or (width, height)
            _check_frame_size(file, (width, height), size)
        except Exception as error:
            reason = error if isinstance(error, SemfovError) else f"{type(error).__name__}: {error}"
            warnings.warn(f"skipped {file.name}: {reason}", stacklevel=2)
            gaps["skipped"] += 1
            passed += FRAME
            continue
        yield Picture(file.name, image, passed=passed)
        passed = FRAME
    check_data(size is not None, "source", "a frame that can be read", f"{len(files)} that cannot")


def _check_frame_size(file: Path, size: tuple[int, int], first: tuple[int, int]) -> None:
    """Raise `DataError` for a frame of another size than the first one, `(width, height)` both."""
    expected = f"{first[0]} × {first[1]} px, the size of the first frame"
    remedy = "`semfov search`, `find` and `explore` take pictures of any size, each by itself"
    check_data(size == first, file.name, expected, f"{size[0]} × {size[1]}; {remedy}")


def _animate(
    shown: Iterator[tuple[Tensor, float]], name: str, most: int | None, gaps: Counter[str]
) -> Iterator[Picture]:
    """Read the frames of an animation, each after the seconds for which the last one is shown; damage ends them."""
    passed = FRAME
    try:
        for number, (image, seconds) in enumerate(islice(shown, most)):
            yield Picture(f"{name}, frame {number}", image, passed=passed)
            passed = seconds
    except DataError as error:
        warnings.warn(f"{name} ends with a frame that cannot be read: {error}", stacklevel=2)
        gaps["lost"] += 1


def _name(address: str) -> str:
    """Name a stream by its address without user, password and query; raises `InputError` where no stream has it."""
    kind, _, rest = address.partition("://")
    kinds = (*STREAMS, "http", "https")
    check(kind in kinds, "source", f"an address of a stream ({', '.join(kinds)})", f"{kind}://…")
    host, separator, path = rest.partition("/")
    return f"{kind}://{host.rpartition('@')[2]}{separator}{path.partition('?')[0]}"


class _Clock:
    """Time in a stream, by the time stamps of its frames in seconds, or by its rate where they do not increase.

    Attributes:
        frame: seconds between two frames by the rate.
        rounded: whether time stamps are rounded to milliseconds; those that fit the rate are taken to follow it.
        stamp: the last time stamp, infinite for none.
    """

    def __init__(self, frame: float, *, rounded: bool) -> None:
        self.frame = frame
        self.rounded = rounded
        self.stamp = math.inf

    @property
    def frames(self) -> int:
        """Number of frames up to the last time stamp, by the rate."""
        return round(self.stamp / self.frame) + 1 if math.isfinite(self.stamp) else 0

    def passed(self, stamp: float, lost: int) -> float:
        """Move on to a frame.

        Args:
            stamp: its time stamp in seconds.
            lost: how many frames before it could not be read.

        Returns:
            Seconds since the last frame.
        """
        seconds = stamp - self.stamp
        self.stamp = stamp
        if not 0 < seconds < math.inf:
            return (1 + lost) * self.frame
        by_rate = round(seconds / self.frame) * self.frame
        follows_rate = self.rounded and by_rate > 0 and abs(seconds - by_rate) <= _ROUNDING
        return by_rate if follows_rate else seconds


class _Recorder(Protocol):
    """What is used of `cv2.VideoCapture`."""

    def isOpened(self) -> bool: ...  # as OpenCV names it

    def open(self, source: str | int, *backend: int) -> bool: ...

    def read(self) -> tuple[bool, Values]: ...

    def get(self, key: int) -> float: ...

    def set(self, key: int, value: float) -> bool: ...

    def release(self) -> None: ...


class _Source(ABC):
    """A source that OpenCV reads.

    Attributes:
        name: for messages.
        remedy: what to check where it cannot be opened.
        container: of a file.
    """

    name: str
    remedy: ClassVar[str]
    container: Container = "other"

    @abstractmethod
    def recorder(self, cv2: ModuleType) -> _Recorder:
        """Make a reader of the source."""

    @abstractmethod
    def reopen(self, cv2: ModuleType, recorder: _Recorder) -> bool:
        """Open a reader again; returns whether the source is there."""

    def stamp(self, cv2: ModuleType, recorder: _Recorder) -> float:
        """Tell the time of the frame that was read, in seconds; OpenCV has it in milliseconds."""
        return float(recorder.get(cv2.CAP_PROP_POS_MSEC)) / 1000

    def frames_stated(self, count: float) -> int:
        """Tell how many frames there should be, by the count that OpenCV finds; 0 where it does not tell."""
        return 0


class _Film(_Source):
    """A file of a video."""

    remedy = "OpenCV reads videos of this format"

    def __init__(self, path: Path, container: Container = "other") -> None:
        self.path = path
        self.name = path.name
        self.container = container

    def recorder(self, cv2: ModuleType) -> _Recorder:
        # FFmpeg would take the beginning of some names for a protocol.
        return cv2.VideoCapture(str(self.path.absolute()))

    def reopen(self, cv2: ModuleType, recorder: _Recorder) -> bool:
        return False  # a file that has ended does not go on

    def frames_stated(self, count: float) -> int:
        return frames_stated(self.path, self.container, count)


class _Camera(_Source):
    """A camera of this machine, by its number."""

    remedy = "it is connected and not in use"

    def __init__(self, number: int) -> None:
        self.number = number
        self.name = f"camera {number}"

    def recorder(self, cv2: ModuleType) -> _Recorder:
        return cv2.VideoCapture(self.number)

    def reopen(self, cv2: ModuleType, recorder: _Recorder) -> bool:
        return recorder.open(self.number)

    def stamp(self, cv2: ModuleType, recorder: _Recorder) -> float:
        return time.monotonic()  # a frame is of the moment at which it is read


class _Address(_Source):
    """A stream on a network."""

    remedy = "address, user and password are right, and that this machine reaches the camera (ffplay shows it)"

    def __init__(self, address: str) -> None:
        self.address = address
        self.name = _name(address)

    def recorder(self, cv2: ModuleType) -> _Recorder:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _WAIT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _WAIT]
        return cv2.VideoCapture(self.address, cv2.CAP_FFMPEG, limits)

    def reopen(self, cv2: ModuleType, recorder: _Recorder) -> bool:
        return recorder.open(self.address, cv2.CAP_FFMPEG)


def _recorder(cv2: ModuleType, source: _Source) -> _Recorder:
    """Open OpenCV's reader of a source, without its messages: errors are raised by the caller."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        return source.recorder(cv2)
    finally:
        cv2.utils.logging.setLogLevel(level)


def _rgb(pixels: Values, white: White | None) -> Tensor:
    """Convert a frame of OpenCV, BGR or grey, to RGB bytes `(3, H, W)`."""
    if white is not None:
        pixels = bytes_between(pixels, black_and_white(white, pixels))
        if pixels.ndim == 2:
            pixels = np.repeat(pixels[..., None], 3, -1)
    return torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1)


class _Recording:
    """The frames of a source that OpenCV reads, through gaps and interruptions.

    Args:
        cv2: OpenCV.
        recorder: its reader of the source, which is open.
        source: a file, a camera, or an address.
        gaps: to which frames are added that were `lost`, and `reconnected`.
        white: the values of 16 bits that are black and white.

    Attributes:
        rate: frames a second; None where the source states none.

    Private attributes, all of the frames so far: `_read` counts those that were read, and `_gaps` those that were lost
    between them; `_missed` counts attempts since the last frame that gave none; `_waited` has the seconds for which a
    stream was away since then.

    Invariant: an attempt that gives no frame is counted by `_missed`, which the next frame moves to `_gaps["lost"]`;
    those that no frame follows are left out, as the number of frames that a file states tells what was lost at its end.
    """

    def __init__(
        self, cv2: ModuleType, recorder: _Recorder, source: _Source, gaps: Counter[str], white: White | None = None
    ) -> None:
        self._cv2 = cv2
        self._recorder = recorder
        self._source = source
        self._gaps = gaps
        self._white = white
        self._total = float(recorder.get(cv2.CAP_PROP_FRAME_COUNT))
        rate = float(recorder.get(cv2.CAP_PROP_FPS))
        self.rate = rate if 0 < rate < _FASTEST else None
        # An address may be that of a film, too, which states how long it is.
        self._is_file = isinstance(source, _Film) or 0 < self._total < _MOST_FRAMES
        # The time stamps of Matroska are whole milliseconds.
        is_rounded = source.container == "matroska"
        self._clock = _Clock(FRAME if self.rate is None else 1 / self.rate, rounded=is_rounded)
        self._read = 0
        self._missed = 0
        self._waited = 0.0

    def frames(self, most: int | None) -> Iterator[Picture]:
        """Read up to `most` frames, RGB bytes; what cannot be read is passed over, and what broke off opened again."""
        self._prepare()
        try:
            while self._read != most:
                is_there, pixels = self._recorder.read()
                if is_there:
                    yield self._picture(pixels)
                elif self._may_go_on():
                    self._missed += 1
                elif not self._read:
                    name = self._source.name
                    raise DataError(f"{name}: no frame could be read; check that the source is not damaged")
                elif not self._reconnect():
                    self._count_lost_end()
                    return
        finally:
            self._recorder.release()

    def _prepare(self) -> None:
        """Let a camera or a stream keep the newest frame alone, where it can, and give 16 bits as they are."""
        cv2 = self._cv2
        self._recorder.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        codes = {int(self._recorder.get(key)) for key in (cv2.CAP_PROP_CODEC_PIXEL_FORMAT, cv2.CAP_PROP_FOURCC)}
        if self._white is not None and codes & _SIXTEEN_BITS:
            self._recorder.set(cv2.CAP_PROP_CONVERT_RGB, 0)

    def _picture(self, pixels: Values) -> Picture:
        """Note a frame that was read, and date it by the clock of the stream."""
        self._gaps["lost"] += self._missed
        stamp = self._source.stamp(self._cv2, self._recorder)
        passed = min(self._clock.passed(stamp, self._missed) + self._waited, _LONGEST)
        name = f"{self._source.name}, frame {self._read + self._gaps['lost']}"
        picture = Picture(name, _rgb(pixels, self._white), passed=passed)
        self._read += 1
        self._missed = 0
        self._waited = 0.0
        return picture

    def _may_go_on(self) -> bool:
        """Tell whether a file has further frames by the number that it states."""
        is_before_end = self._read + self._gaps["lost"] + self._missed < self._total
        return self._is_file and self._missed < _MOST_ATTEMPTS and is_before_end

    def _reconnect(self) -> bool:
        """Open a camera or a stream again; returns whether it is there."""
        if self._is_file:
            return False
        began = time.monotonic()
        if not _reopened(self._cv2, self._recorder, self._source):
            return False
        self._prepare()
        self._gaps["reconnected"] += 1
        self._waited = time.monotonic() - began
        self._clock.stamp = math.inf
        return True

    def _count_lost_end(self) -> None:
        """Count the frames that a file states, and that were not there at its end."""
        stated = self._source.frames_stated(self._total)
        counted = self._read + self._gaps["lost"]
        if self._source.container == "avi":
            # AVI counts the frames that a film leaves out, too, over which its time stamps go.
            counted = max(counted, self._clock.frames)
        # The number of frames that a file states may be off by one.
        if stated - counted > 1:
            self._gaps["lost"] += stated - counted


def _reopened(cv2: ModuleType, recorder: _Recorder, source: _Source) -> bool:
    """Open a camera or a stream again, after pauses that grow; returns whether it is there."""
    recorder.release()
    for pause in _PAUSES:
        time.sleep(pause)
        probe = _recorder(cv2, source)
        if not probe.isOpened():
            continue
        probe.release()
        if source.reopen(cv2, recorder):
            return True
    return False
