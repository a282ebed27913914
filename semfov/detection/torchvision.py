"""torchvision's detection models, with the full score vector of every box before the models filter them."""

import inspect
import re
from collections.abc import Callable, Iterable, Sequence
from os import fspath
from pathlib import Path
from pickle import UnpicklingError
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import pad_sequence

from semfov.detection.class_names import COCO_CATEGORIES, coco_categories
from semfov.detection.detector import check_images
from semfov.detection.modules import ModuleDetector, edge_scale, module_digest, resized_images
from semfov.detection.placement import Placement
from semfov.detection.scores import Candidates
from semfov.errors import DataError, InputError, check, check_data, lookup
from semfov.io.files import sha256

if TYPE_CHECKING:
    from torchvision.models.detection.image_list import ImageList

_Raw = list[tuple[Tensor, Tensor]]
"""For each image, boxes `(N, 4)`, or `(N, C, 4)` where each class has its own box, and scores `(N, C)`."""

_Decoder = Callable[["_Model", "ImageList", int], _Raw]
"""What decodes a kind of model: from the model, images and the number of outputs before the classes."""

# torchvision declares neither the parts of its models nor what its enums of weights hold.
_Model = Any
_Weights = Any

_PREFIX = "torchvision:"

_COUNTS = (
    "roi_heads.box_predictor.cls_score.out_features",  # Faster R-CNN
    "head.classification_head.num_classes",  # RetinaNet and FCOS
    "head.classification_head.num_columns",  # SSD
)
"""Where heads have the number of their outputs, background included."""


