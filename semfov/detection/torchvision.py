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

from semfov.detection.class_names import keep_classes, named_outputs
from semfov.detection.detector import Detector, check_images
from semfov.detection.modules import module_digest
from semfov.detection.placement import Placement
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.selection import Selection
from semfov.detection.torchvision_heads import Raw, head_of, output_count
from semfov.errors import DataError, InputError, check, check_shape, lookup
from semfov.io.files import sha256

PREFIX = "torchvision:"


class TorchvisionDetector(Detector):
    """A torchvision Faster R-CNN, RetinaNet, FCOS, SSD or SSDlite as a `Detector`; it is differentiable.

    The canvas is the image, resized by the model's own transform. The model's padding, its normalisation and the
    non-maximum suppression of its proposals are part of the network. Its thresholds and its final suppression are left
    out.

    Faster R-CNN predicts a separate box for every class of a proposal; the box of the best class is used.

    Args:
        model: the model.
        classes: name of each of its outputs after the first, which is background; `"N/A"` for outputs that do not
            stand for a class.
        name: name of the model in tables and in fitted models.
        first: number of outputs before the first class; 0 for models with sigmoids that were trained without
            background.
        background: background policy; None for the model's own background where it has one (softmax), else
            `residual`.
        selection: settings of the selection of boxes.
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
        check(first == 1 or (first == 0 and not softmax), "first", "1, or 0 for models with sigmoids", first)
        names, places = named_outputs(classes)
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
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's transform does, without padding."""
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
        """Compute the boxes and scores of the model before it filters them.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1].

        Returns:
            For each canvas, boxes `(N, 4)` or `(N, C, 4)`, and scores `(N, C)`. C is the number of outputs of the
            model, background first.

        Raises:
            InputError: the canvas does not have floating-point numbers.
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
        """Compute all boxes on a canvas `(B, 3, H, W)`, RGB in [0, 1], padded with empty boxes to one number."""
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
        """The classes of one image without placeholders, with one box for each row."""
        candidates = keep_classes(Candidates(boxes, scores[:, self.first :]), self._places, self._count)
        if boxes.ndim == 2:
            return candidates
        places = torch.tensor(self._places, device=boxes.device) + self.first
        best = places[candidates.classes.argmax(-1)]
        own = boxes.gather(1, best[:, None, None].expand(-1, 1, 4))[:, 0]
        return Candidates(own, candidates.classes)

    def settings(self) -> dict[str, object]:
        """List the settings that the detections depend on."""
        transform: Any = self.model.transform
        sizes = {"min_size": list(transform.min_size), "max_size": transform.max_size}
        return super().settings() | ({} if self.stretch else sizes)


def wrap_torchvision(
    model: nn.Module,
    *,
    classes: Sequence[str] | None = None,
    name: str = "torchvision",
    first: int = 1,
    background: BackgroundPolicy | None = None,
    threshold: float = 0.02,
    iou: float = 0.5,
    limit: int = 100,
    per_class: bool = False,
    device: torch.device | str | None = None,
) -> TorchvisionDetector:
    """Make a detector of a torchvision detection model.

    Args:
        model: the model.
        classes: names of the outputs after the first; None for a model with the 91 outputs of torchvision's own weights
            on COCO.
        name: name of the model in tables and in fitted models.
        first: number of outputs before the first class, 1 or 0 (`TorchvisionDetector`).
        background: background policy of the scores (`semfov.detection.score_vectors`).
        threshold: smallest confidence of a box (`Selection`).
        iou: intersection over union above which the less confident of two boxes is suppressed (`Selection`).
        limit: largest number of boxes of an image (`Selection`).
        per_class: suppress only boxes of the same class (`Selection`).
        device: device of the model; None leaves it where it is.

    Returns:
        The detector, in `eval` mode.

    Raises:
        InputError: it is another model, or `classes` is missing.
    """
    if classes is None:
        from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

        names = FasterRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
        count = output_count(model)
        check(count == len(names), "classes", "the names of the model's outputs after the first, background", None)
        classes = names[first:]
    return TorchvisionDetector(
        model if device is None else model.to(device),
        classes,
        name=name,
        first=first,
        background=background,
        selection=Selection(threshold, iou, limit, per_class),
        digest=module_digest(model),
    ).eval()


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
    """Load a torchvision detection model by its name.

    Args:
        name: name of the model, such as `"torchvision:retinanet_resnet50_fpn"`, with or without the prefix; one of
            `torchvision.models.list_models(module=torchvision.models.detection)`.
        weights: a name or member of the model's weights enum; the path of a state dict (`.pth`, `.safetensors`); or
            None for random weights. Files are never unpickled (`weights_only=True`).
        classes: names of the outputs after the first, for your own state dict or random weights.
        first: number of outputs before the first class, 1 or 0 (`TorchvisionDetector`).
        background: background policy of the scores (`semfov.detection.score_vectors`).
        threshold: smallest confidence of a box (`Selection`).
        iou: intersection over union above which the less confident of two boxes is suppressed (`Selection`).
        limit: largest number of boxes of an image (`Selection`).
        per_class: suppress only boxes of the same class (`Selection`).
        device: device of the model.
        **model: options of torchvision's builder, such as `min_size` and `max_size`.

    Returns:
        The detector, in `eval` mode.

    Raises:
        InputError: the model, its weights or an option is unknown, or `classes` is missing.
        DataError: the weights are damaged, do not fit the model, or cannot be downloaded.
    """
    from torchvision import models

    name = name.removeprefix(PREFIX)
    lookup(name, models.list_models(module=models.detection), "torchvision detection model")
    enum = _member(models.get_model_weights(name), weights)
    if enum is not None:
        if classes is not None:
            raise InputError("classes: expected None, because torchvision's weights have their own classes, got names")
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
    """The member of a weights enum, or None for a file and for random weights."""
    if weights is None or isinstance(weights, enum):
        return weights
    text = fspath(weights).removeprefix(f"{enum.__name__}.")
    if isinstance(weights, str) and not Path(text).suffix:
        return enum[lookup(text, [*enum.__members__], f"{enum.__name__} member")]
    return None


def _options(builder: Callable[..., nn.Module], kind: type[nn.Module]) -> list[str]:
    """Options of a builder and of its model's constructors, which would silently accept any other option."""
    callables: list[Any] = [builder, *(each for each in kind.__mro__ if issubclass(each, nn.Module))]
    return sorted({name for call in callables for name in inspect.signature(call).parameters})


