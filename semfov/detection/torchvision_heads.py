"""All boxes of torchvision's detection models with all their scores, before the models filter them."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

Raw = list[tuple[Tensor, Tensor]]
"""For each image, boxes `(N, 4)`, or `(N, C, 4)` where each class has its own box, and scores `(N, C)`."""


def roi_outputs(model: Any, images: Any, backgrounds: int) -> Raw:
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


def ssd_outputs(model: Any, images: Any, backgrounds: int) -> Raw:
    """SSD (Liu et al. 2016) and SSDlite: the default boxes, with a softmax over classes."""
    outputs, anchors, _ = _dense(model, images)
    boxes = [model.box_coder.decode_single(b, a) for b, a in zip(outputs["bbox_regression"], anchors, strict=True)]
    scores = outputs["cls_logits"].softmax(-1)
    return [(_clip(b, size), s) for b, s, size in zip(boxes, scores, images.image_sizes, strict=True)]


def retinanet_outputs(model: Any, images: Any, backgrounds: int) -> Raw:
    """RetinaNet (Lin et al. 2017): the best anchors of every level, with a sigmoid for each class."""
    outputs, anchors, pixels = _dense(model, images)
    scores = outputs["cls_logits"].sigmoid()
    return _best_of_levels(model, images, outputs, anchors, pixels, scores, backgrounds, model.box_coder.decode_single)


def fcos_outputs(model: Any, images: Any, backgrounds: int) -> Raw:
    """FCOS (Tian et al. 2019): the best points of every level, with the scores `√(σ(class) σ(centreness))`."""
    outputs, anchors, pixels = _dense(model, images)
    scores = (outputs["cls_logits"].sigmoid() * outputs["bbox_ctrness"].sigmoid()).sqrt()
    return _best_of_levels(model, images, outputs, anchors, pixels, scores, backgrounds, model.box_coder.decode)


def _features(model: Any, images: Any) -> dict[str, Tensor]:
    features = model.backbone(images.tensors)
    return {"0": features} if isinstance(features, Tensor) else features


def _dense(model: Any, images: Any) -> tuple[dict[str, Tensor], list[Tensor], list[int]]:
    """Outputs of a head on all levels, `(B, N, ...)`, the anchors of each image, and the number of pixels by level."""
    features = list(_features(model, images).values())
    outputs = model.head(features)
    anchors = model.anchor_generator(images, features)
    return outputs, anchors, [feature.shape[-1] * feature.shape[-2] for feature in features]


def _best_of_levels(
    model: Any,
    images: Any,
    outputs: dict[str, Tensor],
    anchors: list[Tensor],
    pixels: Sequence[int],
    scores: Tensor,
    backgrounds: int,
    decode: Callable[[Tensor, Tensor], Tensor],
) -> Raw:
    """The `topk_candidates` anchors of each level with the highest class score, for each image.

    The model itself takes as many pairs of anchor and class, so the anchors of its pairs are among these.

    Returns:
        Boxes and scores of each image.
    """
    raw: Raw = []
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


def head_of(model: nn.Module) -> tuple[Callable[[Any, Any, int], Raw], bool] | None:
    """The function that decodes a kind of model, and whether its scores are a softmax; None for an unknown kind."""
    from torchvision.models.detection import FCOS, FasterRCNN, RetinaNet
    from torchvision.models.detection.ssd import SSD

    for kind, function, softmax in (
        (FasterRCNN, roi_outputs, True),
        (SSD, ssd_outputs, True),
        (RetinaNet, retinanet_outputs, False),
        (FCOS, fcos_outputs, False),
    ):
        if isinstance(model, kind):
            return function, softmax
    return None


def output_count(model: nn.Module) -> int | None:
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
