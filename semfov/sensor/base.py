"""The interface of the sensors of an eye."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, Self, TypeGuard

import numpy as np
import torch
from torch import Tensor

from semfov.data.inputs import ImageLike, as_positions
from semfov.errors import check, check_finite, check_tensor, values_known
from semfov.io.compatibility import Settings
from semfov.io.state import StatedModule
from semfov.sensor.pyramid import Bands


class Sensor(StatedModule, ABC):
    """Base of the sensors of an eye: they compute the view of a canvas for a fixation.

    A canvas is an image that was resized and padded to the detector's input. `open` does the work that does not depend
    on the fixation, once for each image. `look` computes the views for many fixations. Where a sensor moves pixels, as
    a magnifying glass does, `boxes_to_canvas` maps the boxes that the detector found in a view back to the canvas.

    A sensor may show several crops in a look, as `MultiScaleFovea` does. It then says how many `crops` there are, and
    `picture` composes them into one picture. One that reads the picture at another resolution than the detector's input
    gives the `canvas_size`.

    A sensor that commands can select by name (`semfov.sensor.SENSORS`) also has a `kind` and the `names` of its
    settings, from which it can be made again. If its acuity falls off from a fovea, it tells the `width` of that.

    Attributes:
        kind: kind of sensor, which `settings` lists as `kind` (of all but `Foveation`).
        names: names of the settings, each of them an argument of the class.
        crops: number of views of a fixation, each of which the detector sees as a picture of its own.

    >>> class Half(Sensor):
    ...     def open(self, canvas, scale):
    ...         return canvas
    ...
    ...     def look(self, state, gaze):
    ...         return 0.5 * state.expand(len(gaze), -1, -1, -1)
    ...
    ...     def settings(self):
    ...         return {"kind": "half"}
    >>> sensor = Half()
    >>> state = sensor.open(torch.ones(1, 3, 8, 8), torch.ones(2))
    >>> sensor.look(state, torch.tensor([[2.0, 3.0], [5.0, 6.0]])).shape
    torch.Size([2, 3, 8, 8])
    """

    kind: ClassVar[str] = "sensor"
    names: ClassVar[tuple[str, ...]] = ()
    crops: int = 1

    def __init__(self) -> None:
        super().__init__()
        # The buffer follows the module to its device and type, also where the module has no parameter.
        self.register_buffer("_like", torch.empty(0), persistent=False)

    @property
    def like(self) -> Tensor:
        """An empty tensor with the type and the device of the images that the sensor takes."""
        return torch.as_tensor(self._like)

    @abstractmethod
    def open(self, canvas: Tensor, scale: Tensor) -> Any:
        """Prepare a canvas: compute everything that does not depend on the fixation.

        Args:
            canvas: `(1, 3, H, W)`, RGB in [0, 1].
            scale: canvas pixels for each pixel of an image of the size that the sensor's settings are meant for,
                `(2,)`, along x and y.

        Returns:
            The prepared canvas, in any form that `look` understands.
        """

    @abstractmethod
    def look(self, state: Any, gaze: Tensor) -> Tensor:
        """Compute the views of a canvas for fixations.

        Args:
            state: the canvas as `open` prepared it.
            gaze: fixations `(F, 2)`, `(x, y)` in pixels of the canvas, inside or outside.

        Returns:
            Views `(F, 3, h, w)` for the detector; `(F·L, 3, h, w)` of a sensor with L crops, those of a fixation
            together, the finest first.
        """

    def canvas_size(self, size: tuple[int, int], reference: float) -> tuple[int, int] | None:
        """Return the size of the canvas for the sensor.

        Args:
            size: `(width, height)` of the picture.
            reference: longer side of the image that the sensor's settings are for.

        Returns:
            `(width, height)`, to which the picture is stretched; None for the detector's input.
        """
        return None

    def picture(self, state: Any, gaze: Tensor) -> Tensor:
        """Compute the views as pictures of the canvas, for figures, saliency and environments.

        Args:
            state: the canvas as `open` prepared it.
            gaze: fixations `(F, 2)`.

        Returns:
            `(F, 3, H, W)`.
        """
        return self.look(state, gaze)

    def boxes_to_canvas(self, state: Any, gaze: Tensor, boxes: Tensor) -> Tensor:
        """Map boxes from the views to the canvas; they stay as they are unless the sensor moves pixels.

        Args:
            state: the canvas as `open` prepared it.
            gaze: fixations `(F, 2)`.
            boxes: boxes `(F, N, 4)` in pixels of the views; `(F·L, N, 4)` of a sensor with L crops.

        Returns:
            The boxes in pixels of the canvas.
        """
        return boxes

    @abstractmethod
    def settings(self) -> dict[str, object]:
        """List the settings that the views depend on, for the keys of caches and the metadata of fitted models.

        Returns:
            JSON values by name.
        """

    def _stated(self) -> dict[str, object]:
        """List the constructor's settings, without those that are parameters."""
        learned = {name.removeprefix("log_") for name in self._parameters}
        stated = {*self.names} - learned
        return {name: value for name, value in self.settings().items() if name in stated}

    @classmethod
    def from_settings(cls, settings: Settings) -> Self:
        """Make the sensor from its settings.

        Args:
            settings: the settings by name; others than `names` are ignored.

        Returns:
            The sensor.

        Raises:
            InputError: a setting is missing, or out of its range.
        """
        for name in cls.names:
            check(name in settings, f"sensor.{name}", f"a setting of a {cls.__name__}", "none")
        return cls(**{name: settings[name] for name in cls.names})

    @classmethod
    def width(cls, settings: Settings) -> float:
        """Return the width of the fovea, in pixels of the reference image.

        Policies that bring the fovea closer use it. A sensor that does not tell counts as wide as `published`.

        Args:
            settings: settings of the sensor.

        Returns:
            The width.
        """
        return 100.0

    @classmethod
    def borders(cls, settings: Settings) -> list[float] | None:
        """List the distances from the fixation at which acuity changes, of a sensor with steps of acuity.

        Args:
            settings: settings of the sensor.

        Returns:
            Ascending distances in pixels of the image that the settings are for; None for a sensor without steps.
        """
        return None

    @classmethod
    def describe(cls, settings: Settings) -> str:
        """Describe the settings in words, for titles.

        Args:
            settings: settings of the sensor.

        Returns:
            The numbers among them with their names.
        """
        numbers = {name: value for name, value in settings.items() if isinstance(value, int | float)}
        return ", ".join(f"{name} {value:g}" for name, value in numbers.items())

    def extra_repr(self) -> str:
        """Write the settings as text."""
        settings = self.settings()
        parts = []
        for name in self.names:
            value = settings[name]
            text = f"{value:g}" if isinstance(value, float) else repr(value)
            parts.append(f"{name}={text}")
        return ", ".join(parts)