def _file(weights: str | PathLike[str]) -> Path:
    path = Path(weights)
    if not path.is_file():
        raise DataError(f"weights {fspath(weights)!r}: no such file; check the path")
    return path


def _download(enum: Any) -> str:
    """Download the published weights into torch's cache, and compute their sha256.

    torchvision would unpickle the file. Reading it once with only tensors allowed shows that it holds nothing else. The
    name of the file contains the start of its sha256, which is checked.

    Args:
        enum: member of a weights enum.

    Returns:
        64 hexadecimal digits.

    Raises:
        DataError: the weights cannot be downloaded, are damaged, or hold more than tensors.
    """
    try:
        enum.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except UnpicklingError as error:
        raise DataError(f"weights {enum.url}: expected only tensors, got other objects ({error})") from error
    except (OSError, RuntimeError) as error:
        raise DataError(
            f"cannot fetch the weights {enum.url} ({error}); give the path of their state dict as weights="
        ) from error
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(enum.url).name
    digest = sha256(path)
    start = re.search(r"-([0-9a-f]{8,})\.", path.name)
    if start is not None and not digest.startswith(start[1]):
        raise DataError(
            f"weights {path}: damaged, expected a sha256 that begins with {start[1]}, got {digest}; delete the file to "
            f"fetch it again"
        )
    return digest


def _load_state(network: nn.Module, path: Path) -> None:
    """Load a state dict into a model; it may be under the key `model`, as torchvision's training script writes it."""
    try:
        if path.suffix == ".safetensors":
            from safetensors.torch import load_file

            state: dict[str, Any] = load_file(path)
        else:
            state = torch.load(path, map_location="cpu", weights_only=True)
        network.load_state_dict(state.get("model", state))
    except Exception as error:  # torch, pickle, zip and safetensors each raise their own
        raise DataError(f"weights {str(path)!r}: do not fit the model, or are not a state dict ({error})") from error
