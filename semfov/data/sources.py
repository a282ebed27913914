"""Sources of pictures for the agent: photographs, folders, videos, cameras and embedded scenes."""

import math
import time
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from semfov.data.animations import animation
from semfov.data.containers import Container, container_of, frames_stated
from semfov.data.inputs import FRAME, STREAMS
from semfov.data.reading import read_image
from semfov.data.tone import White, black_and_white, bytes_between, check_white
from semfov.errors import DataError, SemfovError, check, check_data, needing, printable
from semfov.io.files import MADE_HERE

PHOTOGRAPHS = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".mpo", ".png", ".apng", ".webp", ".avif", ".avifs", ".heic", ".heif", ".hif"),
    *(".bmp", ".dib", ".tif", ".tiff", ".gif", ".jp2", ".j2k", ".jpc", ".jpf", ".jpx", ".j2c"),
    *(".ppm", ".pgm", ".pbm", ".pnm", ".pfm"),
)
"""Ends of the names of photographs."""

_HEAD = 4096  # bytes, in which the comment of a picture is
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")  # ends of the names of videos
_WAIT = 10_000  # milliseconds that a stream may take to open, or to give a frame
_PAUSES = (0.5, 1.0, 2.0, 4.0, 8.0)  # seconds between the attempts to open a stream again that broke off
_MOST_FRAMES = 1e9  # of a file; streams state numbers that mean nothing
_MOST_ATTEMPTS = 10_000  # to read a frame of a file; if none succeeds it has ended, whatever it states
_FASTEST = 1000  # frames per second
_LONGEST = 1e9  # seconds between two frames
_ROUNDING = 1e-3  # seconds by which differences of the time stamps of Matroska may be off

_WIDE = {int.from_bytes(code, "little") for code in (b"Y1\0\x10", b"Y16 ")}
"""Codes of frames of 16 bits, grey, of FFmpeg and of a camera."""


class Picture(NamedTuple):
    """A picture from a source; image `(3, H, W)`, boxes `(M, 4)`, and in a stream seconds since the last frame."""

    name: str
    image: Tensor
    boxes: Tensor | None = None
    passed: float = FRAME


def picture_files(source: Path, *, recursive: bool = False, frames: bool = False) -> list[Path]:
    """List a photograph, or those of a folder, or its `frames`, `recursive` of folders in it, in the order of names."""
    if not source.exists() and not source.is_symlink():  # a link to nothing is one that cannot be read
        raise DataError(f"picture: no such file or folder: {source}; check the path")
    if not source.is_dir():
        return [source]
    # Names that begin with a dot are notes of the system, such as the ._a.jpg of an Apple disk.
    within = source.rglob("*") if recursive else source.iterdir()
    seen = [path for path in within if not any(part.startswith(".") for part in path.relative_to(source).parts)]
    files = sorted(path for path in seen if path.suffix.lower() in PHOTOGRAPHS)
    files = _of_others(files, source) if recursive else files
    photographs(seen, str(source))
    mosaics = [path.name for path in source.iterdir() if path.suffix.lower() == ".vrt"]
    if mosaics:
        remedy = "as their files are there, too; name them to look at them"
        warnings.warn(f"{source}: {len(mosaics)} mosaics, such as {mosaics[0]!a}, are left out, {remedy}", stacklevel=2)
    if not files:
        where = ", or in a folder in it" if recursive else ", and recursive=True also searches the folders in it"
        what, where = ("source: expected frames", "") if frames else ("picture: expected photographs", where)
        raise DataError(f"{what} (.jpg, .png, .tif, …) in {source}{where}, got none")
    return files


def _of_others(files: Sequence[Path], source: Path) -> list[Path]:
    """Drop the figures and crops that semfov has written, with a warning."""
    own = [path for path in files if _made_here(path)]
    if own:
        what = f"{len(own)} pictures that semfov has written, such as {printable(str(own[0]))}, are left out"
        warnings.warn(f"{source}: {what}; name them, or their folder, to look at them", stacklevel=3)
    return [path for path in files if path not in own]


def _made_here(path: Path) -> bool:
    """Tell whether a picture has the comment of those that semfov writes."""
    try:
        with path.open("rb") as file:
            return path.is_file() and MADE_HERE.encode() in file.read(_HEAD)
    except OSError:
        return False  # it is skipped when it is opened


