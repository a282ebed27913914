"""Detectors from ONNX models of common families, with the full score vector of every box."""

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from semfov.detection.class_names import COCO_CLASSES, UnnamedClasses, keep_classes, named_outputs
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import chosen, landmarks
from semfov.detection.onnx_check import check_file
from semfov.detection.onnx_file import check_canvas, names_beside, read_settings, with_input_size
from semfov.detection.onnx_heads import HEADS, Signature, misplaced
from semfov.detection.onnx_session import OnnxSession
from semfov.detection.preprocessing import Preprocessing
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.weights import WEIGHTS, fetch
from semfov.errors import InputError, check, check_data, check_shape, lookup, values_known
from semfov.io.compatibility import NETWORKS
from semfov.io.files import inside, json_sha256, sha256
from semfov.io.schema import excerpt

_ONNX_MODELS = tuple(name for name, weights in WEIGHTS.items() if weights.file.endswith(".onnx"))
"""Published models that `load_onnx` knows by name. They have a fixed input, whose size can be changed all the same."""

_ROUNDING = 0.02  # how far beyond 0 and 1 the scores of networks of 8 and 16 bits may lie
_MOST_BOXES = 2**20  # largest number of boxes of a canvas; YOLOv5 has 102,000 for 1280 px


class OnnxDetector(Detector):
    """A model in onnxruntime as a `Detector`; gradients do not flow through it; input_size `(width, height)`."""

    def __init__(
        self,
        session: OnnxSession,
        head: str,
        classes: Sequence[str],
        *,
        name: str = "onnx",
        input_size: tuple[int, int] | None = None,
        stride: int | None = None,
        preprocessing: Preprocessing | None = None,
        logits: bool = False,
        background: BackgroundPolicy | None = None,
        digest: str = "",
    ) -> None:
        family = HEADS[lookup(head, HEADS, "head")]
        names, places = named_outputs(classes)
        preprocessing = family.preprocessing if preprocessing is None else preprocessing
        super().__init__(
            name,
            names,
            _canvas_size(session, input_size),
            background=family.background if background is None else background,
            fill=preprocessing.fill,
            stride=stride,
            stretch=preprocessing.stretch,
            corner=preprocessing.corner,
            faint=family.faint,
            least=family.least,
            digest=digest,
        )
        fixed = None not in session.shape[2:]
        check(stride is None or not fixed, "stride", "None for a model with a fixed input size", stride)
        self.session, self.head, self.preprocessing, self.logits = session, head, preprocessing, logits
        self._places, self._scores = places, len(classes)
        self._placed = self._rounded = False
        self._layers: dict[str, str] | None = None
        self._named_layers: tuple[str, ...] = ()
        self._wide = session

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        self._check_canvas(canvas)
        check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
        return self._run(self.preprocessing(canvas.detach()))

    def propose_bytes(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head on a canvas of bytes `(B, 3, H, W)`, converted directly to the input."""
        self._check_canvas(canvas)
        return self._run(self.preprocessing.of_bytes(canvas))

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        outputs, maps = self._outputs(canvas, layers)
        own = {name: outputs[name] for name, _ in self.session.outputs}
        return self.decode(own, (canvas.shape[-1], canvas.shape[-2])), maps

    def feature_maps(self, canvas: Tensor, layers: Sequence[str] | None = None) -> dict[str, Tensor]:
        return self._outputs(canvas, layers)[1]

    def _outputs(self, canvas: Tensor, layers: Sequence[str] | None) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """The outputs and the maps by name, in one run of a session that has the maps as further outputs."""
        self._check_canvas(canvas)
        if self._layers is None:
            steps = self.session.steps((canvas.shape[-1], canvas.shape[-2]))
            inside = {step.name: step.name for step in steps if step.stride is not None}
            self._layers, self._named_layers = inside | landmarks(steps), tuple(landmarks(steps))
        wanted = self._named_layers if layers is None else layers
        tensors = {layer: self._layers[layer] for layer in chosen(wanted, [*self._layers], self.name)}
        if not set(tensors.values()) <= {name for name, _ in self._wide.outputs}:
            self._wide = self.session.widened([*tensors.values()])
        outputs = self._wide(self.preprocessing(canvas.detach()))
        return outputs, {layer: outputs[name] for layer, name in tensors.items()}

    def _check_canvas(self, canvas: Tensor) -> None:
        """Raise `InputError` for a canvas of another shape than the network takes."""
        check_shape(canvas, "canvas", None, 3, None, None)
        (height, width), (high, wide) = self.session.shape[2:], canvas.shape[-2:]
        way = "a sensor with crops needs crops of that side, or a network that takes pictures of any size"
        fits = height in (None, high) and width in (None, wide)
        fixed = f"{width} × {height} px, the fixed input of {self.name}"
        check(fits, "canvas", fixed, f"{wide} × {high} px; {way}")

    def _run(self, image: Tensor) -> Candidates:
        """Run the network on its input `(B, 3, H, W)`, and decode what it returns."""
        return self.decode(self.session(image), (image.shape[-1], image.shape[-2]))

    def decode(self, outputs: dict[str, Tensor], size: tuple[int, int]) -> Candidates:
        """Decode the outputs of the network, given by name, for a canvas of `(width, height)`."""
        candidates = HEADS[self.head].decode(outputs, size, self._scores)
        count = candidates.boxes.shape[1]
        check_data(count <= _MOST_BOXES, self.name, f"at most {_MOST_BOXES:,} boxes", f"{count:,}")
        first = not self._placed and values_known(candidates.boxes, candidates.classes)
        if first:
            self._check_first(outputs, candidates, size)
        if self.logits:
            objectness = None if candidates.objectness is None else candidates.objectness.sigmoid()
            candidates = replace(candidates, classes=candidates.classes.sigmoid(), objectness=objectness)
        if values_known(candidates.boxes):
            named = f"with head {self.head!r}; check that head= names the model's head"
            check_data(all(map(math.isfinite, _range(candidates.boxes))), self.name, "finite boxes", f"others {named}")
            candidates = self._rounded_scores(candidates)
        self._placed |= first
        return keep_classes(candidates, self._places, self._scores)

    def _rounded_scores(self, candidates: Candidates) -> Candidates:
        """Clamp scores that rounding has put a little outside [0, 1], with one warning."""
        scores = [each for each in (candidates.classes, candidates.objectness) if each is not None]
        lows, highs = zip(*map(_range, scores), strict=True)
        low, high = min(lows), max(highs)
        way = "set logits=True if the model returns them before the sigmoid"
        got = f"[{low:.3g}, {high:.3g}]; {way}, and check that its head is {self.head!r}"
        check_data(low >= -_ROUNDING and high <= 1 + _ROUNDING, self.name, "scores in [0, 1]", got)
        if low >= 0 and high <= 1:
            return candidates
        if not self._rounded:
            warnings.warn(
                f"{self.name}: scores from {low:.7g} to {high:.7g}, which rounding explains, are taken as 0 to 1",
                stacklevel=2,
            )
        self._rounded = True
        objectness = None if candidates.objectness is None else candidates.objectness.clamp(0, 1)
        return replace(candidates, classes=candidates.classes.clamp(0, 1), objectness=objectness)

    def _check_first(self, outputs: dict[str, Tensor], candidates: Candidates, size: tuple[int, int]) -> None:
        """Raise `DataError` where the numbers of the first pass show another head or scores after their sigmoid."""
        logits = [each for name, each in outputs.items() if name.endswith("logits")]
        before, way = "softmax or sigmoid", "export the model without it"
        if self.logits:
            logits, before, way = [candidates.classes], "sigmoid", "set logits=False"
        for each in logits:
            low, high = _range(each)
            got = f"[{low:.3g}, {high:.3g}]; {way}"
            check_data(not 0 <= low < high <= 1, self.name, f"scores before the {before}", got)
        wrong = misplaced(candidates.boxes, size)
        expected = f"boxes on a canvas of {size[0]} x {size[1]} px with head {self.head!r}"
        check_data(wrong is None, self.name, expected, wrong)

    def settings(self) -> dict[str, object]:
        own = {"head": self.head, "logits": self.logits, "preprocessing": self.preprocessing.settings()}
        providers = self.session.providers
        return super().settings() | own | ({} if providers is None else {"providers": list(providers)})


def _range(numbers: Tensor) -> tuple[float, float]:
    """Least and greatest number in one pass, which are NaN where one of them is."""
    low, high = numbers.aminmax() if numbers.numel() else (0.0, 0.0)
    return float(low), float(high)


def _model_digest(path: Path) -> str:
    """sha256 of a model's file; with weights in other files, of all of them."""
    import onnx

    stored = onnx.load(path, load_external_data=False).graph.initializer
    others = {entry.value for tensor in stored for entry in tensor.external_data if entry.key == "location"}
    digests = [sha256(path), *(sha256(inside(path.parent, name)) for name in sorted(others))]
    return digests[0] if len(digests) == 1 else json_sha256(digests)


def load_onnx(
    name_or_path: str | PathLike[str],
    *,
    weights: str | PathLike[str] | None = None,
    head: str | None = None,
    classes: Sequence[str] | None = None,
    input_size: int | tuple[int, int] | None = None,
    stride: int | None = None,
    preprocessing: Preprocessing | Mapping[str, Any] | None = None,
    logits: bool | None = None,
    threads: int | None = None,
    device: torch.device | str = "cpu",
    providers: Sequence[str | tuple[str, Mapping[str, Any]]] | None = None,
) -> OnnxDetector:
    """Load a detector from an ONNX file, or a published one by its name."""
    name = fspath(name_or_path)
    file = Path(name if weights is None else weights)
    if name in _ONNX_MODELS:
        file = fetch(name) if weights is None else file
    elif weights is not None or not name.endswith(".onnx"):
        lookup(name, _ONNX_MODELS, "ONNX model")
    published_name = name if name in _ONNX_MODELS else NETWORKS.get(sha256(file) if file.is_file() else "")
    path = file
    if published_name in _ONNX_MODELS and input_size is not None:
        path = with_input_size(file, _sides(input_size))
    session = OnnxSession(path, threads=threads, device=device, providers=providers)
    stored = read_settings(file, session.metadata)
    options = {"head": head, "classes": classes, "input_size": input_size, "stride": stride, "logits": logits}
    options["name"] = published_name
    chosen = stored | {key: value for key, value in options.items() if value is not None}
    size = _canvas_size(session, chosen.get("input_size"))
    if None in session.shape[2:]:
        check_file(path, size)
    outputs = session.probe(size)
    names = chosen.get("classes")
    beside = names_beside(file) if names is None and published_name is None else None
    if "head" not in chosen:
        # A pass tells apart heads whose shapes are alike.
        shapes = tuple((output, tuple(tensor.shape)) for output, tensor in outputs.items())
        count = len(COCO_CLASSES if names is None else names) if names or published_name else None
        grey = torch.full((1, 3, size[1], size[0]), 0.5)
        signature = Signature(session.image, shapes, size, session.producer, count, session.metadata)
        chosen["head"] = signature.head(lambda: session(grey))
    head_kind = HEADS[lookup(chosen["head"], HEADS, "head")]
    if not isinstance(preprocessing, Preprocessing):
        default = head_kind.preprocessing.merged(stored["preprocessing"])
        preprocessing = default.merged({} if preprocessing is None else preprocessing)
    if names is None and chosen["head"].startswith("end2end") and beside is not None:
        names = beside[1]  # its outputs do not tell how many classes there are
    try:
        scores = head_kind.decode(outputs, size, None if names is None else len(names)).classes.shape[-1]
    except (KeyError, IndexError, RuntimeError, TypeError, StopIteration) as error:
        listed = ", ".join(f"{output} {tuple(tensor.shape)}" for output, tensor in outputs.items())
        raise InputError(
            f"head: expected the model's head, got {chosen['head']!r}, which does not fit the outputs {listed[:300]}"
        ) from error
    check(scores > 0, "outputs", "at least one score", f"{scores} with head {chosen['head']!r}")
    if chosen["head"].startswith("end2end"):
        warnings.warn(
            f"{file.name} selects boxes itself and returns one class of each, so all other scores are 0; exported with "
            "end2end=False (and without NMS or top-k) it has all scores, from which beliefs learn more",
            stacklevel=2,
        )
    if names is None:
        names = beside[1] if beside is not None and len(beside[1]) == scores else _coco_names(scores, file)
    check(len(names) == scores, "classes", f"{scores} names, one for each score", len(names))
    detector = OnnxDetector(
        session,
        chosen["head"],
        names,
        name=chosen.get("name") or file.stem,
        input_size=size,
        stride=chosen.get("stride"),
        preprocessing=preprocessing,
        logits=chosen.get("logits", False),
        background=chosen.get("background"),
        digest=_model_digest(file),
    )
    detector.selection = replace(detector.selection, per_class=chosen.get("per_class", False))
    return detector


def _canvas_size(session: OnnxSession, input_size: int | Sequence[int] | None) -> tuple[int, int]:
    """`(width, height)` of a model's canvas: its fixed size, or the wanted size of a model that takes any."""
    height, width = session.shape[2:]
    if input_size is None:
        if height is None or width is None:
            raise InputError(f"input_size: expected (width, height), as {session.path.name} takes any size, got None")
        check_canvas(session.path.name, (width, height))
        return width, height
    sizes = _sides(input_size)
    check_canvas("input_size", sizes)
    fits = width in (None, sizes[0]) and height in (None, sizes[1])
    check(fits, "input_size", f"the model's fixed size, {width} x {height}", sizes)
    return sizes


def _sides(input_size: int | Sequence[int]) -> tuple[int, int]:
    """`(width, height)` of one side or two."""
    sizes = (input_size, input_size) if isinstance(input_size, int) else tuple(input_size)
    whole = len(sizes) == 2 and all(isinstance(n, int) and n > 0 for n in sizes)
    check(whole, "input_size", "(width, height) in pixels", excerpt(sizes))
    return sizes[0], sizes[1]


def _coco_names(count: int, file: Path) -> Sequence[str]:
    """Names of 80 scores (COCO's classes) or of 91 scores (COCO's category ids with their gaps)."""
    if count == 80:
        return COCO_CLASSES
    if count == 91:
        from torchvision.models.detection import FasterRCNN_ResNet50_FPN_Weights

        return FasterRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
    raise UnnamedClasses(count, file)
