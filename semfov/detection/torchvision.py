"""torchvision's detection models, with the full score vector of every box."""

import inspect
import math
import re
from collections.abc import Callable, Sequence
from os import PathLike, fspath
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from semfov.detection.class_names import keep_classes, named
from semfov.detection.detector import Detector, check_images
from semfov.detection.placement import Placement
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.selection import Selection
from semfov.detection.torchvision_heads import Raw, head_of
from semfov.errors import DataError, InputError, check, check_shape, lookup
from semfov.io.files import sha256

PREFIX = "torchvision:"


class TorchvisionDetector(Detector):
    """Faster R-CNN, RetinaNet, FCOS, SSD or SSDlite of torchvision as a `Detector`; differentiable.

    The canvas is the image as the model's own transform resizes it. The model's padding and normalisation, and its
    proposals' own suppression, belong to the network; its thresholds and its final suppression are left out.

    Faster R-CNN gives every class of a proposal a box of its own: the box of the best class is taken.

    Args:
        model: the model.
        classes: name of each of its outputs but the first, which is background; `"N/A"` for outputs that stand for
            no class.
        name: what tables and fitted models call it.
        first: outputs before the first class; 0 for models with sigmoids that were trained without background.
        background: background policy; None means the model's own background where it has one (softmax), else
            `residual`.
        selection: which candidates are kept.
        digest: sha256 of the weights.
    """

    def __init__(
        self,
        model: nn.Module,
        classes: Sequence[str],
        *,
        name: str = "torchvision",
        first: int = 1,
        background: BackgroundPolicy | None = None,
        selection: Selection | None = None,
        digest: str = "",
    ) -> None:
        head = head_of(model)
        if head is None:
            raise InputError(f"model: expected Faster R-CNN, RetinaNet, FCOS or SSD, got {type(model).__name__}")
        outputs, softmax = head
        check(first == 1 or (first == 0 and not softmax), "first", "1, or 0 for heads with sigmoids", first)
        names, places = named(classes)
        transform: Any = model.transform
        fixed = transform.fixed_size
        own: BackgroundPolicy = "own" if softmax else "residual"
        super().__init__(
            name,
            names,
            (transform.max_size, transform.max_size) if fixed is None else tuple(fixed),
            background=own if background is None else background,
            selection=selection,
            stretch=fixed is not None,
            digest=digest,
        )
        self.model = model.eval()
        self.first = first
        self._outputs, self._softmax = outputs, softmax
        self._places, self._count = places, len(classes)

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's transform does; nothing is padded."""
        check_images(images)
        height, width = images.shape[-2:]
        columns, rows = self._canvas_size(width, height)
        canvas = F.interpolate(images, (rows, columns), mode="bilinear", align_corners=False)
        return canvas, Placement((width, height), (columns / width, rows / height), (0, 0))

    def _canvas_size(self, width: int, height: int) -> tuple[int, int]:
        transform: Any = self.model.transform
        if transform.fixed_size is not None:
            return self.input_size
        longer, shorter = max(width, height), min(width, height)
        scale = min(transform.min_size[-1] / shorter, transform.max_size / longer)
        return max(1, math.floor(width * scale)), max(1, math.floor(height * scale))

    def outputs(self, canvas: Tensor) -> Raw:
        """What the model filters: for each canvas boxes `(N, 4)` or `(N, C, 4)`, and scores `(N, C)`.

        C counts all outputs of the model, background first.
        """
        from torchvision.models.detection.image_list import ImageList

        check_shape(canvas, "canvas", None, 3, None, None)
        if not canvas.is_floating_point():
            raise InputError(f"canvas: expected floating-point RGB in [0, 1], got {canvas.dtype}")
        transform: Any = self.model.transform
        pixels = transform.normalize(canvas.to(next(self.model.parameters()).dtype))
        batch = transform.batch_images(list(pixels), size_divisible=transform.size_divisible)
        sizes = [(canvas.shape[-2], canvas.shape[-1])] * canvas.shape[0]
        return self._outputs(self.model, ImageList(batch, sizes), self.first)

    def propose(self, canvas: Tensor) -> Candidates:
        """Every box of the model on a canvas `(B, 3, H, W)`, RGB in [0, 1]; short rows are filled with empty boxes."""
        raw = self.outputs(canvas)
        longest = max((len(scores) for _, scores in raw), default=0)
        images = [self._candidates(boxes, scores) for boxes, scores in raw]
        boxes, classes = (
            torch.stack([F.pad(x, (0, 0, 0, longest - len(x))) for x in column]).to(canvas.dtype)
            for column in ([c.boxes for c in images], [c.classes for c in images])
        )
        background = None
        if self._softmax:
            rows = [scores[:, 0] for _, scores in raw]
            background = torch.stack([F.pad(x, (0, longest - len(x)), value=1.0) for x in rows]).to(canvas.dtype)
        return Candidates(boxes, classes, background=background)

    def _candidates(self, boxes: Tensor, scores: Tensor) -> Candidates:
        """Real classes of one image, and one box for each row."""
        kept = keep_classes(Candidates(boxes, scores[:, self.first :]), self._places, self._count)
        if boxes.ndim == 2:
            return kept
        places = torch.tensor(self._places, device=boxes.device) + self.first
        best = places[kept.classes.argmax(-1)]
        own = boxes.gather(1, best[:, None, None].expand(-1, 1, 4))[:, 0]
        return Candidates(own, kept.classes)

    def settings(self) -> dict[str, object]:
        """What the detections depend on."""
        transform: Any = self.model.transform
        sizes = {"min_size": list(transform.min_size), "max_size": transform.max_size}
        return super().settings() | ({} if self.stretch else sizes)


