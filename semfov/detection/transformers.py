"""Object detection models of transformers (DETR, RT-DETR, D-FINE), with the full score vector of every box."""

import inspect
import math
from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from semfov.detection.detector import LARGEST_SIDE, check_images
from semfov.detection.modules import ModuleDetector, edge_scale, module_digest, resized_images
from semfov.detection.onnx_heads import HEADS
from semfov.detection.placement import Placement, letterbox
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import Candidates
from semfov.errors import DataError, InputError, check, needing, reason_of
from semfov.io.schema import excerpt

_SOFTMAX = ("detr", "table-transformer", "yolos")
"""Kinds of models whose scores are a softmax over the classes and "no object"; the others have a sigmoid each."""
_IMAGENET = ("detr", "table-transformer", "yolos", "conditional_detr", "deformable_detr", "dab-detr")
"""Kinds of models whose images are usually normalised by the mean and deviation of ImageNet."""

# Sizes of image processors, by transformers' names: usually those of DETR, or the square of RT-DETR.
_EDGES = {"shortest_edge": 800, "longest_edge": 1333}
_MOST = ("max_height", "max_width")
_SQUARE = {"height": 640, "width": 640}
_FORMS_OF_SIZE = ({"height", "width"}, {*_MOST}, {*_EDGES}, {"shortest_edge"}, {"longest_edge"})
_MOST_REASON = 300  # largest number of characters of a reason that a message has

ProcessorSettings = Mapping[str, Any]
"""Settings of an image processor of transformers, by its own names."""


class TransformersDetector(ModuleDetector):
    """An object detection model of transformers as a `Detector`; it is differentiable.

    Attributes:
        resizes: whether its image processor resizes images.
        limits: sizes between which it keeps the proportions of an image; None where it stretches images to one size.
        softmax: whether its scores are a softmax over the classes and "no object".
        preprocessing: what the network expects of its input.
    """

    def __init__(
        self,
        model: nn.Module,
        *,
        classes: Sequence[str] | None = None,
        name: str | None = None,
        processor: ProcessorSettings | None = None,
    ) -> None:
        _check_model(model)
        config: Any = model.config
        if classes is None:
            classes = [config.id2label[index] for index in sorted(config.id2label)]
        settings = _with_usual_settings(processor or {}, config.model_type)
        size = _processor_size(settings)
        has_softmax = _has_softmax(config.model_type, focal_loss=getattr(config, "use_focal_loss", True))
        resizes = bool(settings.get("do_resize", True))
        stretches = resizes and "height" in size
        super().__init__(
            model,
            classes,
            config.model_type if name is None else name,
            _largest_canvas(size),
            background="own" if has_softmax else "residual",
            stretch=stretches,
            digest=module_digest(model),
        )
        self.resizes = resizes
        self.limits = None if stretches else size
        self.softmax = has_softmax
        self.preprocessing = _preprocessing_of(settings, stretch=stretches)

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Resize images `(B, 3, H, W)`, RGB in [0, 1], as the model's image processor does, without padding."""
        check_images(images)
        if self.limits is None:
            return letterbox(images, self.input_size, stretch=True)
        if not self.resizes:
            return resized_images(images, scale=1.0, antialias=False)
        shortest, longest, highest, widest = (self.limits.get(name, math.inf) for name in (*_EDGES, *_MOST))
        height, width = images.shape[-2:]
        scale = min(edge_scale(images, (shortest, longest)), highest / height, widest / width)
        return resized_images(images, scale=scale, antialias=scale < 1)

    def propose(self, canvas: Tensor) -> Candidates:
        outputs = self.model(pixel_values=self.preprocessing(self._pixels(canvas)))
        queries = {name: getattr(outputs, name).to(canvas.dtype) for name in ("logits", "pred_boxes")}
        head = HEADS["detr" if self.softmax else "rtdetr"]
        candidates = head.decode(queries, (canvas.shape[-1], canvas.shape[-2]), self._count)
        return self._of_classes(candidates)

    def feature_modules(self) -> dict[str, nn.Module]:
        """Find the convolutional backbone; a model of another kind has none."""
        for end in ("conv_encoder", "backbone"):
            for name, module in self.model.named_modules():
                if name.rpartition(".")[2] == end:
                    return {"backbone": module}
        return {}

    def settings(self) -> dict[str, object]:
        settings = super().settings()
        settings |= {"softmax": self.softmax, "preprocessing": self.preprocessing.settings()}
        if self.limits is not None:
            settings["edges"] = [*self.limits.values()] if self.resizes else []
        return settings

    @classmethod
    def load(
        cls,
        name: str,
        *,
        revision: str | None = None,
        classes: Sequence[str] | None = None,
        processor: ProcessorSettings | None = None,
    ) -> "TransformersDetector":
        """Load an object detection model from Hugging Face's hub.

        Args:
            name: `owner/name`, with or without `hf:` before it.
            revision: its branch, tag or commit; None for the newest.
            classes: names of its classes; None for its own.
            processor: settings of its image processor; None for its own.

        Returns:
            The detector.

        Raises:
            InputError: a package is not installed.
            DataError: there is no such model, or it cannot be loaded without running code of its own.
        """
        repository = name.removeprefix("hf:")
        check(bool(repository), "detector", "hf:owner/name", repr(name))
        with needing("transformers", "detector"):
            from transformers import AutoImageProcessor, AutoModelForObjectDetection
        try:
            model = AutoModelForObjectDetection.from_pretrained(
                repository, revision=revision, use_safetensors=True, trust_remote_code=False
            )
            if processor is None:
                loaded = AutoImageProcessor.from_pretrained(repository, revision=revision, trust_remote_code=False)
                processor = loaded.to_dict()
        except ImportError as error:
            raise InputError(f"detector: {name} needs a package that is not installed: {error}") from error
        except (OSError, ValueError, RuntimeError) as error:
            reason = reason_of(error)[:_MOST_REASON]
            raise DataError(f"cannot load {name!r}: {reason}; check the name, and that it has safetensors") from error
        model.requires_grad_(False)
        return cls(model, classes=classes, name=name, processor=processor)


