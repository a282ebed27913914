"""What an eye asks of its sensor."""

from abc import ABC, abstractmethod
from typing import Any

import torch
from torch import Tensor, nn

from semfov.errors import check, check_finite, values_known


class Sensor(nn.Module, ABC):
    """Base of the sensors of an eye: what a canvas looks like when it is fixated at a point.

    A canvas is an image that was fitted into the detector's input. `open` does the work that does not depend on the
    fixation, once for each image; `look` shows the canvas from many fixations. What is shown may lie elsewhere than on
    the canvas, as that of a magnifying glass does: `boxes_to_canvas` then leads the detector's boxes back.
    """

    def __init__(self) -> None:
        super().__init__()
        # It goes where the module goes, and so tells its type where there is no parameter.
        self.register_buffer("_like", torch.empty(0), persistent=False)

    @property
    def like(self) -> Tensor:
        """An empty tensor of the type, and on the device, of the images that it takes."""
        return torch.as_tensor(self._like)

    @abstractmethod
    def open(self, canvas: Tensor, scale: Tensor) -> Any:
        """Hold a canvas: everything that does not depend on where it is fixated.

        Args:
            canvas: `(1, 3, H, W)`, RGB in [0, 1].
            scale: canvas pixels for each pixel of an image of the size that the sensor's settings are meant for,
                `(2,)`, along x and y.
        """

    @abstractmethod
    def look(self, state: Any, gaze: Tensor) -> Tensor:
        """What fixations show: `(F, 3, h, w)` for the detector.

        Args:
            state: of `open`.
            gaze: fixations `(F, 2)`, `(x, y)` in pixels of the canvas, inside or outside.
        """

    def boxes_to_canvas(self, state: Any, gaze: Tensor, boxes: Tensor) -> Tensor:
        """Boxes `(F, N, 4)` on what `look` showed, as boxes on the canvas: the same, unless the sensor moves pixels."""
        return boxes

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """What its views depend on, as JSON takes it, for the keys of caches and the metadata of fitted models."""


def fixations(gaze: Tensor, like: Tensor) -> tuple[Tensor, bool]:
    """Fixations `(B, G, 2)` of images `like` `(B, C, H, W)`, and whether there were several for each.

    Args:
        gaze: `(2,)` for all images, `(B, 2)` one for each, or `(B, G, 2)` G for each.
        like: whose type and device they take.

    Raises:
        InputError: a shape does not fit, or a fixation is not finite.
    """
    batch = like.shape[0]
    fits = 1 <= gaze.ndim <= 3 and gaze.shape[-1] == 2 and gaze.shape[0] == (2 if gaze.ndim == 1 else batch)
    check(fits, "gaze", f"a tensor of shape (2,), ({batch}, 2) or ({batch}, G, 2)", tuple(gaze.shape))
    if values_known(gaze):
        check_finite(gaze, "gaze")
    many = gaze.ndim == 3
    return (gaze.to(like) if many else gaze.to(like).expand(batch, 2)[:, None]), many
