"""The interface of detectors."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace

import torch
from torch import Tensor

from semfov.detection.detections import Detections
from semfov.detection.feature_maps import FeatureMaps, no_features
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.detection.placement import Placement, letterbox
from semfov.detection.preprocessing import check_bytes
from semfov.detection.scores import HALVES, BackgroundPolicy, Candidates
from semfov.detection.selection import Selection, select
from semfov.errors import (
    InputError,
    check,
    check_pixels,
    check_whole,
    checked_keywords,
    devices_here,
    reason_of,
    type_of,
)
from semfov.io.state import StatedModule

FAINT = 0.002  # confidence from which on a candidate is a hint, unless the head has another one
LARGEST_SIDE = 65_536  # of a canvas in pixels


class Detector(StatedModule, ABC):
    """Base of detectors: from images to `Detections` with the full score vector of every box.

    A subclass implements `propose`, which takes canvases (images already fitted to the detector's input) and returns
    all boxes of its head. `forward` does everything: it fits the images, detects, and maps the boxes back. An agent
    that foveates at the detector's resolution calls `fit`, foveates the canvas and calls `detect`.

    The arguments are also attributes.

    Args:
        name: name of the model in tables and in fitted observation models.
        classes: names of the K classes, without background, in the order of the scores from index 1.
        input_size: `(width, height)` of the canvas in pixels.
        background: background policy of the scores (`semfov.detection.scores`).
        selection: settings of the selection of boxes; None for the defaults of `Selection`.
        fill: value of the canvas's padding.
        stride: pad the canvas only to a multiple of this number of pixels; None pads it to `input_size`.
        stretch: whether images are stretched to the canvas instead of letterboxed.
        corner: whether letterboxed images are in the upper left corner of the canvas instead of its middle.
        faint: least confidence of a candidate that is no detection but a hint: of where to zoom in
            (`semfov.zoom.hints`), and of what the picture holds (`Detections.highest`).
        score_threshold: least score of a listed detection; about two of three should be right.
        digest: sha256 of the weights, `""` for random weights.

    A detector that proposes the whole canvas as one box:

    >>> import torch
    >>> class Whole(Detector):
    ...     def propose(self, canvas):
    ...         height, width = canvas.shape[-2:]
    ...         boxes = canvas.new_tensor([0, 0, width, height]).expand(len(canvas), 1, 4)
    ...         return Candidates(boxes, torch.full((len(canvas), 1, 1), 0.9))
    >>> detections = Whole("whole", ("photograph",), (64, 64))(torch.rand(2, 3, 30, 40))
    >>> detections.boxes[0], detections.scores[0]
    (tensor([[ 0.,  0., 40., 30.]]), tensor([[0.1000, 0.9000]]))
    """

    _setting_names = ("classes",)

    @checked_keywords
    def __init__(
        self,
        name: str,
        classes: tuple[str, ...],
        input_size: tuple[int, int],
        *,
        background: BackgroundPolicy = "residual",
        selection: Selection | None = None,
        fill: float = 0.5,
        stride: int | None = None,
        stretch: bool = False,
        corner: bool = False,
        faint: float = FAINT,
        score_threshold: float = SCORE_THRESHOLD,
        digest: str = "",
    ) -> None:
        super().__init__()
        for side in input_size:
            check_whole(side, "input_size", 1, LARGEST_SIDE)
        if stride is not None:
            check_whole(stride, "stride", 1, LARGEST_SIDE)
        self.name = name
        self.classes = classes
        self.input_size = input_size
        self.background: BackgroundPolicy = background
        self.selection = Selection() if selection is None else selection
        self.fill = fill
        self.stride = stride
        self.stretch = stretch
        self.corner = corner
        self.faint = faint
        self.score_threshold = score_threshold
        self.digest = digest

    @abstractmethod
    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.

        Returns:
            The boxes in canvas pixels, with their scores.
        """

    def propose_bytes(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head on a canvas of bytes: `propose(canvas / 255)`.

        A detector that overrides it saves the conversion in between. What a subclass changes in the one it has to
        change in the other.

        Args:
            canvas: `(B, 3, H, W)`, RGB, bytes in any order in memory.

        Returns:
            The boxes in canvas pixels, with their scores.

        Raises:
            InputError: the canvas has another shape or dtype.
        """
        check_bytes(canvas)
        return self.propose(canvas.to(torch.get_default_dtype(), memory_format=torch.contiguous_format).div_(255))

    def propose_likely(self, canvas: Tensor, least: float) -> Candidates:
        """Compute the boxes of the head that may have a confidence: all of `propose`, or of `propose_bytes`.

        A detector that overrides it saves the work on boxes that nobody reads.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], or bytes.
            least: confidence from which on boxes are wanted, at least in one image of the batch.

        Returns:
            The boxes in canvas pixels, with their scores, in the order of `propose`; others may be among them.
        """
        return self.propose_bytes(canvas) if canvas.dtype == torch.uint8 else self.propose(canvas)

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Fit images into the detector's input.

        Args:
            images: `(B, 3, H, W)`, RGB in [0, 1].

        Returns:
            The canvas `(B, 3, h, w)`, and the placement of the images on it.
        """
        check_images(images)
        return letterbox(
            images, self.input_size, fill=self.fill, stride=self.stride, stretch=self.stretch, corner=self.corner
        )

    def detect(
        self, canvas: Tensor, placement: Placement | None = None, *, back: Callable[[Tensor], Tensor] | None = None
    ) -> Detections:
        """Detect objects on a canvas.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.
            placement: placement of the images on the canvas; None leaves boxes in canvas pixels.
            back: for a canvas whose pixels a sensor has moved: a function that maps boxes `(B, N, 4)` back to the
                canvas of `fit`.

        Returns:
            The selected boxes, in image pixels, with their score vectors; in float32 for a network in half precision.
        """
        check(len(canvas) > 0, "canvas", "at least one image", 0)
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        candidates = self.propose_likely(canvas, self._faintest).precise()
        if back is not None:
            candidates = replace(candidates, boxes=back(candidates.boxes))
        return self._select(candidates, placement)

    @property
    def _faintest(self) -> float:
        """Confidence of the faintest candidate that `Detections.highest` reads."""
        return min(self.faint, self.selection.threshold)

    def _select(self, candidates: Candidates, placement: Placement | None) -> Detections:
        """Select the detections among candidates."""
        return select(candidates, placement, self.selection, self.background, self._faintest)

    def forward(self, images: Tensor) -> Detections:
        """Detect objects in images.

        Args:
            images: `(B, 3, H, W)`, RGB in [0, 1].

        Returns:
            The selected boxes, in image pixels, with their score vectors.
        """
        canvas, placement = self.fit(images)
        return self.detect(canvas, placement)

    def features(self, images: Tensor, layers: Sequence[str] | None = None) -> FeatureMaps:
        """Detect objects in images, and keep feature maps of the same pass of the network.

        Args:
            images: `(B, 3, H, W)`, RGB in [0, 1].
            layers: names of the maps (`FeatureMaps`), or of tensors of an ONNX model or layers of a Darknet cfg; None
                for all that have a name.

        Returns:
            The maps by name, with the detections.

        Raises:
            InputError: the detector hides its feature maps, or has no map of this name.

        Example::

            semfov.load_detector("yolox-nano").features(images).maps["backbone8"]
        """
        return self.canvas_features(*self.fit(images), layers)

    def canvas_features(self, canvas: Tensor, placement: Placement, layers: Sequence[str] | None = None) -> FeatureMaps:
        """Detect objects in images that are fitted into the input already, and keep feature maps of the same pass.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.
            placement: placement of the images on it.
            layers: names of the maps, as for `features`.

        Returns:
            The maps by name, with the detections.

        Raises:
            InputError: the detector hides its feature maps, or has no map of this name.
        """
        candidates, maps = self.propose_with_features(canvas, layers)
        detections = self._select(candidates.precise(), placement)
        height, width = canvas.shape[-2:]
        return FeatureMaps(maps, (width, height), placement, detections)

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        """Compute all boxes of the head, and feature maps, in one pass.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.
            layers: names of the maps, as for `features`.

        Returns:
            The boxes in canvas pixels, with their scores, and the maps by name.

        Raises:
            InputError: the detector hides its feature maps, or has no map of this name.
        """
        raise no_features(self.name)

    def feature_maps(self, canvas: Tensor, layers: Sequence[str] | None = None) -> dict[str, Tensor]:
        """Compute the feature maps of `propose_with_features` alone.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.
            layers: names of the maps, as for `features`.

        Returns:
            The maps by name.

        Raises:
            InputError: the detector hides its feature maps, or has no map of this name.
        """
        return self.propose_with_features(canvas, layers)[1]

    def head_input(self, canvas: Tensor) -> Tensor:
        """Compute the features that the first head reads, and nothing after them.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1], from `fit`.

        Returns:
            Features `(B, C, h, w)`.

        Raises:
            InputError: the detector does not give access to them, for instance because it is an ONNX model.
        """
        raise InputError(
            f"detector: expected one that gives access to its features, such as yolov3-tiny, got {self.name}"
        )

    def check_conversion(self, convert: Callable[[Tensor], Tensor]) -> None:
        """Check what a module's tensors are to be moved or converted to, before any of them is.

        Args:
            convert: moves or converts a tensor, as `torch.nn.Module._apply` takes it.

        Raises:
            InputError: PyTorch has no such device here, or a detector without parameters would keep its precision.
        """
        try:
            converted = convert(torch.zeros(0))
        except (RuntimeError, AssertionError) as error:
            here = ", ".join(devices_here())
            reason = reason_of(error)
            raise InputError(f"device: expected one that PyTorch has here ({here}), got another: {reason}") from None
        has_parameters = any(True for _ in self.parameters())
        check(
            converted.dtype not in HALVES or has_parameters,
            "half",
            "a detector of PyTorch",
            f"{self.name}, which has no parameters; an ONNX file keeps the precision of its export",
        )

    def extra_repr(self) -> str:
        """Write the name, the number of classes and the size of the input.

        Returns:
            The words for the `repr` of the module.
        """
        width, height = self.input_size
        return f"{self.name!r}, {len(self.classes)} classes, input {width} × {height} px"

    def settings(self) -> dict[str, object]:
        """List the settings that the detections depend on, for the keys of caches and the metadata of fitted models.

        Returns:
            JSON values by name.
        """
        return {
            "name": self.name,
            "digest": self.digest,
            "input_size": list(self.input_size),
            "background": self.background,
            "selection": asdict(self.selection),
            "fill": self.fill,
            "stride": self.stride,
            "stretch": self.stretch,
        }


def check_images(images: Tensor) -> None:
    """Check that images have the form that detectors take.

    Args:
        images: `(B, 3, H, W)`, RGB in [0, 1].

    Raises:
        InputError: they have another shape or dtype, or other numbers.
    """
    is_tensor = isinstance(images, Tensor)
    check(is_tensor, "images", "a batch of tensors", f"{type_of(images)}; give semfov.as_image(picture)[None]")
    has_shape = images.ndim == 4 and images.shape[1] == 3 and images.numel() > 0
    expected = "floating-point RGB in [0, 1] of shape (B, 3, H, W), at least one image and one pixel"
    got = f"{images.dtype} of shape {tuple(images.shape)}"
    check(has_shape and images.is_floating_point(), "images", expected, got)
    check_pixels(images, "images")
