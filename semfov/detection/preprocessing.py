"""The preprocessing that a network expects, as settings that can be stored with the model."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, Literal, Self, get_args

import torch
from torch import Tensor

from semfov.errors import check, check_shape, lookup
from semfov.io.schema import Array, Flag, Number

_ChannelOrder = Literal["rgb", "bgr"]


_KINDS = {
    "scale": Number(above=0),
    "mean": Array(Number(), 3),
    "std": Array(Number(above=0), 3),
    "stretch": Flag(),
    "corner": Flag(),
    "fill": Number(0, 1),
}


@dataclass(frozen=True)
class Preprocessing:
    """Conversion of a canvas, RGB in [0, 1], to the input of a network: `(canvas · scale - mean) / std`."""

    channels: _ChannelOrder = "rgb"
    scale: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)
    stretch: bool = False
    corner: bool = False
    fill: float = 114 / 255

    def __post_init__(self) -> None:
        lookup(str(self.channels), get_args(_ChannelOrder), "channel order")
        for name, kind in _KINDS.items():
            kind.check(f"preprocessing.{name}", getattr(self, name), {})
        for name in ("mean", "std"):
            object.__setattr__(self, name, tuple(map(float, getattr(self, name))))

    def __call__(self, canvas: Tensor) -> Tensor:
        """Convert a canvas `(B, 3, H, W)` to the input of the network, a new tensor of the same shape."""
        check_shape(canvas, "canvas", None, 3, None, None)
        # Plane by plane, as each stays in the cache between the operations.
        sources = canvas.unbind(1)[:: -1 if self.channels == "bgr" else 1]
        planes = [source * (self.scale / std) for source, std in zip(sources, self.std, strict=True)]
        shifts = [mean / std for mean, std in zip(self.mean, self.std, strict=True)]
        return torch.stack([plane - shift if shift else plane for plane, shift in zip(planes, shifts, strict=True)], 1)

    def of_bytes(self, canvas: Tensor) -> Tensor:
        """Convert a canvas of bytes `(B, 3, H, W)` to the input: `self(canvas / 255)`, in one pass over memory."""
        check_bytes(canvas)
        image = torch.empty(canvas.shape, device=canvas.device)
        sources = canvas.unbind(1)[:: -1 if self.channels == "bgr" else 1]
        for plane, source, mean, std in zip(image.unbind(1), sources, self.mean, self.std, strict=True):
            plane.copy_(source)
            if (factor := self.scale / 255 / std) != 1:
                plane.mul_(factor)
            if mean:
                plane.sub_(mean / std)
        return image

    def merged(self, settings: Mapping[str, Any]) -> Self:
        """Return a copy with some settings replaced; unknown names are refused."""
        for name in settings:
            lookup(name, [field.name for field in fields(self)], "preprocessing setting")
        return replace(self, **settings)

    def settings(self) -> dict[str, Any]:
        """List all settings as JSON values."""
        return {name: list(v) if isinstance(v, tuple) else v for name, v in asdict(self).items()}


def check_bytes(canvas: Tensor) -> None:
    """Raise `InputError` unless a canvas is `(B, 3, H, W)`, bytes."""
    fits = canvas.ndim == 4 and canvas.shape[1] == 3 and canvas.dtype == torch.uint8
    check(fits, "canvas", "bytes of shape (B, 3, H, W)", f"{canvas.dtype} of shape {tuple(canvas.shape)}")
