"""Pictures to show the agent: photographs, folders of them, videos, a camera, or an embedded scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.data.images import read_image
from semfov.data.scenes import EmbeddedScenes
from semfov.errors import DataError, InputError
from semfov.io.files import check_regular

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".tif", ".tiff", ".gif")
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")


@dataclass(frozen=True)
class Picture:
    """A picture to look at.

    Attributes:
        name: what to call it, in print and in file names.
        image: `(3, H, W)`, RGB in [0, 1].
        boxes: `(M, 4)`, where the target really is; None where that is not known.
    """

    name: str
    image: Tensor
    boxes: Tensor | None = None


def open_pictures(source: Path) -> Iterator[Picture]:
    """Pictures from a photograph or a folder.

    Args:
        source: a file, or a folder whose photographs are taken in the order of their names.

    Raises:
        DataError: there is nothing to read.
    """
    if source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in PHOTOGRAPHS)
        if not files:
            raise DataError(f"photo: expected photographs ({', '.join(PHOTOGRAPHS)}) in {source}, found none")
        yield from (Picture(path.name, read_image(path)) for path in files)
    else:
        check_there(source)
        yield Picture(source.name, read_image(source))


def check_there(source: Path) -> None:
    """Raise `DataError` where there is no such file or folder."""
    if not source.exists():
        raise DataError(f"photo: no such file or folder: {source}; check the path")


def is_video(source: Path) -> bool:
    """Whether this is a video, by its name.

    >>> is_video(Path("holiday.MP4"))
    True
    """
    return source.suffix.lower() in VIDEOS and not source.is_dir()


def embedded_picture(classes: Sequence[str], target: str | None, seed: int, scenes: int = 16) -> Picture:
    """The first embedded scene that holds the target, or the first of all."""
    embedded = EmbeddedScenes(classes, count=scenes, seed=seed)
    for index in range(len(embedded)):
        names = [embedded.classes[label - 1] for label in embedded.targets(index)]
        if target is None or target in names:
            scene = embedded[index]
            chosen = scene.labels == (0 if target is None else embedded.classes.index(target) + 1)
            return Picture(scene.name, scene.image, None if target is None else scene.boxes[chosen])
    held = sorted({embedded.classes[label - 1] for index in range(len(embedded)) for label in embedded.targets(index)})
    raise InputError(f"target: the embedded scenes hold {', '.join(held)}; give a photograph to search for {target!r}")


@dataclass(frozen=True)
class Stream:
    """A video or a camera.

    Attributes:
        name: what to call it.
        rate: frames per second; None where it is not known.
        frames: one after the other, as they come.
    """

    name: str
    rate: float | None
    frames: Iterator[Picture]


def open_stream(source: Path | int, most: int | None = None) -> Stream:
    """Open a video by its file, or a camera by its number.

    Args:
        source: of the frames.
        most: how many frames to take; None takes all.

    Raises:
        DataError: it cannot be opened or has no frame, or OpenCV is not installed.
    """
    name = f"camera {source}" if isinstance(source, int) else source.name
    try:
        import cv2
    except ImportError:
        raise DataError(f"{name}: videos and cameras need OpenCV; pip install opencv-python-headless") from None
    if isinstance(source, Path):
        check_there(source)
        check_regular(source)
    level = cv2.utils.logging.getLogLevel()
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it is told below
    try:
        recorder = cv2.VideoCapture(source if isinstance(source, int) else str(source))
    finally:
        cv2.utils.logging.setLogLevel(level)
    if not recorder.isOpened():
        what = "is connected and free" if isinstance(source, int) else "is of a kind that OpenCV reads"
        raise DataError(f"{name}: cannot be opened; check that it {what}")
    rate = float(recorder.get(cv2.CAP_PROP_FPS))
    frames = _record(recorder, name, most)
    first = next(frames)
    return Stream(name, rate if 0 < rate < 1000 else None, chain([first], frames))


def _record(recorder: Any, name: str, most: int | None) -> Iterator[Picture]:
    """Frames as they come, RGB in [0, 1]."""
    try:
        for number in count():
            if number == most:
                return
            whole, pixels = recorder.read()
            if not whole:
                if not number:
                    raise DataError(f"{name}: no frame could be read; check that it is whole")
                return
            rgb = torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1)
            yield Picture(f"{name}, frame {number}", rgb.float() / 255)
    finally:
        recorder.release()