class TorchvisionDetector(ModuleDetector):
    """A torchvision Faster R-CNN, RetinaNet, FCOS, SSD or SSDlite as a `Detector`; it is differentiable.

    Attributes:
        first: number of the output of the first class; the one before it, if any, is background.

    `_decoder` computes boxes and scores, which are a softmax where `_softmax` is true, and else a sigmoid each.
    """

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
            # COCO's names are taken only for as many outputs, as other classes are usually more or fewer.
            is_coco = _output_count(model) == COCO_CATEGORIES
            check(is_coco, "classes", "the names of the model's outputs after the first, background", None)
            classes = coco_categories()[first:]
        decoder, softmax = _decoder_of(model)
        possible = (1,) if softmax else (0, 1)  # of a softmax, output 0 is background
        check(first in possible, "first", "1, or 0 for models with sigmoids", first)
        transform: _Model = model.transform
        has_fixed_size = transform.fixed_size is not None
        canvas = tuple(transform.fixed_size) if has_fixed_size else (transform.max_size, transform.max_size)
        super().__init__(
            model,
            classes,
            name,
            canvas,
            background="own" if softmax else "residual",
            stretch=has_fixed_size,
            digest=module_digest(model) if digest is None else digest,
        )
        self.first = first
        self._decoder = decoder
        self._softmax = softmax

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's transform does, without padding."""
        check_images(images)
        transform: _Model = self.model.transform
        if transform.fixed_size is not None:
            return resized_images(images, size=self.input_size)
        return resized_images(images, scale=edge_scale(images, (transform.min_size[-1], transform.max_size)))

    def outputs(self, canvas: Tensor) -> _Raw:
        """Compute the boxes and scores of the model before it filters them.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.

        Returns:
            For each image, boxes `(N, 4)`, or `(N, C, 4)` where each class has its own, and scores `(N, C)`.
        """
        from torchvision.models.detection.image_list import ImageList

        transform: _Model = self.model.transform
        pixels = transform.normalize(self._pixels(canvas))
        # Padded to what the network can halve; boxes are cut to the sizes without this padding.
        batch = transform.batch_images(list(pixels), size_divisible=transform.size_divisible)
        height, width = canvas.shape[-2:]
        sizes = [(height, width)] * len(canvas)
        return self._decoder(self.model, ImageList(batch, sizes), self.first)

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes on a canvas `(B, 3, H, W)`, RGB in [0, 1], padded with empty boxes to one number."""
        raw = self.outputs(canvas)
        images = [self._candidates(boxes, scores) for boxes, scores in raw]
        boxes = pad_sequence([image.boxes for image in images], True).to(canvas.dtype)  # (B, N, 4)
        classes = pad_sequence([image.classes for image in images], True).to(canvas.dtype)  # (B, N, K)
        if not self._softmax:
            return Candidates(boxes, classes)
        # The first of the scores of a softmax is background, and padding is all background.
        background = pad_sequence([scores[:, 0] for _, scores in raw], True, 1.0).to(canvas.dtype)  # (B, N)
        return Candidates(boxes, classes, background=background)

    def _candidates(self, boxes: Tensor, scores: Tensor) -> Candidates:
        """Make candidates of one image, without placeholders of classes, and with one box for each row.

        Shapes: boxes `(N, 4)` or `(N, C, 4)`, scores `(N, C)`.
        """
        candidates = self._of_classes(Candidates(boxes, scores[:, self.first :]))
        if boxes.ndim == 2:
            return candidates
        # A detection has one box for all its scores: the one of its best class.
        places = torch.tensor(self._places, device=boxes.device) + self.first
        best = places[candidates.classes.argmax(-1)]  # (N,), places among the C outputs
        index = best[:, None, None].expand(-1, 1, 4)
        best_boxes = boxes.gather(1, index)[:, 0]
        return Candidates(best_boxes, candidates.classes)

    def feature_modules(self) -> dict[str, nn.Module]:
        """Name the backbone with its pyramid."""
        return {"pyramid": cast(nn.Module, self.model.backbone)}

    def settings(self) -> dict[str, object]:
        settings = super().settings()
        if not self.stretch:
            transform: _Model = self.model.transform
            settings |= {"min_size": list(transform.min_size), "max_size": transform.max_size}
        return settings

    @classmethod
    def load(
        cls,
        name: str,
        *,
        weights: _Weights = "DEFAULT",
        classes: Sequence[str] | None = None,
        first: int = 1,
        **model: Any,
    ) -> "TorchvisionDetector":
        """Load a torchvision detection model by its name.

        Args:
            name: its name, with or without `torchvision:` before it.
            weights: torchvision's weights, or their name; the file of a state dict; or None for random weights.
            classes: names of the classes without background, for a state dict and for random weights.
            first: number of the output of the first class.
            **model: options of torchvision's builder of the model.

        Returns:
            The detector.

        Raises:
            InputError: a name or an option is unknown, or classes are missing.
            DataError: the weights cannot be fetched, are damaged, or do not fit the model.
        """
        from torchvision import models

        name = name.removeprefix(_PREFIX)
        lookup(name, models.list_models(module=models.detection), "torchvision detection model")
        published = _published_weights(weights, models.get_model_weights(name))
        if published is not None:
            check(classes is None, "classes", "None, because torchvision's weights have their own classes", "names")
            classes = published.meta["categories"][1:]
            digest = _download(published)
        elif classes is None:
            raise InputError("classes: expected the names of the model's classes without background, got None")
        else:
            # By itself torchvision would download weights of a backbone, which those of the file replace.
            model |= {"num_classes": len(classes) + first, "weights_backbone": None}
            digest = "" if weights is None else sha256(weights, f"weights {fspath(weights)!r}")
        try:
            network = models.get_model(name, weights=published, **model)
        except (TypeError, ValueError) as error:
            raise InputError(f"options of {name}: {error}") from error
        _check_options(model, name, type(network))
        if published is None and weights is not None:
            _load_state(network, Path(weights))
        return cls(network.requires_grad_(False), digest, classes=classes, name=_PREFIX + name, first=first)


def _published_weights(weights: _Weights, members: _Weights) -> _Weights:
    """Find the member of torchvision's enum of a model's weights; None for a file and for random weights."""
    if weights is None or isinstance(weights, members):
        return weights
    name = fspath(weights).removeprefix(f"{members.__name__}.")
    is_file = not isinstance(weights, str) or Path(name).suffix != ""
    if is_file:
        return None
    return members[lookup(name, [*members.__members__], f"{members.__name__} member")]


def _check_options(options: Iterable[str], name: str, kind: type[nn.Module]) -> None:
    """Raise `InputError` for an option that neither the builder of a model nor the constructors of its classes have."""
    # They would silently accept any other option.
    from torchvision import models

    builders = [models.get_model_builder(name), *(base for base in kind.__mro__ if issubclass(base, nn.Module))]
    names = set()
    for builder in builders:
        names |= {*inspect.signature(builder).parameters}
    for option in options:
        lookup(option, sorted(names), f"option of {name}")


def _download(weights: _Weights) -> str:
    """Download published weights, check that they hold tensors only, and return their sha256 if their name has it."""
    try:
        weights.get_state_dict(progress=False, check_hash=True, weights_only=True)
    except UnpicklingError as error:
        raise DataError(f"weights {weights.url}: expected only tensors, got other objects ({error})") from error
    except (OSError, RuntimeError) as error:
        raise DataError(
            f"cannot fetch the weights {weights.url} ({error}); give the path of their state dict as weights="
        ) from error
    path = Path(torch.hub.get_dir()) / "checkpoints" / Path(weights.url).name
    digest = sha256(path)
    start = re.search(r"-([0-9a-f]{8,})\.", path.name)
    if start is not None:
        expected = f"a sha256 that begins with {start[1]}"
        got = f"{digest}; delete the file to fetch it again"
        check_data(digest.startswith(start[1]), f"weights {path}: damaged", expected, got)
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


def _roi_outputs(model: _Model, images: "ImageList", first: int) -> _Raw:
    """Decode Faster R-CNN (Ren et al. 2015): the proposals, with a softmax over classes and a box for each class."""
    features = _features(model, images)
    proposals, _ = model.rpn(images, features)
    heads = model.roi_heads
    regions = heads.box_head(heads.box_roi_pool(features, proposals, images.image_sizes))
    logits, regression = heads.box_predictor(regions)
    counts = [len(boxes) for boxes in proposals]  # of each image
    decoded = heads.box_coder.decode(regression, proposals)
    # Without proposals the box coder does not add the class dimension.
    boxes = decoded.reshape(len(logits), logits.shape[-1], 4)
    scores = logits.softmax(-1)
    return _clipped(boxes.split(counts), scores.split(counts), images)


def _ssd_outputs(model: _Model, images: "ImageList", first: int) -> _Raw:
    """Decode SSD (Liu et al. 2016) and SSDlite: the default boxes, with a softmax over classes."""
    outputs, anchors, _ = _dense(model, images)
    decode = model.box_coder.decode_single
    boxes = [decode(offsets, anchor) for offsets, anchor in zip(outputs["bbox_regression"], anchors, strict=True)]
    scores = outputs["cls_logits"].softmax(-1)
    return _clipped(boxes, scores, images)


def _level_outputs(model: _Model, images: "ImageList", first: int) -> _Raw:
    """Decode RetinaNet (Lin et al. 2017) and FCOS (Tian et al. 2019): of every level the anchors with the best class.

    Scores are a sigmoid for each class, of FCOS `√(σ(class) σ(centreness))`.
    """
    outputs, anchors, cells = _dense(model, images)
    scores = outputs["cls_logits"].sigmoid()
    if "bbox_ctrness" in outputs:
        scores = (scores * outputs["bbox_ctrness"].sigmoid()).sqrt()
        decode = model.box_coder.decode
    else:
        decode = model.box_coder.decode_single
    anchors_per_cell = len(anchors[0]) // sum(cells)
    counts = [anchors_per_cell * count for count in cells]
    boxes = []
    best_scores = []
    for regression, image_scores, anchor in zip(outputs["bbox_regression"], scores, anchors, strict=True):
        best_class = image_scores[:, first:].detach().amax(-1)  # (N,)
        rows = _best_of_levels(best_class, counts, model.topk_candidates)
        boxes.append(decode(regression[rows], anchor[rows]))
        best_scores.append(image_scores[rows])
    return _clipped(boxes, best_scores, images)


def _best_of_levels(best: Tensor, counts: list[int], limit: int) -> Tensor:
    """Find the rows of the best scores `(N,)` of each level, at most `limit` of each; counts are rows by level."""
    # As torchvision does before it suppresses boxes.
    rows = []
    start = 0
    for level in best.split(counts):
        rows.append(level.topk(min(limit, len(level))).indices + start)
        start += len(level)
    return torch.cat(rows)


def _features(model: _Model, images: "ImageList") -> dict[str, Tensor]:
    """Compute the features of a backbone, which has one map or several."""
    features = model.backbone(images.tensors)
    return {"0": features} if isinstance(features, Tensor) else features


def _dense(model: _Model, images: "ImageList") -> tuple[dict[str, Tensor], list[Tensor], list[int]]:
    """Compute the outputs of a head on all levels, `(B, N, ...)`, the anchors of each image, and the cells by level."""
    features = list(_features(model, images).values())
    outputs = model.head(features)
    anchors = model.anchor_generator(images, features)
    return outputs, anchors, [feature.shape[-1] * feature.shape[-2] for feature in features]


def _clipped(boxes: Iterable[Tensor], scores: Iterable[Tensor], images: "ImageList") -> _Raw:
    """Cut the boxes of each image to the image, and put its scores beside them."""
    from torchvision.ops import clip_boxes_to_image

    raw = []
    for image_boxes, image_scores, size in zip(boxes, scores, images.image_sizes, strict=True):
        raw.append((clip_boxes_to_image(image_boxes, size), image_scores))
    return raw


def _decoder_of(model: nn.Module) -> tuple[_Decoder, bool]:
    """Find what decodes a kind of model, and whether its scores are a softmax."""
    from torchvision.models.detection import FCOS, FasterRCNN, RetinaNet
    from torchvision.models.detection.ssd import SSD

    if isinstance(model, FasterRCNN):
        return _roi_outputs, True
    if isinstance(model, SSD):
        return _ssd_outputs, True
    if isinstance(model, RetinaNet | FCOS):
        return _level_outputs, False
    raise InputError(f"model: expected Faster R-CNN, RetinaNet, FCOS or SSD, got {type(model).__name__}")


def _output_count(model: nn.Module) -> int | None:
    """Count a model's outputs, background included; None where its head is not one of torchvision's."""
    for path in _COUNTS:
        part: object = model
        for name in path.split("."):
            part = getattr(part, name, None)
        if isinstance(part, int):
            return part
    return None
