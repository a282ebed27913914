"""Foveation at random positions, as a Kornia augmentation."""

from math import inf
from typing import Any, get_args

import torch
from kornia.augmentation import IntensityAugmentationBase2D
from kornia.augmentation.random_generator import PlainUniformGenerator
from torch import Tensor

from semfov.errors import check, lookup
from semfov.sensor.foveation import foveate
from semfov.sensor.pyramid import Convention


class RandomFoveation(IntensityAugmentationBase2D):
    r"""Foveate every image of a batch around a random position, with a fovea of random width.

    .. math:: x_0 \sim U[-\tfrac12, W - \tfrac12], \quad y_0 \sim U[-\tfrac12, H - \tfrac12], \quad
              \sigma \sim U[\sigma_{min}, \sigma_{max}]

    and then `semfov.foveate`. (The distributions are ours.) It trains a network for views that are sharp at any
    position. No pixel moves, so boxes, masks and keypoints stay as they are. `p`, `same_on_batch` and `keepdim` work
    as in Kornia's other augmentations, and random numbers come from torch's global generator.

    `_params` holds the random numbers of the last call: `gaze`, `(B, 2)`, fixations `(x, y)` in image pixels, and
    `sigma`, `(B,)`, in pixels. Passed as `params`, they give the same views again. Views are differentiable in the
    image and, where you pass `params` yourself, in the fixations and widths.

    Args:
        sigma: width σ of the fovea in image pixels, or its smallest and largest value.
        levels: number of bands of the pyramid.
        growth: factor by which the window of each coarser band is wider.
        convention: convention of the pyramid, `kornia` or `opencv`.
        same_on_batch: draw one fixation and one width for all images of a batch.
        p: probability that an image is foveated; the other images are returned unchanged.
        keepdim: return an image `(C, H, W)` in this shape, without a batch dimension.

    Shape:
        `(C, H, W)` or `(B, C, H, W)`, floating-point; the result is `(B, C, H, W)`.

    Raises:
        InputError: a setting is out of its range.

    >>> augment = RandomFoveation((20.0, 60.0), p=1.0)
    >>> image = torch.rand(2, 3, 48, 64)
    >>> view = augment(image)
    >>> augment._params["gaze"].shape, augment._params["sigma"].shape
    (torch.Size([2, 2]), torch.Size([2]))
    >>> torch.equal(augment(image, params=augment._params), view)
    True

    Together with another augmentation, and with boxes:

    >>> from kornia.augmentation import AugmentationSequential, RandomHorizontalFlip
    >>> both = AugmentationSequential(RandomHorizontalFlip(), RandomFoveation(30.0), data_keys=["input", "bbox_xyxy"])
    >>> view, boxes = both(image, torch.tensor([[[4.0, 8.0, 20.0, 30.0]]] * 2))
    """

    def __init__(
        self,
        sigma: float | tuple[float, float],
        levels: int = 5,
        growth: float = 2.0,
        convention: Convention = "kornia",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        super().__init__(p=p, same_on_batch=same_on_batch, keepdim=keepdim)
        narrowest, widest = sigma if isinstance(sigma, tuple | list) else (sigma, sigma)
        in_order = 0 < narrowest <= widest < inf
        check(in_order, "sigma", "a positive number, or the smallest and the largest one", sigma)
        check(levels >= 0, "levels", "0 or more", levels)
        check(growth > 0, "growth", "a positive number", growth)
        check(0 <= p <= 1, "p", "a probability from 0 to 1", p)
        lookup(convention, get_args(Convention), "pyramid convention")
        widths = (float(narrowest), float(widest))
        side = (0.0, 1.0)  # of an image
        self._param_generator = _Fixations(
            (widths, "sigma", None, None), (side, "x", None, None), (side, "y", None, None)
        )
        self.flags = {"levels": levels, "growth": growth, "convention": convention}

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Foveate a batch around the fixations that were drawn.

        Args:
            input: images `(B, C, H, W)`.
            params: `gaze`, `(B, 2)`, and `sigma`, `(B,)`, in pixels.
            flags: `levels`, `growth` and `convention`.
            transform: unused; Kornia passes it to every augmentation.

        Returns:
            Foveated images `(B, C, H, W)`.
        """
        # Kornia's containers add further flags.
        settings = {name: flags[name] for name in ("levels", "growth", "convention")}
        return foveate(input, params["gaze"], sigma=params["sigma"], **settings)


class _Fixations(PlainUniformGenerator):
    """Random fixations, uniform over an image, and random widths."""

    def __repr__(self) -> str:
        return f"sigma={self.samplers[0][0]}"

    def forward(self, batch_shape: tuple[int, ...], same_on_batch: bool = False) -> dict[str, Tensor]:
        """Draw `gaze`, `(B, 2)`, and `sigma`, `(B,)`, for images `(B, C, H, W)`."""
        numbers = super().forward(batch_shape, same_on_batch)
        # A pixel is an area around integer coordinates.
        x = numbers["x"] * batch_shape[-1] - 0.5
        y = numbers["y"] * batch_shape[-2] - 0.5
        return {"sigma": numbers["sigma"], "gaze": torch.stack([x, y], -1)}