def photographs(paths: Sequence[Path], where: str) -> list[Path]:
    """The paths without the files whose names end as those of videos, texts and others, with a warning of these."""
    kinds = {"", ".vrt", *PHOTOGRAPHS}
    others = {path: None for path in paths if path.suffix.lower() not in kinds and path.is_file()}
    if others:
        count, such = len(others), printable(min(others).name)
        kept = "1 file is no photograph and is" if count == 1 else f"{count} files are no photographs and are"
        video = "; `semfov live` takes videos" if any(path.suffix.lower() in VIDEOS for path in others) else ""
        warnings.warn(f"{where}: {kept} left out, {'' if count == 1 else 'such as '}{such}{video}", stacklevel=3)
    return [path for path in paths if path not in others]


class Stream(NamedTuple):
    """A video or a camera; `gaps` counts frames that were `lost` or `skipped`, and how often it was `reconnected`."""

    name: str
    rate: float | None
    frames: Iterator[Picture]
    gaps: Mapping[str, int] = MappingProxyType({})


def open_stream(source: str | Path | int, most: int | None = None, white: White | None = None) -> Stream:
    """Open a video by its file, a folder of frames by name, a camera by its number, or a stream by its address."""
    check_white(white)
    address = isinstance(source, str) and "://" in source
    if not address and not isinstance(source, int):
        source = Path(source)
    name = f"camera {source}" if isinstance(source, int) else _name(str(source)) if address else Path(source).name
    if isinstance(source, Path) and source.is_dir():
        skips: Counter[str] = Counter()
        return Stream(name, None, _read_frames(picture_files(source, frames=True)[:most], skips, white), skips)
    container = container_of(source) if isinstance(source, Path) else "other"
    check_data(container != "playlist", name, "a video", "a playlist, which names other files; give these")
    gaps: Counter[str] = Counter()
    if isinstance(source, Path) and container == "animation":
        shown = animation(source, white)
        begun = next(shown)
        return Stream(name, 1 / begun[1], _animate(chain([begun], shown), name, most, gaps), gaps)
    with needing("OpenCV", name, "opencv-python-headless", DataError):
        import cv2
    recorder = _recorder(cv2, source)
    if not recorder.isOpened():
        what = "OpenCV reads videos of this format"
        if isinstance(source, int):
            what = "it is connected and not in use"
        elif address:
            what = "address, user and password are right, and that this machine reaches the camera (ffplay shows it)"
        raise DataError(f"{name}: cannot be opened; check that {what}")
    rate = float(recorder.get(cv2.CAP_PROP_FPS))
    frames = _record(cv2, recorder, source, name, most, gaps, white, container)
    first = next(frames)
    return Stream(name, rate if 0 < rate < _FASTEST else None, chain([first], frames), gaps)


def _read_frames(files: Sequence[Path], gaps: Counter[str], white: White | None) -> Iterator[Picture]:
    """Frames of files; one that cannot be read, or is not as large as the first, is skipped with a warning."""
    size, passed = None, FRAME
    for file in files:
        try:
            image = read_image(file, white=white)
            size = size or image.shape[-2:]
            first, here = (f"{width} × {height}" for height, width in (size, image.shape[-2:]))
            remedy = "`semfov search`, `find` and `explore` take pictures of any size, each by itself"
            check_data(first == here, file.name, f"{first} px, the size of the first frame", f"{here}; {remedy}")
        except Exception as error:
            reason = error if isinstance(error, SemfovError) else f"{type(error).__name__}: {error}"
            warnings.warn(f"skipped {file.name}: {reason}", stacklevel=2)
            gaps["skipped"] += 1
            passed += FRAME
            continue
        yield Picture(file.name, image, passed=passed)
        passed = FRAME
    check_data(size is not None, "source", "a frame that can be read", f"{len(files)} that cannot")


def _animate(
    shown: Iterator[tuple[Tensor, float]], name: str, most: int | None, gaps: Counter[str]
) -> Iterator[Picture]:
    """Frames of an animation, each after the seconds for which the one before is shown; a damaged one ends it."""
    passed = FRAME
    try:
        for number, (image, seconds) in enumerate(islice(shown, most)):
            yield Picture(f"{name}, frame {number}", image, passed=passed)
            passed = seconds
    except DataError as error:
        warnings.warn(f"{name} ends with a frame that cannot be read: {error}", stacklevel=2)
        gaps["lost"] += 1


