"""The interface that every detector keeps."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import asdict, replace

from torch import Tensor, nn

from semfov.detection.detections import Detections
from semfov.detection.placement import Placement, letterbox
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.selection import Selection, select
from semfov.errors import InputError, check, check_pixels, check_whole

_LARGEST = 65_536  # pixels of a side


class Detector(nn.Module, ABC):
    """Turns images into `Detections` with the full score vector of every box that is kept.

    An adapter implements `propose`, which sees canvases (images already fitted to its input) and returns every
    candidate of its head. `forward` does the whole: fit, detect, map the boxes back. An agent that foveates at the
    detector's resolution calls `fit`, foveates the canvas and calls `detect` itself.

    Attributes:
        name: what the model is called in tables and in fitted observation models.
        classes: names of the K classes, without background, in the order of the scores from index 1.
        input_size: `(width, height)` of the canvas.
        background: the background policy of the scores (`semfov.detection.scores`).
        selection: which candidates are kept.
        fill: padding value of the canvas.
        stride: the canvas is padded to a multiple of it only; None pads to `input_size`.
        stretch: whether images are stretched to the canvas instead of letterboxed.
        digest: sha256 of the weights, `""` where there is none (random weights).
    """

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
        digest: str = "",
    ) -> None:
        super().__init__()
        for side in input_size:
            check_whole(side, "input_size", 1, _LARGEST)
        if stride is not None:
            check_whole(stride, "stride", 1, _LARGEST)
        self.name = name
        self.classes = classes
        self.input_size = input_size
        self.background: BackgroundPolicy = background
        self.selection = Selection() if selection is None else selection
        self.fill = fill
        self.stride = stride
        self.stretch = stretch
        self.digest = digest

    @abstractmethod
    def propose(self, canvas: Tensor) -> Candidates:
        """Every box of the head on a canvas `(B, 3, H, W)`, RGB in [0, 1], as `fit` makes it."""

    def fit(self, images: Tensor) -> tuple[Tensor, Placement]:
        """Fit images `(B, 3, H, W)`, RGB in [0, 1], into the input: the canvas and where the image lies on it."""
        check_images(images)
        return letterbox(images, self.input_size, fill=self.fill, stride=self.stride, stretch=self.stretch)

    def detect(
        self,
        canvas: Tensor,
        placement: Placement | None = None,
        *,
        back: Callable[[Tensor], Tensor] | None = None,
    ) -> Detections:
        """Detections on a canvas from `fit`, boxes in pixels of the image that `placement` tells.

        Args:
            canvas: `(B, 3, H, W)`, RGB in [0, 1].
            placement: where the image lies on the canvas; without one, boxes stay in canvas pixels.
            back: leads boxes `(B, N, 4)` of a canvas whose pixels were moved back to where they were on that of `fit`.
        """
        check(len(canvas) > 0, "canvas", "at least one image", 0)
        candidates = self.propose(canvas)
        if back is not None:
            candidates = replace(candidates, boxes=back(candidates.boxes))
        return select(candidates, placement, self.selection, self.background)

    def forward(self, images: Tensor) -> Detections:
        """Detections in images `(B, 3, H, W)`, RGB in [0, 1], boxes in pixels of those images."""
        canvas, placement = self.fit(images)
        return self.detect(canvas, placement)

    def features(self, canvas: Tensor) -> Tensor:
        """Features of a canvas from `fit`, `(B, C, h, w)`, on which the first head works.

        Raises:
            InputError: they are not at hand, as within an ONNX model.
        """
        raise InputError(f"detector: expected one whose features are at hand, such as yolov3-tiny, got {self.name}")

    def settings(self) -> dict[str, object]:
        """What the detections depend on, for the keys of caches and the metadata of fitted models."""
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
    """Raise `InputError` unless `images` are what every detector takes."""
    fits = images.ndim == 4 and images.shape[1] == 3 and images.numel() > 0 and images.is_floating_point()
    what = "floating-point RGB in [0, 1] of shape (B, 3, H, W), at least one image and one pixel"
    check(fits, "images", what, f"{images.dtype} of shape {tuple(images.shape)}")
    check_pixels(images, "images")