def load_torchvision(
    name: str,
    *,
    weights: Any = "DEFAULT",
    classes: Sequence[str] | None = None,
    first: int = 1,
    background: BackgroundPolicy | None = None,
    threshold: float = 0.02,
    iou: float = 0.5,
    limit: int = 100,
    per_class: bool = False,
    device: torch.device | str = "cpu",
    **model: Any,
) -> TorchvisionDetector:
    """A detection model of torchvision by its name, `"torchvision:retinanet_resnet50_fpn"` or without the prefix.

    Args:
        name: one of `torchvision.models.list_models(module=torchvision.models.detection)`.
        weights: a name or member of the model's weights enum; the path of a state dict (`.pth`, `.safetensors`); or
            None for random weights. Files are never unpickled (`weights_only=True`).
        classes: names of the outputs after the first, for a state dict of your own or random weights.
        first: see `TorchvisionDetector`, as for `background`.
        threshold: see `Selection`, as for `iou`, `limit` and `per_class`.
        device: where the model lives.
        **model: options of torchvision's builder, such as `min_size` and `max_size`.

    Raises:
        InputError: no such model, weights or option, or `classes` is missing.
        DataError: the weights are damaged, do not fit the model, or cannot be had.
    """
    from torchvision import models

    name = name.removeprefix(PREFIX)
    lookup(name, models.list_models(module=models.detection), "torchvision detection model")
    enum = _member(models.get_model_weights(name), weights)
    if enum is not None:
        if classes is not None:
            raise InputError("classes: expected None, as torchvision's weights have classes of their own")
        classes = enum.meta["categories"][1:]
        digest = _download(enum)
    elif classes is None:
        raise InputError("classes: expected the names of the model's classes without background, got None")
    else:
        model |= {"num_classes": len(classes) + first, "weights_backbone": None}
        digest = "" if weights is None else sha256(_file(weights))
    try:
        network = models.get_model(name, weights=enum, **model)
    except (TypeError, ValueError) as error:
        raise InputError(f"options of {name}: {error}") from error
    for option in model:
        lookup(option, _options(models.get_model_builder(name), type(network)), f"option of {name}")
    if enum is None and weights is not None:
        _load_state(network, _file(weights))
    network.requires_grad_(False).to(device)
    return TorchvisionDetector(
        network,
        classes,
        name=PREFIX + name,
        first=first,
        background=background,
        selection=Selection(threshold, iou, limit, per_class),
        digest=digest,
    ).eval()


def _member(enum: Any, weights: Any) -> Any:
    """The member of a weights enum that is meant, or None for a file and for random weights."""
    if weights is None or isinstance(weights, enum):
        return weights
    text = fspath(weights).removeprefix(f"{enum.__name__}.")
    if isinstance(weights, str) and not Path(text).suffix:
        return enum[lookup(text, [*enum.__members__], f"{enum.__name__} member")]
    return None


def _options(builder: Callable[..., nn.Module], kind: type[nn.Module]) -> list[str]:
    """Options that a builder or its model's constructors know; all of them would swallow any other in silence."""
    callables: list[Any] = [builder, *(each for each in kind.__mro__ if issubclass(each, nn.Module))]
    return sorted({name for call in callables for name in inspect.signature(call).parameters})


def _file(weights: str | PathLike[str]) -> Path:
    path = Path(weights)
    if not path.is_file():
        raise DataError(f"no weights file {fspath(weights)!r}")
    return path


def _download(enum: Any) -> str:
    """Put the published weights into torch's cache and return their sha256.

    torchvision names the file by the start of its hash, and would unpickle it. Reading it once with nothing but
    tensors allowed shows that there is nothing else in it.
    """
    try:
        enum.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except UnpicklingError as error:
        raise DataError(f"weights {enum.url}: expected nothing but tensors: {error}") from error
    except (OSError, RuntimeError) as error:
        raise DataError(
            f"cannot fetch the weights {enum.url} ({error}): give the path of their state dict as weights="
        ) from error
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(enum.url).name
    digest = sha256(path)
    start = re.search(r"-([0-9a-f]{8,})\.", path.name)
    if start is not None and not digest.startswith(start[1]):
        raise DataError(f"{path} is damaged (its sha256 is {digest}): delete it, and it will be fetched again")
    return digest


def _load_state(network: nn.Module, path: Path) -> None:
    """Fill a model from a state dict, alone or under the key `model` as torchvision's training script leaves it."""
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state: dict[str, Any] = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
        network.load_state_dict(state.get("model", state))
    except Exception as error:  # torch, pickle, zip and safetensors each raise their own
        raise DataError(f"weights {str(path)!r} do not fit the model, or are no state dict: {error}") from error