def _name(address: str) -> str:
    """An address without user, password and query; raises `InputError` where no stream has it."""
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
        self.frame, self.rounded, self.stamp = frame, rounded, math.inf

    @property
    def frames(self) -> int:
        """Number of frames up to the last time stamp, by the rate."""
        return round(self.stamp / self.frame) + 1 if math.isfinite(self.stamp) else 0

    def passed(self, stamp: float, lost: int) -> float:
        """Seconds since the last frame, at the time stamp of one before which some were lost."""
        seconds, self.stamp = stamp - self.stamp, stamp
        if not 0 < seconds < math.inf:
            return (1 + lost) * self.frame
        by_rate = round(seconds / self.frame) * self.frame
        return by_rate if self.rounded and by_rate and abs(seconds - by_rate) <= _ROUNDING else seconds


def _recorder(cv2: Any, source: str | Path | int) -> Any:
    """OpenCV's reader of a source."""
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors are raised by the caller
    try:
        if isinstance(source, Path):
            return cv2.VideoCapture(str(source))
        if isinstance(source, int):
            return cv2.VideoCapture(source)
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _WAIT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _WAIT]
        return cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
    finally:
        cv2.utils.logging.setLogLevel(level)


def _prepare(cv2: Any, recorder: Any, white: White | None) -> None:
    """Let a camera or a stream keep the newest frame alone, where it can, and with `white` give 16 bits as they are."""
    recorder.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    codes = {int(recorder.get(key)) for key in (cv2.CAP_PROP_CODEC_PIXEL_FORMAT, cv2.CAP_PROP_FOURCC)}
    if white is not None and codes & _WIDE:
        recorder.set(cv2.CAP_PROP_CONVERT_RGB, 0)


def _rgb(pixels: NDArray[Any], white: White | None) -> Tensor:
    """A frame of OpenCV as RGB bytes `(3, H, W)`."""
    if white is not None:
        pixels = bytes_between(pixels, black_and_white(white, pixels))
        pixels = np.repeat(pixels[..., None], 3, -1) if pixels.ndim == 2 else pixels
    return torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1)


def _record(
    cv2: Any,
    recorder: Any,
    source: str | Path | int,
    name: str,
    most: int | None,
    gaps: Counter[str],
    white: White | None = None,
    container: Container = "other",
) -> Iterator[Picture]:
    """Frames of a stream, RGB bytes; it goes on after frames that cannot be read, and opens what broke off again."""
    total, rate = (float(recorder.get(key)) for key in (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS))
    is_file = isinstance(source, Path) or 0 < total < _MOST_FRAMES
    clock = _Clock(1 / rate if 0 < rate < _FASTEST else FRAME, rounded=container == "matroska")
    read, missed, waited = 0, 0, 0.0
    _prepare(cv2, recorder, white)
    try:
        while read != most:
            there, pixels = recorder.read()
            if there:
                gaps["lost"] += missed
                is_camera = isinstance(source, int)
                stamp = time.monotonic() if is_camera else float(recorder.get(cv2.CAP_PROP_POS_MSEC)) / 1000
                passed = min(clock.passed(stamp, missed) + waited, _LONGEST)
                yield Picture(f"{name}, frame {read + gaps['lost']}", _rgb(pixels, white), passed=passed)
                read, missed, waited = read + 1, 0, 0.0
                continue
            if is_file and missed < _MOST_ATTEMPTS and read + gaps["lost"] + missed < total:
                missed += 1
                continue
            if not read:
                raise DataError(f"{name}: no frame could be read; check that the source is not damaged")
            began = time.monotonic()
            if is_file or isinstance(source, Path) or not _reopened(cv2, recorder, source):
                stated = frames_stated(source, container, total) if isinstance(source, Path) else 0
                # AVI counts the frames that a film leaves out, too, over which its time stamps go.
                seen = max(read + gaps["lost"], clock.frames if container == "avi" else 0)
                # The number of frames that a file states may be off by one.
                gaps["lost"] += stated - seen if stated - seen > 1 else 0
                return
            _prepare(cv2, recorder, white)
            gaps["reconnected"] += 1
            waited, clock.stamp = time.monotonic() - began, math.inf
    finally:
        recorder.release()


def _reopened(cv2: Any, recorder: Any, source: str | int) -> bool:
    """Open a camera or a stream again, after pauses that grow; returns whether it is there."""
    recorder.release()
    for pause in _PAUSES:
        time.sleep(pause)
        again = _recorder(cv2, source)
        if again.isOpened():
            again.release()
            if recorder.open(source) if isinstance(source, int) else recorder.open(source, cv2.CAP_FFMPEG):
                return True
    return False
