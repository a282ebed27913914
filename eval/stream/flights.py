"""Frames of a camera that moves: virtual flights over large pictures, and films whose frames have boxes."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from eval.stream.pasted import PastedObjects
from semfov.data.reading import read_image
from semfov.data.scene import Annotation, Scene, Scenes
from semfov.errors import check, check_data, needing
from semfov.io.files import read_text
from semfov.motion import Motion
from semfov.observation.matching import inside_frame

CourseName = Literal["still", "slow", "usual", "fast", "turning", "shaking", "moving", "moving-slow"]


class Frame(NamedTuple):
    """A frame of a stream.

    Attributes:
        pixels: `(h, w, 3)` bytes.
        annotation: its objects.
        pose: the map from the scene to it; None where that is not known.
        identities: `(N,)`, numbers of the objects that stay from frame to frame; None where they are not known.
        moving: `(N,)` boolean, the objects that move on their own; None where that is not known.
    """

    pixels: NDArray[np.uint8]
    annotation: Annotation
    pose: Motion | None = None
    identities: torch.Tensor | None = None
    moving: torch.Tensor | None = None


@dataclass(frozen=True)
class Course:
    """How a camera moves, and what moves before it.

    Attributes:
        speed: pixels a frame.
        turn: degrees a frame.
        zoom: share of the scale a frame.
        shake: standard deviation of the shake in pixels.
        pasted: number of objects that are pasted into the picture and move on their own.
    """

    speed: float = 0.0
    turn: float = 0.0
    zoom: float = 0.0
    shake: float = 0.0
    pasted: int = 0

    def describe(self) -> str:
        """Describe the course in a few words, as `12 px a frame, turning, zooming`."""
        words = [f"{self.speed:g} px a frame" if self.speed else "still"]
        words += ["turning"] * (self.turn > 0) + ["zooming"] * (self.zoom > 0)
        if self.shake:
            words.append(f"a shake of {self.shake:g} px")
        if self.pasted:
            words.append(f"{self.pasted} objects more that move")
        return ", ".join(words)


COURSES: dict[CourseName, Course] = {
    "still": Course(),
    "slow": Course(speed=4),
    "usual": Course(speed=12),
    "fast": Course(speed=30),
    "turning": Course(speed=12, turn=0.4, zoom=0.004),
    "shaking": Course(speed=4, shake=3),
    "moving": Course(pasted=24),
    "moving-slow": Course(speed=4, pasted=24),
}


def poses(course: Course, picture: tuple[int, int], frame: tuple[int, int], count: int, seed: int) -> Iterator[Motion]:
    """Yield the maps from a picture to the frames of a flight, both of sizes `(width, height)`.

    The camera flies in a straight line in a random direction, and bounces where the frame would leave the picture. It
    zooms for half of the frames, and back for the others.
    """
    random = np.random.default_rng(seed)
    middle = np.array(frame) / 2
    low, high = middle, np.array(picture) - middle
    direction = random.uniform(0, 2 * np.pi)
    step = course.speed * np.array([np.cos(direction), np.sin(direction)])
    centre = random.uniform(low, high)
    spin, growth = random.choice([-1, 1], 2)
    for number in range(count):
        beyond = (centre + step < low) | (centre + step > high)
        step = np.where(beyond, -step, step)
        centre = centre + step
        seen = centre + random.normal(0, course.shake, 2)
        turned = Motion.similarity(
            turn=spin * course.turn * number,
            scale=(1 + course.zoom) ** (growth * min(number, count - number)),
        )
        yield _shifted(-seen).then(turned).then(_shifted(middle))


def flight(scene: Scene, course: Course, frame: tuple[int, int], count: int, seed: int) -> Iterator[Frame]:
    """Yield the frames of a flight over a picture; objects are in a frame if their centres are."""
    fits = scene.size[0] >= frame[0] and scene.size[1] >= frame[1]
    check(fits, "frame", f"no longer than the picture {scene.name}, {scene.size[0]} × {scene.size[1]}", frame)
    with needing("OpenCV", "flights over pictures", "opencv-python-headless"):
        import cv2
    pixels = _as_bytes(scene)
    pasted = PastedObjects(scene, pixels, course.pasted, seed)
    labels = torch.cat([scene.labels, pasted.labels])
    moves = torch.arange(len(labels)) >= len(scene.labels)
    for pose in poses(course, scene.size, frame, count, seed):
        pasted.step()
        seen = cv2.warpAffine(pasted.picture(), pose.matrix[:2], frame, flags=cv2.INTER_LINEAR)
        boxes = pose.boxes(torch.cat([scene.boxes.double(), pasted.boxes()]))
        there = inside_frame(boxes, frame)
        cut = within(boxes[there].float(), frame)
        annotation = Annotation(cut, labels[there], torch.zeros(len(cut), dtype=torch.bool), frame)
        yield Frame(np.asarray(seen, np.uint8), annotation, pose, there.nonzero()[:, 0], moves[there])


def film(scenes: Scenes) -> Iterator[Frame]:
    """Yield the pictures of a set as the frames of a film."""
    for index in range(len(scenes)):
        yield Frame(_as_bytes(scenes[index]), scenes.annotation(index))


def mot_film(folder: Path, label: int) -> Iterator[Frame]:
    """Yield the frames of a folder in the form of MOTChallenge: pictures in `img1`, boxes of people in `gt/gt.txt`.

    Boxes of other classes, and those that are not to be counted, are crowds: what is found in them is left out.
    """
    names = sorted(path for path in (folder / "img1").glob("*") if path.suffix.lower() in (".jpg", ".png"))
    check_data(bool(names), f"film {folder}", "pictures in img1", "none")
    lines = read_text(folder / "gt" / "gt.txt").split()
    rows = np.array([[float(value) for value in line.split(",")] for line in lines])
    for number, name in enumerate(names, 1):
        x, y, wide, high, counts, kind = rows[rows[:, 0] == number, 2:8].T
        boxes = torch.tensor(np.stack([x - 1, y - 1, x - 1 + wide, y - 1 + high], -1), dtype=torch.float32)
        crowd = torch.from_numpy((counts == 0) | (kind != 1))
        pixels = read_image(name)
        size = pixels.shape[2], pixels.shape[1]
        annotation = Annotation(within(boxes, size), torch.full((len(boxes),), label), crowd, size)
        yield Frame(_bytes_of(pixels), annotation)


def within(boxes: torch.Tensor, frame: tuple[int, int]) -> torch.Tensor:
    """Boxes `(..., 4)` cut at the borders of a frame of `(width, height)`."""
    return boxes.clamp(min=0).minimum(boxes.new_tensor(frame * 2))


def _shifted(by: NDArray[np.float64]) -> Motion:
    return Motion.similarity(shift=(float(by[0]), float(by[1])))


def _as_bytes(scene: Scene) -> NDArray[np.uint8]:
    return _bytes_of(scene.image)


def _bytes_of(image: torch.Tensor) -> NDArray[np.uint8]:
    """Bytes `(h, w, 3)` of an image `(3, h, w)` in [0, 1]."""
    return np.ascontiguousarray((image * 255).round().byte().permute(1, 2, 0).numpy())
