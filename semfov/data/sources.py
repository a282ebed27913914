"""Pictures to show the agent: photographs, folders of them, videos, a camera, or an embedded scene."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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


def open_pictures(source: Path | None, camera: int | None, frames: int) -> Iterator[Picture]:
    """Pictures from a photograph, a folder or a video, or from a camera.

    Args:
        source: a file, or a folder whose photographs are taken in the order of their names.
        camera: number of a camera, in place of a source.
        frames: how many frames to take from a video, evenly spaced, or from a camera, one after another.

    Raises:
        InputError: neither or both are given, or the file is of an unknown kind.
        DataError: there is nothing to read.
    """
    if (source is None) == (camera is None):
        raise InputError("photo: expected a photograph, a folder, a video, or --camera, got both or none of them")
    if source is None:
        yield from _record(camera, f"camera {camera}", frames)
    elif source.is_dir():
        files = sorted(path for path in source.iterdir() if path.suffix.lower() in PHOTOGRAPHS)
        if not files:
            raise DataError(f"{source}: expected photographs ({', '.join(PHOTOGRAPHS)}), found none")
        yield from (Picture(path.name, read_image(path)) for path in files)
    elif not source.exists():
        raise DataError(f"{source}: no such file or folder")
    elif source.suffix.lower() in VIDEOS:
        check_regular(source)
        yield from _record(str(source), source.name, frames)
    else:
        yield Picture(source.name, read_image(source))


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


def _record(source: Any, name: str, frames: int) -> Iterator[Picture]:
    """Frames of a video or of a camera."""
    try:
        import cv2
    except ImportError:
        raise DataError(f"{name}: videos and cameras need OpenCV; pip install opencv-python-headless") from None
    recorder = cv2.VideoCapture(source)
    try:
        if not recorder.isOpened():
            raise DataError(f"{name}: cannot be opened; check that it is there and of a kind that OpenCV reads")
        count = int(recorder.get(cv2.CAP_PROP_FRAME_COUNT)) if isinstance(source, str) else 0
        wanted = [(2 * order + 1) * count // (2 * frames) for order in range(frames)] if count > 0 else range(frames)
        taken = 0
        for number in sorted(set(wanted)):
            if count > 0:
                recorder.set(cv2.CAP_PROP_POS_FRAMES, number)
            whole, pixels = recorder.read()
            if not whole:
                break
            taken += 1
            rgb = torch.from_numpy(pixels[..., ::-1].copy()).permute(2, 0, 1)
            yield Picture(f"{name}, frame {number}", rgb.float() / 255)
        if not taken:
            raise DataError(f"{name}: no frame could be read")
    finally:
        recorder.release()