def stacked_views(view: Callable[[int, int], Tensor], batch: int, number: int, empty: Tensor) -> Tensor:
    """Make views one by one, and stack them.

    Args:
        view: makes the view of an image by its number, and by its number among those of the image.
        batch: number of images, B.
        number: number of views of each, G.
        empty: a tensor of the shape and kind of one view, for the case that there is none.

    Returns:
        Views `(B, G, ...)`.
    """
    views: list[Tensor] = []
    for image in range(batch):
        views += [view(image, fixation) for fixation in range(number)]
    if not views:
        return empty.expand(batch, number, *empty.shape)
    stack = views[0][None] if len(views) == 1 else torch.stack(views)  # one view is not copied
    return stack.unflatten(0, (batch, number))


def is_single_picture(image: object) -> TypeGuard[ImageLike]:
    """Tell whether this is one picture of a common type, not a batch or what a sensor has prepared of one."""
    if isinstance(image, Tensor | np.ndarray):
        return image.ndim <= 3
    return not isinstance(image, tuple | Bands)


def of_one_picture(points: Tensor) -> Tensor:
    """Bring fixations of one picture, `(2,)` or `(G, 2)`, to a shape for a batch of one, `(2,)` or `(1, G, 2)`."""
    return points[None] if points.ndim == 2 else points


def fixations(gaze: Tensor, like: Tensor) -> Tensor:
    """Bring fixations to one shape, beside the images.

    Args:
        gaze: `(2,)` for all images, `(B, 2)` for one fixation of each, or `(B, G, 2)` for G of each.
        like: the images `(B, ...)`.

    Returns:
        Positions `(B, G, 2)`, with G = 1 for the first two shapes.

    Raises:
        InputError: the shape is another one, or a number is not finite.
    """
    check_tensor(gaze, "gaze")
    batch = like.shape[0]
    for_all = gaze.shape == (2,)
    by_image = gaze.ndim in (2, 3) and gaze.shape[0] == batch and gaze.shape[-1] == 2
    expected = f"a tensor of shape (2,), ({batch}, 2) or ({batch}, G, 2)"
    check(for_all or by_image, "gaze", expected, tuple(gaze.shape))
    if values_known(gaze):
        check_finite(gaze, "gaze")
    points = as_positions(gaze, like)
    return points if points.ndim == 3 else points.expand(batch, 2)[:, None]
