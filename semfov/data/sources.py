"""Sources of pictures for the agent: photographs, folders, videos, cameras and embedded scenes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from semfov.data.inputs import STREAMS
from semfov.data.scenes import EmbeddedScenes
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular

PHOTOGRAPHS = (
    *(".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".webp", ".avif", ".heic", ".heif", ".bmp", ".dib", ".tif", ".tiff"),
    *(".gif", ".jp2", ".j2k", ".jpx", ".ppm", ".pgm", ".pnm"),
)
_WAIT = 10_000  # milliseconds that a stream may take to open, or to give a frame

_PLAYLIST = b"#EXTM3U"
_VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


class Picture(NamedTuple):
    """A picture from a source; image `(3, H, W)`, boxes `(M, 4)`."""

    name: str
    image: Tensor
    boxes: Tensor | None = None


def picture_files(source: Path, *, recursive: bool = False) -> list[Path]:
    """List a photograph, or the photographs of a folder, of `recursive` also of those in it, in the order of names."""
    _check_there(source)
    if not source.is_dir():
        return [source]
    # Names that begin with a dot are notes of the system, such as the ._a.jpg of an Apple disk.
    files = sorted(
        path
        for path in (source.rglob("*") if recursive else source.iterdir())
        if path.suffix.lower() in PHOTOGRAPHS
        and not any(part.startswith(".") for part in path.relative_to(source).parts)
    )
    if not files:
        where = "or in a folder in it" if recursive else "and recursive=True also searches the folders in it"
        expected = f"photographs ({', '.join(PHOTOGRAPHS)}) in {source}, {where}"
        raise DataError(f"picture: expected {expected}, got none")
    return files


def _check_there(source: Path) -> None:
    """Raise `DataError` where a file or folder does not exist."""
    if not source.exists():
        raise DataError(f"picture: no such file or folder: {source}; check the path")


def is_video(source: Path) -> bool:
    """Tell by its name whether a file is a video."""
    return source.suffix.lower() in _VIDEOS and not source.is_dir()


def embedded_picture(classes: Sequence[str], target: str | None, seed: int, scenes: int = 16) -> Picture:
    """Compose the first embedded scene that holds a target."""
    embedded = EmbeddedScenes(classes, count=scenes, seed=seed)
    for index in range(len(embedded)):
        names = [embedded.classes[label - 1] for label in embedded.targets(index)]
        if target is None or target in names:
            scene = embedded[index]
            chosen = scene.labels == (0 if target is None else embedded.classes.index(target) + 1)
            return Picture(scene.name, scene.image, None if target is None else scene.boxes[chosen])
    held = sorted({embedded.classes[label - 1] for index in range(len(embedded)) for label in embedded.targets(index)})
    raise InputError(
        f"target: expected a class in the embedded scenes ({', '.join(held)}), got {target!r}; "
        f"give a photograph to search for it"
    )


class Stream(NamedTuple):
    """A video or a camera."""

    name: str
    rate: float | None
    frames: Iterator[Picture]


def open_stream(source: str | Path | int, most: int | None = None) -> Stream:
    """Open a video by its file, a camera by its number, or a stream by its address."""
    address = isinstance(source, str) and "://" in source
    if not address and not isinstance(source, int):
        source = Path(source)
    name = f"camera {source}" if isinstance(source, int) else _name(str(source)) if address else Path(source).name
    try:
        import cv2
    except ImportError:
        raise DataError(
            f"{name}: expected OpenCV for videos, cameras and streams; pip install opencv-python-headless"
        ) from None
    if isinstance(source, Path):
        _check_there(source)
        check_regular(source)
        with suppress(OSError), source.open("rb") as file:
            if file.read(len(_PLAYLIST)) == _PLAYLIST:
                raise DataError(f"{name}: expected a video, got a playlist, which names other files; give these")
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # errors are raised below
    try:
        recorder = _recorder(cv2, source)
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not recorder.isOpened():
        what = "OpenCV reads videos of this format"
        if isinstance(source, int):
            what = "it is connected and not in use"
        elif address:
            what = "address, user and password are right, and that this machine reaches the camera (ffplay shows it)"
        raise DataError(f"{name}: cannot be opened; check that {what}")
    rate = float(recorder.get(cv2.CAP_PROP_FPS))
    frames = _record(recorder, name, most)
    first = next(frames)
    return Stream(name, rate if 0 < rate < 1000 else None, chain([first], frames))


def _name(address: str) -> str:
    """An address without user, password and query; raises `InputError` where no stream has it."""
    kind, _, rest = address.partition("://")
    kinds = (*STREAMS, "http", "https")
    if kind not in kinds:
        raise InputError(f"source: expected an address of a stream ({', '.join(kinds)}), got {kind}://…")
    host, separator, path = rest.partition("/")
    return f"{kind}://{host.rpartition('@')[2]}{separator}{path.partition('?')[0]}"


def _recorder(cv2: Any, source: str | Path | int) -> Any:
    """OpenCV's reader of a source. Of a camera or a stream it keeps the newest frame alone, where it can."""
    if isinstance(source, Path):
        return cv2.VideoCapture(str(source))
    if isinstance(source, int):
        recorder = cv2.VideoCapture(source)
    else:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _WAIT, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _WAIT]
        recorder = cv2.VideoCapture(source, cv2.CAP_FFMPEG, limits)
    recorder.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return recorder


def _record(recorder: Any, name: str, most: int | None) -> Iterator[Picture]:
    """Frames of a stream, RGB bytes."""
    try:
        for number in count():
            if number == most:
                return
            whole, pixels = recorder.read()
            if not whole:
                if not number:
                    raise DataError(f"{name}: no frame could be read; check that the source is not damaged")
                return
            yield Picture(f"{name}, frame {number}", torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1))
    finally:
        recorder.release()
