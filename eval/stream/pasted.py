"""Objects that move on their own: cut-outs of a picture's objects, pasted into it at places that move."""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from semfov.data.scene import Scene

_SPEEDS = 3.0, 10.0  # pixels a frame
_MARGIN = 0.15  # share of a side that is cut out around an object
_SMALLEST = 24  # shorter side in pixels of the objects that are cut out


class _CutOut(NamedTuple):
    """An object with its surroundings.

    Attributes:
        pixels: `(h, w, 3)` bytes.
        cover: `(h, w, 1)`, how much it covers, from 0 at its border to 1.
        box: `(x1, y1, x2, y2)` of the object in these pixels.
        label: its class.
    """

    pixels: NDArray[np.uint8]
    cover: NDArray[np.float32]
    box: NDArray[np.float64]
    label: int


class PastedObjects:
    """Objects of a picture that move in straight lines over it, by 3 to 10 pixels a frame, and bounce at its borders.

    Args:
        scene: the picture, whose objects are cut out, in turn.
        pixels: `(H, W, 3)` bytes of the picture.
        count: number of objects.
        seed: random seed of their places and directions.
    """

    def __init__(self, scene: Scene, pixels: NDArray[np.uint8], count: int, seed: int) -> None:
        random = np.random.default_rng((seed, 1))
        self._pixels = pixels
        sides = (scene.boxes[:, 2:] - scene.boxes[:, :2]).amin(-1)
        clear = (sides >= _SMALLEST).nonzero()[:, 0].tolist()
        cut_outs = [_cut_out(pixels, scene.boxes[n].double().numpy(), int(scene.labels[n])) for n in clear]
        self._cut_outs = [cut_outs[n % len(cut_outs)] for n in range(count)] if cut_outs else []
        count = len(self._cut_outs)
        sizes = np.array([each.pixels.shape[1::-1] for each in self._cut_outs]).reshape(count, 2)
        self._room = np.array(scene.size) - sizes
        self._places = random.uniform(0, 1, (count, 2)) * self._room
        direction = random.uniform(0, 2 * np.pi, count)
        speed = random.uniform(*_SPEEDS, count)
        self._steps = speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], -1)

    def step(self) -> None:
        """Move all objects to their places in the next frame."""
        beyond = (self._places + self._steps < 0) | (self._places + self._steps > self._room)
        self._steps = np.where(beyond, -self._steps, self._steps)
        self._places = self._places + self._steps

    @property
    def labels(self) -> torch.Tensor:
        """Classes of the objects, `(N,)`."""
        return torch.tensor([each.label for each in self._cut_outs], dtype=torch.long)

    def boxes(self) -> torch.Tensor:
        """Boxes of the objects in the picture, `(N, 4)`."""
        corners = self._corners()
        boxes = [each.box + np.tile(corner, 2) for each, corner in zip(self._cut_outs, corners, strict=True)]
        return torch.from_numpy(np.array(boxes, dtype=np.float64).reshape(-1, 4))

    def picture(self) -> NDArray[np.uint8]:
        """Paste the objects into a copy of the picture; later ones cover those before."""
        if not self._cut_outs:
            return self._pixels
        picture = self._pixels.copy()
        for each, (x, y) in zip(self._cut_outs, self._corners(), strict=True):
            high, wide = each.cover.shape[:2]
            under = picture[y : y + high, x : x + wide]
            under[:] = np.rint(each.cover * each.pixels + (1 - each.cover) * under)
        return picture

    def _corners(self) -> NDArray[np.int64]:
        """Upper left corners of the cut-outs, `(N, 2)`, whole pixels."""
        return np.rint(self._places).astype(np.int64)


def _cut_out(pixels: NDArray[np.uint8], box: NDArray[np.float64], label: int) -> _CutOut:
    """Cut an object out with a margin, in which it fades."""
    height, width = pixels.shape[:2]
    low, high = box[:2], box[2:]
    margin = np.maximum(_MARGIN * (high - low), 4)
    x1, y1 = np.floor(np.maximum(low - margin, 0)).astype(int)
    x2, y2 = np.ceil(np.minimum(high + margin, (width, height))).astype(int)
    across, down = _fading(x2 - x1, margin[0]), _fading(y2 - y1, margin[1])
    cover = np.outer(down, across).astype(np.float32)[..., None]
    return _CutOut(pixels[y1:y2, x1:x2].copy(), cover, box - np.array([x1, y1, x1, y1]), label)


def _fading(length: int, margin: float) -> NDArray[np.float64]:
    """Rise from 0 to 1 within a margin at both ends of a line of pixels."""
    place = np.arange(length) + 0.5
    return np.minimum(np.minimum(place, length - place) / margin, 1)
