"""Torch modules of other libraries as detectors: what the adapters of all libraries share."""

import hashlib
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.class_names import named_outputs
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import chosen, no_features, recorded, stride_of
from semfov.detection.placement import Placement
from semfov.detection.scores import Candidates
from semfov.errors import check, check_shape


class ModuleDetector(Detector):
    """Base of detectors whose network is a torch module of another library; they are differentiable."""

    def __init__(
        self, model: nn.Module, classes: Sequence[str], name: str, input_size: tuple[int, int], **options: Any
    ) -> None:
        names, places = named_outputs(classes)
        super().__init__(name, names, input_size, **options)
        self.model = model
        self._places, self._count = places, len(classes)
        self.eval()

    def feature_modules(self) -> dict[str, nn.Module]:
        """Modules of the network that return feature maps, by what the maps are called before their stride."""
        return {}

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes and feature maps in one pass."""
        modules = self.feature_modules()
        if not modules:
            raise no_features(self.name)
        with recorded(modules) as found:
            candidates = self.propose(canvas)
        maps = {
            f"{place.rstrip('0123456789')}{stride_of(canvas.shape[-1], each.shape[-1])}": each
            for place, several in found.items()
            for each in several
        }
        return candidates, {layer: maps[layer] for layer in chosen(layers, [*maps], self.name)}

    def _pixels(self, canvas: Tensor) -> Tensor:
        """A canvas in the precision of the network; raises `InputError` for anything else."""
        check_shape(canvas, "canvas", None, 3, None, None)
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        return canvas.to(next(self.model.parameters()).dtype)


def edge_scale(images: Tensor, edges: tuple[float, float]) -> float:
    """The scale at which the shorter edge of images has a length, unless the longer one exceeds another."""
    height, width = images.shape[-2:]
    return min(edges[0] / min(width, height), edges[1] / max(width, height))


def resized_images(
    images: Tensor, *, scale: float = 1.0, size: tuple[int, int] | None = None, antialias: bool = False
) -> tuple[Tensor, Placement]:
    """Images resized bilinearly by a scale, or to `(width, height)`, and their placement, without padding."""
    height, width = images.shape[-2:]
    columns, rows = (max(1, math.floor(n * scale)) for n in (width, height)) if size is None else size
    canvas = F.interpolate(images, (rows, columns), mode="bilinear", align_corners=False, antialias=antialias)
    return canvas, Placement((width, height), (columns / width, rows / height), (0, 0))


def module_digest(module: nn.Module) -> str:
    """Compute the sha256 of the names and values of a module's parameters and buffers."""
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        if isinstance(tensor, torch.Tensor):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