def _check_model(model: nn.Module) -> None:
    """Raise `InputError` unless a model detects objects of classes of its own."""
    detects = any(kind.__name__.endswith("ForObjectDetection") for kind in type(model).__mro__)
    # Models that find what a text describes have no classes.
    takes_text = "input_ids" in inspect.signature(model.forward).parameters
    expected = "a model for object detection with classes of its own, such as RTDetrForObjectDetection"
    check(detects and not takes_text, "detector", expected, type(model).__name__)


def _has_softmax(kind: str, *, focal_loss: object) -> bool:
    """Tell whether the scores of a kind of model are a softmax over the classes and "no object"."""
    if kind in _SOFTMAX:
        return True
    # A model of another kind that is trained without focal loss would have a softmax, too.
    check(bool(focal_loss), "model", "scores trained with focal loss", f"use_focal_loss={focal_loss}")
    return False


def _with_usual_settings(processor: ProcessorSettings, kind: str) -> dict[str, Any]:
    """Complete the settings of an image processor by those that are usual for a kind of model."""
    imagenet = kind in _IMAGENET
    normalisation = HEADS["detr"].preprocessing
    settings = {"do_normalize": imagenet, "image_mean": normalisation.mean, "image_std": normalisation.std, **processor}
    if settings.get("size") in (None, {}):
        settings["size"] = _EDGES if imagenet else _SQUARE
    return settings


def _preprocessing_of(settings: ProcessorSettings, *, stretch: bool) -> Preprocessing:
    """Read from an image processor's settings what the network expects of its input."""
    # A processor takes bytes, which it rescales; a canvas is in [0, 1].
    factor = 1.0
    if settings.get("do_rescale", True):
        factor = settings.get("rescale_factor") or 1 / 255
    preprocessing = Preprocessing(stretch=stretch, scale=255 * factor)
    if settings["do_normalize"]:
        return preprocessing.merged({"mean": settings["image_mean"], "std": settings["image_std"]})
    return preprocessing


def _processor_size(settings: ProcessorSettings) -> dict[str, int]:
    """Read the size of an image processor as a mapping from names of sides to pixels."""
    stated = settings["size"]
    size = {name: side for name, side in _named_sides(stated, settings).items() if side is not None}
    expected = "height and width, max_height and max_width, shortest_edge or longest_edge, in whole pixels"
    is_form = set(size) in _FORMS_OF_SIZE
    check(is_form and all(map(_is_side, size.values())), "processor size", expected, excerpt(stated))
    return size


def _named_sides(stated: object, settings: ProcessorSettings) -> Mapping[str, int | None]:
    """Name the sides of a size, which older settings give as a number or `(height, width)`; empty for other forms."""
    if isinstance(stated, Mapping):
        return stated
    if isinstance(stated, int):
        return {"shortest_edge": stated, "longest_edge": settings.get("max_size")}
    if isinstance(stated, list | tuple) and len(stated) == 2:
        height, width = stated
        return {"height": height, "width": width}
    return {}


def _is_side(value: object) -> bool:
    """Tell whether a value is a side of a canvas in pixels; True is a whole number for Python, and no side."""
    return type(value) is int and 0 < value <= LARGEST_SIDE


def _largest_canvas(size: Mapping[str, int]) -> tuple[int, int]:
    """Find the largest `(width, height)` that an image processor makes of an image."""
    longest = size.get("longest_edge") or size.get("shortest_edge") or 0
    width = size.get("width") or size.get("max_width") or longest
    height = size.get("height") or size.get("max_height") or longest
    return width, height
