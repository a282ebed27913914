"""Object detection models of transformers (DETR, RT-DETR, D-FINE), with the full score vector of every box."""

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from semfov.detection.class_names import keep_classes
from semfov.detection.detector import check_images
from semfov.detection.modules import ModuleDetector, edge_scale, module_digest, resized_images
from semfov.detection.onnx_heads import HEADS
from semfov.detection.placement import Placement, letterbox
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import Candidates
from semfov.errors import DataError, InputError, check, needing
from semfov.io.schema import excerpt

_SOFTMAX = ("detr", "table-transformer", "yolos")
"""Kinds of models whose scores are a softmax over the classes and "no object"; the others have a sigmoid each."""
_IMAGENET = ("detr", "table-transformer", "yolos", "conditional_detr", "deformable_detr", "dab-detr")
_EDGES = {"shortest_edge": 800, "longest_edge": 1333}
_MOST = ("max_height", "max_width")
_SQUARE = {"height": 640, "width": 640}
_LARGEST = 65_536  # side of a canvas in pixels


class TransformersDetector(ModuleDetector):
    """An object detection model of transformers as a `Detector`; it is differentiable."""

    def __init__(
        self,
        model: nn.Module,
        *,
        classes: Sequence[str] | None = None,
        name: str | None = None,
        processor: Mapping[str, Any] | None = None,
    ) -> None:
        config: Any = model.config
        detects = any(kind.__name__.endswith("ForObjectDetection") for kind in type(model).__mro__)
        takes_text = "input_ids" in inspect.signature(model.forward).parameters
        expected = "a model for object detection with classes of its own, such as RTDetrForObjectDetection"
        check(detects and not takes_text, "detector", expected, type(model).__name__)
        if classes is None:
            classes = [config.id2label[index] for index in sorted(config.id2label)]
        normal, usual = config.model_type in _IMAGENET, HEADS["detr"].preprocessing
        settings: dict[str, Any] = {"do_normalize": normal, "image_mean": usual.mean, "image_std": usual.std}
        settings |= processor or {}
        size = _size(settings, _EDGES if normal else _SQUARE)
        self.resizes = bool(settings.get("do_resize", True))
        self.limits = None if self.resizes and "height" in size else size
        self.softmax = config.model_type in _SOFTMAX
        focal = getattr(config, "use_focal_loss", True)
        check(bool(focal) or self.softmax, "model", "scores trained with focal loss", f"use_focal_loss={focal}")
        sides = size.get("width") or size.get("max_width"), size.get("height") or size.get("max_height")
        longest = size.get("longest_edge") or size.get("shortest_edge") or 0
        super().__init__(
            model,
            classes,
            config.model_type if name is None else name,
            (sides[0] or longest, sides[1] or longest),
            background="own" if self.softmax else "residual",
            stretch=self.limits is None,
            digest=module_digest(model),
        )
        factor = (settings.get("rescale_factor") or 1 / 255) if settings.get("do_rescale", True) else 1.0
        self.preprocessing = Preprocessing(stretch=self.limits is None, scale=255 * factor)
        if settings["do_normalize"]:
            means = {"mean": settings["image_mean"], "std": settings["image_std"]}
            self.preprocessing = self.preprocessing.merged(means)

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's image processor does, without padding."""
        check_images(images)
        if self.limits is None:
            return letterbox(images, self.input_size, stretch=True)
        shortest, longest, highest, widest = (self.limits.get(name, math.inf) for name in (*_EDGES, *_MOST))
        scale = min(edge_scale(images, (shortest, longest)), highest / images.shape[-2], widest / images.shape[-1])
        scale = scale if self.resizes else 1.0
        return resized_images(images, scale=scale, antialias=scale < 1)

    def propose(self, canvas: Tensor) -> Candidates:
        outputs = self.model(pixel_values=self.preprocessing(self._pixels(canvas)))
        found = {name: getattr(outputs, name).to(canvas.dtype) for name in ("logits", "pred_boxes")}
        head = HEADS["detr" if self.softmax else "rtdetr"]
        candidates = head.decode(found, (canvas.shape[-1], canvas.shape[-2]), self._count)
        return keep_classes(candidates, self._places, self._count)

    def feature_modules(self) -> dict[str, nn.Module]:
        """The convolutional backbone; a model of another kind has none."""
        modules = dict(self.model.named_modules())
        ends = "conv_encoder", "backbone"
        found = [module for end in ends for name, module in modules.items() if name.rpartition(".")[2] == end]
        return {"backbone": found[0]} if found else {}

    def settings(self) -> dict[str, object]:
        own = {"softmax": self.softmax, "preprocessing": self.preprocessing.settings()}
        if self.limits is not None:
            own["edges"] = [*self.limits.values()] if self.resizes else []
        return super().settings() | own

    @classmethod
    def load(
        cls,
        name: str,
        *,
        revision: str | None = None,
        classes: Sequence[str] | None = None,
        processor: Mapping[str, Any] | None = None,
    ) -> "TransformersDetector":
        """Load an object detection model from Hugging Face's hub, with the settings of its image processor."""
        repository = name.removeprefix("hf:")
        check(bool(repository), "detector", "hf:owner/name", repr(name))
        with needing("transformers", "detector"):
            from transformers import AutoImageProcessor, AutoModelForObjectDetection
        try:
            model = AutoModelForObjectDetection.from_pretrained(
                repository, revision=revision, use_safetensors=True, trust_remote_code=False
            )
            if processor is None:
                own = AutoImageProcessor.from_pretrained(repository, revision=revision, trust_remote_code=False)
                processor = own.to_dict()
        except ImportError as error:
            raise InputError(f"detector: {name} needs a package that is not installed: {error}") from error
        except (OSError, ValueError, RuntimeError) as error:
            reason = " ".join(str(error).split())[:300]
            raise DataError(f"cannot load {name!r}: {reason}; check the name, and that it has safetensors") from error
        model.requires_grad_(False)
        return cls(model, classes=classes, name=name, processor=processor)


def _size(settings: Mapping[str, Any], usual: Mapping[str, int]) -> dict[str, int]:
    """The size of an image processor as a mapping, which older settings give as a number or `(height, width)`."""
    given = usual if settings.get("size") in (None, {}) else settings["size"]
    if isinstance(given, int):
        given = {"shortest_edge": given, "longest_edge": settings.get("max_size")}
    elif isinstance(given, list | tuple) and len(given) == 2:
        given = {"height": given[0], "width": given[1]}
    sides = given if isinstance(given, Mapping) else {}
    size = {name: value for name, value in sides.items() if value is not None}
    kinds = [{"height", "width"}, {*_MOST}, {*_EDGES}, *({name} for name in _EDGES)]
    whole = all(type(value) is int and 0 < value <= _LARGEST for value in size.values())
    wanted = "height and width, max_height and max_width, shortest_edge or longest_edge, in whole pixels"
    check(whole and set(size) in kinds, "processor size", wanted, excerpt(settings.get("size")))
    return size
