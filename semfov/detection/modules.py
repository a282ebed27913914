"""Torch modules of other libraries as detectors: what the adapters of all libraries share."""

import hashlib
import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.class_names import keep_classes, named_outputs
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import choose_layers, no_features, record_maps, stride_of
from semfov.detection.placement import Placement
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.errors import check, check_shape


class ModuleDetector(Detector):
    """Base of detectors whose network is a torch module of another library; they are differentiable.

    Of the `_count` scores of a box, those at `_places` stand for a class, as others are gaps or background.
    """

    def __init__(
        self,
        model: nn.Module,
        classes: Sequence[str],
        name: str,
        input_size: tuple[int, int],
        *,
        background: BackgroundPolicy = "residual",
        fill: float = 0.5,
        stride: int | None = None,
        stretch: bool = False,
        digest: str = "",
    ) -> None:
        names, places = named_outputs(classes)
        super().__init__(
            name, names, input_size, background=background, fill=fill, stride=stride, stretch=stretch, digest=digest
        )
        self.model = model
        self._places = places
        self._count = len(classes)
        # In training, outputs would depend on the other images (batch norm) and on chance (dropout).
        self.eval()

    def feature_modules(self) -> dict[str, nn.Module]:
        """Name the modules of the network that return feature maps.

        Returns:
            The modules, by what their maps are called before their stride.
        """
        return {}

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes and feature maps in one pass."""
        modules = self.feature_modules()
        if not modules:
            raise no_features(self.name)
        with record_maps(modules) as maps_by_module:
            candidates = self.propose(canvas)
        maps = {}
        for name, returned in maps_by_module.items():
            # A module's name may end with the number of its layer, which the stride replaces.
            place = name.rstrip("0123456789")
            for feature_map in returned:
                maps[f"{place}{stride_of(canvas.shape[-1], feature_map.shape[-1])}"] = feature_map
        return candidates, {layer: maps[layer] for layer in choose_layers(layers, [*maps], self.name)}

    def _of_classes(self, candidates: Candidates) -> Candidates:
        """Keep the scores that stand for a class."""
        return keep_classes(candidates, self._places, self._count)

    def _pixels(self, canvas: Tensor) -> Tensor:
        """Convert a canvas to the precision of the network; raises `InputError` for anything else."""
        check_shape(canvas, "canvas", None, 3, None, None)
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        return canvas.to(next(self.model.parameters()).dtype)


def edge_scale(images: Tensor, edges: tuple[float, float]) -> float:
    """Find the scale at which the shorter edge of images has a length, unless the longer one exceeds another.

    Args:
        images: `(B, C, H, W)`.
        edges: the length of the shorter edge, and the largest length of the longer one, in pixels.

    Returns:
        New pixels for a pixel of the images.
    """
    height, width = images.shape[-2:]
    shortest, longest = edges
    return min(shortest / min(width, height), longest / max(width, height))


def resized_images(
    images: Tensor, *, scale: float = 1.0, size: tuple[int, int] | None = None, antialias: bool = False
) -> tuple[Tensor, Placement]:
    """Resize images bilinearly, without padding.

    Args:
        images: `(B, C, H, W)`.
        scale: new pixels for a pixel of the images; new sides are rounded down.
        size: `(width, height)` of the result, instead of a scale.
        antialias: whether images are blurred where they shrink.

    Returns:
        The canvas, and the placement of the images on it.
    """
    height, width = images.shape[-2:]
    if size is None:
        size = max(1, math.floor(width * scale)), max(1, math.floor(height * scale))
    columns, rows = size
    canvas = F.interpolate(images, (rows, columns), mode="bilinear", align_corners=False, antialias=antialias)
    return canvas, Placement((width, height), (columns / width, rows / height), (0, 0))


def module_digest(module: nn.Module) -> str:
    """Compute the sha256 of the names and values of a module's parameters and buffers.

    Args:
        module: the module.

    Returns:
        The digest in hexadecimal.
    """
    digest = hashlib.sha256()
    for name, tensor in module.state_dict().items():
        if isinstance(tensor, torch.Tensor):
            digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
            digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
