"""torchvision's detection models, with the full score vector of every box before the models filter them."""

import inspect
import re
from collections.abc import Callable, Sequence
from os import fspath
from pathlib import Path
from pickle import UnpicklingError
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from semfov.detection.class_names import keep_classes
from semfov.detection.detector import check_images
from semfov.detection.modules import ModuleDetector, edge_scale, module_digest, resized_images
from semfov.detection.placement import Placement
from semfov.detection.scores import Candidates
from semfov.errors import DataError, InputError, check, check_data, lookup
from semfov.io.files import sha256

_Raw = list[tuple[Tensor, Tensor]]
"""For each image, boxes `(N, 4)`, or `(N, C, 4)` where each class has its own box, and scores `(N, C)`."""

_PREFIX = "torchvision:"


class TorchvisionDetector(ModuleDetector):
    """A torchvision Faster R-CNN, RetinaNet, FCOS, SSD or SSDlite as a `Detector`; it is differentiable."""

    def __init__(
        self,
        model: nn.Module,
        digest: str | None = None,
        *,
        classes: Sequence[str] | None = None,
        name: str = "torchvision",
        first: int = 1,
    ) -> None:
        if classes is None:
            from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

            names = FasterRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
            count = _output_count(model)
            check(count == len(names), "classes", "the names of the model's outputs after the first, background", None)
            classes = names[first:]
        outputs, softmax = _head_of(model)
        check(first == 1 or (first == 0 and not softmax), "first", "1, or 0 for models with sigmoids", first)
        transform: Any = model.transform
        fixed = transform.fixed_size
        super().__init__(
            model,
            classes,
            name,
            (transform.max_size, transform.max_size) if fixed is None else tuple(fixed),
            background="own" if softmax else "residual",
            stretch=fixed is not None,
            digest=module_digest(model) if digest is None else digest,
        )
        self.first = first
        self._outputs, self._softmax = outputs, softmax

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's transform does, without padding."""
        check_images(images)
        transform: Any = self.model.transform
        if transform.fixed_size is not None:
            return resized_images(images, size=self.input_size)
        return resized_images(images, scale=edge_scale(images, (transform.min_size[-1], transform.max_size)))

    def outputs(self, canvas: Tensor) -> _Raw:
        """Compute the boxes and scores of the model before it filters them; canvas `(B, 3, H, W)` → `(N, 4)`."""
        from torchvision.models.detection.image_list import ImageList

        transform: Any = self.model.transform
        pixels = transform.normalize(self._pixels(canvas))
        batch = transform.batch_images(list(pixels), size_divisible=transform.size_divisible)
        sizes = [(canvas.shape[-2], canvas.shape[-1])] * canvas.shape[0]
        return self._outputs(self.model, ImageList(batch, sizes), self.first)

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes on a canvas `(B, 3, H, W)`, RGB in [0, 1], padded with empty boxes to one number."""
        raw = self.outputs(canvas)
        images = [self._candidates(boxes, scores) for boxes, scores in raw]

        def padded(rows: list[Tensor], value: float = 0.0) -> Tensor:
            return pad_sequence(rows, True, value).to(canvas.dtype)

        background = padded([scores[:, 0] for _, scores in raw], 1.0) if self._softmax else None
        boxes, classes = padded([each.boxes for each in images]), padded([each.classes for each in images])
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

    def feature_modules(self) -> dict[str, nn.Module]:
        """The backbone with its pyramid."""
        return {"pyramid": cast(nn.Module, self.model.backbone)}

    def settings(self) -> dict[str, object]:
        transform: Any = self.model.transform
        sizes = {"min_size": list(transform.min_size), "max_size": transform.max_size}
        return super().settings() | ({} if self.stretch else sizes)

    @classmethod
    def load(
        cls, name: str, *, weights: Any = "DEFAULT", classes: Sequence[str] | None = None, first: int = 1, **model: Any
    ) -> "TorchvisionDetector":
        """Load a torchvision detection model by its name."""
        from torchvision import models

        name = name.removeprefix(_PREFIX)
        lookup(name, models.list_models(module=models.detection), "torchvision detection model")
        members: Any = models.get_model_weights(name)
        enum = weights  # a member, or None for a file and for random weights
        if weights is not None and not isinstance(weights, members):
            text = fspath(weights).removeprefix(f"{members.__name__}.")
            named = isinstance(weights, str) and not Path(text).suffix
            enum = members[lookup(text, [*members.__members__], f"{members.__name__} member")] if named else None
        if enum is not None:
            check(classes is None, "classes", "None, because torchvision's weights have their own classes", "names")
            classes = enum.meta["categories"][1:]
            digest = _download(enum)
        elif classes is None:
            raise InputError("classes: expected the names of the model's classes without background, got None")
        else:
            model |= {"num_classes": len(classes) + first, "weights_backbone": None}
            digest = "" if weights is None else sha256(weights, f"weights {fspath(weights)!r}")
        try:
            network = models.get_model(name, weights=enum, **model)
        except (TypeError, ValueError) as error:
            raise InputError(f"options of {name}: {error}") from error
        # The builder and the constructors of its model would silently accept any other option.
        modules = (each for each in type(network).__mro__ if issubclass(each, nn.Module))
        builders = models.get_model_builder(name), *modules
        known = sorted({each for call in builders for each in inspect.signature(call).parameters})
        for option in model:
            lookup(option, known, f"option of {name}")
        if enum is None and weights is not None:
            _load_state(network, Path(weights))
        return cls(network.requires_grad_(False), digest, classes=classes, name=_PREFIX + name, first=first)


def _download(enum: Any) -> str:
    """Download published weights, check that they hold tensors only and have the sha256 of their name; the sha256."""
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
    fits, begins = start is None or digest.startswith(start[1]), start and start[1]
    got = f"{digest}; delete the file to fetch it again"
    check_data(fits, f"weights {path}: damaged", f"a sha256 that begins with {begins}", got)
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


def _roi_outputs(model: Any, images: Any, backgrounds: int) -> _Raw:
    """Faster R-CNN (Ren et al. 2015): the proposals, with a softmax over classes and a box for each class."""
    features = _features(model, images)
    proposals, _ = model.rpn(images, features)
    heads = model.roi_heads
    regions = heads.box_head(heads.box_roi_pool(features, proposals, images.image_sizes))
    logits, regression = heads.box_predictor(regions)
    counts = [len(each) for each in proposals]
    # Without proposals the box coder does not add the class dimension.
    boxes = heads.box_coder.decode(regression, proposals).reshape(len(logits), logits.shape[-1], 4).split(counts)
    scores = logits.softmax(-1).split(counts)
    return [(_clip(b, size), s) for b, s, size in zip(boxes, scores, images.image_sizes, strict=True)]


def _ssd_outputs(model: Any, images: Any, backgrounds: int) -> _Raw:
    """SSD (Liu et al. 2016) and SSDlite: the default boxes, with a softmax over classes."""
    outputs, anchors, _ = _dense(model, images)
    boxes = [model.box_coder.decode_single(b, a) for b, a in zip(outputs["bbox_regression"], anchors, strict=True)]
    scores = outputs["cls_logits"].softmax(-1)
    return [(_clip(b, size), s) for b, s, size in zip(boxes, scores, images.image_sizes, strict=True)]


def _features(model: Any, images: Any) -> dict[str, Tensor]:
    features = model.backbone(images.tensors)
    return {"0": features} if isinstance(features, Tensor) else features


def _dense(model: Any, images: Any) -> tuple[dict[str, Tensor], list[Tensor], list[int]]:
    """Outputs of a head on all levels, `(B, N, ...)`, the anchors of each image, and the number of pixels by level."""
    features = list(_features(model, images).values())
    outputs = model.head(features)
    anchors = model.anchor_generator(images, features)
    return outputs, anchors, [feature.shape[-1] * feature.shape[-2] for feature in features]


def _level_outputs(model: Any, images: Any, backgrounds: int) -> _Raw:
    """RetinaNet (Lin et al. 2017) and FCOS (Tian et al. 2019): of every level the anchors with the best class.

    Scores are a sigmoid for each class, of FCOS `√(σ(class) σ(centreness))`.
    """
    outputs, anchors, pixels = _dense(model, images)
    scores, centred = outputs["cls_logits"].sigmoid(), "bbox_ctrness" in outputs
    if centred:
        scores = (scores * outputs["bbox_ctrness"].sigmoid()).sqrt()
    decode = model.box_coder.decode if centred else model.box_coder.decode_single
    raw: _Raw = []
    each = len(anchors[0]) // sum(pixels)
    for regression, score, anchor, size in zip(
        outputs["bbox_regression"], scores, anchors, images.image_sizes, strict=True
    ):
        index, start = [], 0
        for best in score[:, backgrounds:].detach().amax(-1).split([each * count for count in pixels]):
            index.append(best.topk(min(model.topk_candidates, len(best))).indices + start)
            start += len(best)
        rows = torch.cat(index)
        raw.append((_clip(decode(regression[rows], anchor[rows]), size), score[rows]))
    return raw


def _clip(boxes: Tensor, size: tuple[int, int]) -> Tensor:
    from torchvision.ops import clip_boxes_to_image

    return clip_boxes_to_image(boxes, size)


def _head_of(model: nn.Module) -> tuple[Callable[[Any, Any, int], _Raw], bool]:
    """The function that decodes a kind of model, and whether its scores are a softmax."""
    from torchvision.models.detection import FCOS, FasterRCNN, RetinaNet
    from torchvision.models.detection.ssd import SSD

    for kind, function, softmax in (
        (FasterRCNN, _roi_outputs, True),
        (SSD, _ssd_outputs, True),
        (RetinaNet, _level_outputs, False),
        (FCOS, _level_outputs, False),
    ):
        if isinstance(model, kind):
            return function, softmax
    raise InputError(f"model: expected Faster R-CNN, RetinaNet, FCOS or SSD, got {type(model).__name__}")


def _output_count(model: nn.Module) -> int | None:
    """The number of a model's outputs, background included; None where its head is not one of torchvision's."""
    for path in (
        "roi_heads.box_predictor.cls_score.out_features",
        "head.classification_head.num_classes",
        "head.classification_head.num_columns",
    ):
        value: Any = model
        for part in path.split("."):
            value = getattr(value, part, None)
        if isinstance(value, int):
            return value
    return None
