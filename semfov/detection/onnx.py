"""Detectors from ONNX models of common families, with the full score vector of every box."""

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor

from semfov.detection.class_names import (
    COCO_CATEGORIES,
    COCO_CLASSES,
    UnnamedClasses,
    coco_categories,
    keep_classes,
    named_outputs,
    without_placeholders,
)
from semfov.detection.detector import Detector
from semfov.detection.feature_maps import choose_layers, landmarks
from semfov.detection.onnx_cells import Canvas
from semfov.detection.onnx_check import check_file, places_of_weights
from semfov.detection.onnx_file import OnnxSettings, check_canvas, names_beside, read_settings, with_input_size
from semfov.detection.onnx_heads import HEADS
from semfov.detection.onnx_recognition import MISFITS, explain_misplacement, recognise, remedy_of_head
from semfov.detection.onnx_session import OnnxSession, Provider
from semfov.detection.onnx_signature import Signature
from semfov.detection.preprocessing import Preprocessing, check_bytes
from semfov.detection.scores import BackgroundPolicy, Candidates
from semfov.detection.weights import WEIGHTS, fetch
from semfov.errors import InputError, check, check_data, check_shape, lookup, values_known
from semfov.io.compatibility import NETWORKS
from semfov.io.files import inside, json_sha256, sha256
from semfov.io.schema import excerpt

_ONNX_MODELS = tuple(name for name, weights in WEIGHTS.items() if weights.file.endswith(".onnx"))
"""Published models that `load_onnx` knows by name. They have a fixed input, whose size can be changed all the same."""

_AS_BYTES = Preprocessing(scale=255.0)
"""Preprocessing of a model whose input are bytes; the order of channels and the padding may be others."""

_ROUNDING = 0.02  # how far beyond 0 and 1 the scores of networks of 8 and 16 bits may lie
_MOST_BOXES = 2**20  # largest number of boxes of a canvas; YOLOv5 has 102,000 for 1280 px
_MOST_LISTED = 300  # largest number of characters of the outputs that a message lists


class OnnxDetector(Detector):
    """A model in onnxruntime as a `Detector`; gradients do not flow through it; input_size `(width, height)`.

    Attributes:
        session: the model.
        head: name of its head, in `HEADS`.
        preprocessing: what the network expects of its input.
        logits: whether the head returns scores before their sigmoid.

    Private attributes: `_places` are the scores of the head that stand for a class, among `_scores` of them.
    `_first_checked` becomes true after the first pass whose values could be read, and `_rounding_told` with the
    warning of scores a little outside [0, 1]; either happens once. `_maps` are found by the first call that asks for
    maps. `_map_session` is `session`, or one of the same model that also returns the maps asked for last.
    """

    def __init__(
        self,
        session: OnnxSession,
        head: str,
        classes: Sequence[str],
        *,
        name: str,
        input_size: Canvas,
        stride: int | None,
        preprocessing: Preprocessing,
        logits: bool,
        background: BackgroundPolicy | None,
        digest: str,
    ) -> None:
        kind = HEADS[head]
        names, places = named_outputs(classes)
        _check_bytes_alone(session, preprocessing)
        super().__init__(
            name,
            names,
            input_size,
            background=kind.background if background is None else background,
            fill=preprocessing.fill,
            stride=stride,
            stretch=preprocessing.stretch,
            corner=preprocessing.corner,
            faint=kind.faint,
            score_threshold=kind.score_threshold,
            digest=digest,
        )
        # A model with a fixed input takes the whole canvas, however much of it is padding.
        fixed = None not in session.shape[2:]
        check(stride is None or not fixed, "stride", "None for a model with a fixed input size", stride)
        self.session = session
        self.head = head
        self.preprocessing = preprocessing
        self.logits = logits
        self._places = places
        self._scores = len(classes)
        self._first_checked = False
        self._rounding_told = False
        self._maps: _Maps | None = None
        self._map_session = session

    def extra_repr(self) -> str:
        """Write the name, the number of classes, the size of the input and the head."""
        return f"{super().extra_repr()}, head {self.head}"

    def propose(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head on a canvas `(B, 3, H, W)`, RGB in [0, 1]."""
        return self._propose(_checked_floats(canvas), 0.0)

    def propose_bytes(self, canvas: Tensor) -> Candidates:
        """Compute all boxes of the head on a canvas of bytes `(B, 3, H, W)`, converted directly to the input."""
        check_bytes(canvas)
        return self._propose(canvas, 0.0)

    def propose_likely(self, canvas: Tensor, least: float) -> Candidates:
        """Compute the boxes of the head that may have a confidence; after the first pass few others are decoded."""
        kind = type(self)
        if kind.propose is not OnnxDetector.propose or kind.propose_bytes is not OnnxDetector.propose_bytes:
            return super().propose_likely(canvas, least)  # a subclass computes its boxes in its own way
        return self._propose(canvas, least)

    def _propose(self, canvas: Tensor, least: float) -> Candidates:
        """Compute the boxes of the head that may have a confidence."""
        self._check_canvas(canvas)
        if canvas.dtype == torch.uint8:
            image = self.preprocessing.of_bytes(canvas)
        else:
            image = self.preprocessing(_checked_floats(canvas).detach())
        return self.decode(self.session(image), (image.shape[-1], image.shape[-2]), least)

    def propose_with_features(
        self, canvas: Tensor, layers: Sequence[str] | None = None
    ) -> tuple[Candidates, dict[str, Tensor]]:
        outputs, maps = self._outputs_and_maps(canvas, layers)
        # Heads are found by the names and the number of outputs, to which maps do not belong.
        head_outputs = {name: outputs[name] for name, _ in self.session.outputs}
        return self.decode(head_outputs, (canvas.shape[-1], canvas.shape[-2])), maps

    def feature_maps(self, canvas: Tensor, layers: Sequence[str] | None = None) -> dict[str, Tensor]:
        _, maps = self._outputs_and_maps(canvas, layers)
        return maps

    def _outputs_and_maps(
        self, canvas: Tensor, layers: Sequence[str] | None
    ) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
        """Compute outputs and maps, by name, in one run of a session that has the maps as further outputs."""
        self._check_canvas(canvas)
        tensors = self._map_tensors(canvas, layers)
        # A further output is copied in every run, so a session returns only those that were asked for last.
        if not set(tensors.values()) <= {name for name, _ in self._map_session.outputs}:
            self._map_session = self.session.with_outputs([*tensors.values()])
        outputs = self._map_session(self.preprocessing(canvas.detach()))
        return outputs, {layer: outputs[tensor] for layer, tensor in tensors.items()}

    def _map_tensors(self, canvas: Tensor, layers: Sequence[str] | None) -> dict[str, str]:
        """Find the tensors inside the model that are the maps of layers, all with a place if None; by layer."""
        if self._maps is None:
            steps = self.session.steps((canvas.shape[-1], canvas.shape[-2]))
            self._maps = _Maps(landmarks(steps), [step.name for step in steps if step.stride is not None])
        tensors = self._maps.by_layer()
        wanted = self._maps.by_place if layers is None else layers
        return {layer: tensors[layer] for layer in choose_layers(wanted, [*tensors], self.name)}

    def _check_canvas(self, canvas: Tensor) -> None:
        """Raise `InputError` for a canvas of another shape than the network takes."""
        check_shape(canvas, "canvas", None, 3, None, None)
        height, width = self.session.shape[2:]
        rows, columns = canvas.shape[-2:]
        fixed = f"{width} × {height} px, the fixed input of {self.name}"
        remedy = "a sensor with crops needs crops of that side, or a network that takes pictures of any size"
        check(_takes(self.session, (columns, rows)), "canvas", fixed, f"{columns} × {rows} px; {remedy}")

    def decode(self, outputs: dict[str, Tensor], size: Canvas, least: float = 0.0) -> Candidates:
        """Decode the outputs of the network.

        Args:
            outputs: the outputs by name.
            size: `(width, height)` of the canvas.
            least: confidence from which on boxes are wanted; most others are left out after the first pass, which is
                checked as a whole.

        Returns:
            The boxes, with the scores of the classes.

        Raises:
            DataError: the numbers cannot be those of this head.
        """
        is_whole = self.logits or not self._first_checked  # logits are no bound of a confidence
        candidates = HEADS[self.head].decode(outputs, size, self._scores, 0.0 if is_whole else least)
        count = candidates.boxes.shape[1]
        check_data(count <= _MOST_BOXES, self.name, f"at most {_MOST_BOXES:,} boxes", f"{count:,}")
        are_known = values_known(candidates.boxes, candidates.classes)  # not in a graph that is traced
        # A wrong head shows in the first pass, so later ones spend no time on it.
        if are_known and not self._first_checked:
            self._check_first(outputs, candidates, size)
        if self.logits:
            candidates = _with_scores(candidates, Tensor.sigmoid)
        if not are_known:
            return keep_classes(candidates, self._places, self._scores)
        are_finite = all(map(math.isfinite, _range(candidates.boxes)))
        remedy = f"others with head {self.head!r}; check that head= names the model's head"
        check_data(are_finite, self.name, "finite boxes", remedy)
        candidates = self._rounded_scores(candidates)
        self._first_checked = True
        return keep_classes(candidates, self._places, self._scores).as_checked()

    def _rounded_scores(self, candidates: Candidates) -> Candidates:
        """Clamp scores that rounding has put a little outside [0, 1], with one warning."""
        least, greatest = _score_range(candidates)
        remedy = "set logits=True if the model returns them before the sigmoid"
        got = f"[{least:.3g}, {greatest:.3g}]; {remedy}, and check that its head is {self.head!r}"
        check_data(least >= -_ROUNDING and greatest <= 1 + _ROUNDING, self.name, "scores in [0, 1]", got)
        if least >= 0 and greatest <= 1:
            return candidates
        if not self._rounding_told:
            warnings.warn(
                f"{self.name}: scores from {least:.7g} to {greatest:.7g}, which rounding explains, are taken as 0 to 1",
                stacklevel=2,
            )
        self._rounding_told = True
        return _with_scores(candidates, lambda scores: scores.clamp(0, 1))

    def _check_first(self, outputs: dict[str, Tensor], candidates: Candidates, size: Canvas) -> None:
        """Raise `DataError` where the numbers of the first pass show another head or scores after their sigmoid."""
        for name, output in outputs.items():
            # With logits=True, what is taken as logits are the scores of the head.
            if name.endswith("logits") and not self.logits:
                self._check_logits(output, "softmax or sigmoid", "export the model without it")
        if self.logits:
            self._check_logits(candidates.classes, "sigmoid", "set logits=False")
        reason = explain_misplacement(candidates.boxes, size, lambda: remedy_of_head(outputs, size, self._scores))
        expected = f"boxes on a canvas of {size[0]} x {size[1]} px with head {self.head!r}"
        check_data(reason is None, self.name, expected, reason)

    def _check_logits(self, logits: Tensor, function: str, remedy: str) -> None:
        """Raise `DataError` for numbers that a function has brought into [0, 1] already."""
        least, greatest = _range(logits)
        got = f"[{least:.3g}, {greatest:.3g}]; {remedy}"
        check_data(not 0 <= least < greatest <= 1, self.name, f"scores before the {function}", got)

    def settings(self) -> dict[str, object]:
        settings = super().settings()
        settings |= {"head": self.head, "logits": self.logits, "preprocessing": self.preprocessing.settings()}
        if self.session.providers is not None:
            settings["providers"] = list(self.session.providers)
        return settings


class _Maps(NamedTuple):
    """The maps inside a model: names of tensors by their place in the network, and the names of all that are maps."""

    by_place: dict[str, str]
    tensors: list[str]

    def by_layer(self) -> dict[str, str]:
        """List the tensors by the names of layers that users may ask for: those of the model, and the places."""
        return {**dict(zip(self.tensors, self.tensors, strict=True)), **self.by_place}


def _takes(session: OnnxSession, size: Canvas) -> bool:
    """Tell whether a model takes images `(width, height)`, whose own sides may be open."""
    height, width = session.shape[2:]
    return width in (None, size[0]) and height in (None, size[1])


def _checked_floats(canvas: Tensor) -> Tensor:
    """Return a canvas of floats; raises `InputError` for other numbers."""
    check(canvas.is_floating_point(), "canvas", "floating-point RGB in [0, 1]", canvas.dtype)
    return canvas


def _with_scores(candidates: Candidates, function: Callable[[Tensor], Tensor]) -> Candidates:
    """Apply a function to class scores and objectness."""
    objectness = None if candidates.objectness is None else function(candidates.objectness)
    return replace(candidates, classes=function(candidates.classes), objectness=objectness)


def _range(numbers: Tensor) -> tuple[float, float]:
    """Find the least and greatest number in one pass; both are NaN where one of them is."""
    if not numbers.numel():
        return 0.0, 0.0
    least, greatest = numbers.aminmax()
    return float(least), float(greatest)


def _score_range(candidates: Candidates) -> tuple[float, float]:
    """Find the least and greatest of all class scores and objectness."""
    least, greatest = _range(candidates.classes)
    if candidates.objectness is None:
        return least, greatest
    least_objectness, greatest_objectness = _range(candidates.objectness)
    return min(least, least_objectness), max(greatest, greatest_objectness)


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
    providers: Sequence[Provider] | None = None,
) -> OnnxDetector:
    """Load a detector from an ONNX file, or a published one by its name.

    Options that are not given are read from `model.json` in the file's folder, or else from the metadata of the model.
    Otherwise the head is recognised by names and shapes of the outputs, and names of classes are read from a file in
    the folder (`names_beside`).

    Args:
        name_or_path: the ONNX file, or the name of a published model.
        weights: the ONNX file of a published model that is given by its name; None fetches it.
        head: name of the head, in `HEADS`.
        classes: names of the classes in the order of the scores, without background.
        input_size: side, or `(width, height)`, of the canvas in pixels; for models that take any size, and for
            published ones, of which a copy is made.
        stride: pad the canvas only to a multiple of this number of pixels, for models that take any size.
        preprocessing: what the network expects of its input, or settings that replace some of the head's.
        logits: whether the head returns scores before their sigmoid.
        threads: threads of onnxruntime; None takes as many as PyTorch has.
        device: where onnxruntime computes, where no providers say it.
        providers: execution providers of onnxruntime, each alone or with its options.

    Returns:
        The detector.

    Raises:
        InputError: an option does not fit the model, or something that nothing says cannot be found out.
        DataError: the file is damaged, or takes too much memory or work.
    """
    file = _find_file(fspath(name_or_path), weights, input_size)
    # The budget of a published file is known to suffice, and to read it again takes as long as its first pass.
    open_ended = False if file.is_known else None
    session = OnnxSession(file.opened, threads=threads, device=device, providers=providers, open_ended=open_ended)
    settings = _overridden(
        read_settings(file.given, session.metadata),
        name=file.published,
        head=head,
        classes=classes,
        input_size=input_size,
        stride=stride,
        logits=logits,
    )
    size = _canvas_size(session, settings.get("input_size"))
    if None in session.shape[2:] and not file.is_known:
        check_file(file.opened, size)  # the sizes inside follow from the canvas, which is known only now
    outputs = session.probe(size)
    head_name = settings.get("head", file.known_head)
    if head_name is None:
        count = _class_count(settings.get("classes"), published=file.published is not None)
        head_name = _recognised_head(session, outputs, size, count)
    head = lookup(head_name, HEADS, "head")
    preprocessing = _merged_preprocessing(_usual_preprocessing(head, session), settings, preprocessing)
    names = _class_names(file, head, outputs, size, settings.get("classes"))
    detector = OnnxDetector(
        session,
        head,
        names,
        name=settings.get("name") or file.given.stem,
        input_size=size,
        stride=settings.get("stride"),
        preprocessing=preprocessing,
        logits=settings.get("logits", False),
        background=settings.get("background"),
        digest=file.digest if file.is_known else _model_digest(file.given),
    )
    detector.selection = replace(detector.selection, per_class=settings.get("per_class", False))
    return detector


class _ModelFile(NamedTuple):
    """The file of a model, and what is known of it.

    Attributes:
        given: the file, beside which its settings may lie.
        opened: the file that is opened: a copy with another input size, or the same.
        published: name of the published model that it is; None for others.
        digest: sha256 of the file that is opened; `""` if it is missing.
    """

    given: Path
    opened: Path
    published: str | None
    digest: str

    @property
    def is_known(self) -> bool:
        """Whether models are shipped for exactly this file."""
        return self.digest in NETWORKS

    @property
    def known_head(self) -> str | None:
        """The head of a published file, which would take as long as the first look to find out; None for others."""
        weights = WEIGHTS.get(self.published or "")
        return weights.head if weights is not None and weights.sha256 == self.digest else None


def _find_file(name: str, weights: str | PathLike[str] | None, input_size: int | tuple[int, int] | None) -> _ModelFile:
    """Find the file of a model, and make the copy of a published one that has another input size."""
    given, published = _given_file(name, weights)
    opened = given
    if published is not None and input_size is not None:
        opened = with_input_size(given, _sides(input_size))
    digest = sha256(opened) if opened.is_file() else ""
    return _ModelFile(given, opened, published, digest)


def _given_file(name: str, weights: str | PathLike[str] | None) -> tuple[Path, str | None]:
    """Find the file of a model by its path, or by the name of a published one; with the name, if it is published."""
    if name in _ONNX_MODELS:
        weights_file = fetch(name) if weights is None else Path(weights)
        return weights_file, name
    if weights is not None or not name.endswith(".onnx"):
        lookup(name, _ONNX_MODELS, "ONNX model")  # raises, with the nearest names
    file = Path(name)
    # A published file is known by its content, whatever it is called; a missing one is reported when it is opened.
    published_name = NETWORKS.get(sha256(file)) if file.is_file() else None
    return file, published_name


def _overridden(settings: OnnxSettings, **options: object) -> OnnxSettings:
    """Override settings of a model by the options of `load_onnx` that are not None."""
    chosen_options = {name: option for name, option in options.items() if option is not None}
    return cast(OnnxSettings, {**settings, **chosen_options})


def _class_count(names: Sequence[str] | None, *, published: bool) -> int | None:
    """Count the classes of a model: those of its names, or COCO's if it is published; None where neither is known."""
    if published:
        return len(COCO_CLASSES if names is None else names)
    return len(names) if names else None


def _recognised_head(session: OnnxSession, outputs: Mapping[str, Tensor], size: Canvas, classes: int | None) -> str:
    """Recognise the head of a model by the shapes of its outputs, and by a pass where several heads fit them."""
    shapes = tuple((name, tuple(output.shape)) for name, output in outputs.items())
    signature = Signature(session.image, shapes, size, session.producer, classes, session.metadata)
    grey = torch.full((1, 3, size[1], size[0]), 127.5 if session.takes_bytes else 0.5)
    return recognise(signature, lambda: session(grey))


def _usual_preprocessing(head: str, session: OnnxSession) -> Preprocessing:
    """Choose the preprocessing of a head; a model that takes bytes scales them itself."""
    usual = HEADS[head].preprocessing
    return _with_bytes_of(usual) if session.takes_bytes else usual


def _with_bytes_of(preprocessing: Preprocessing) -> Preprocessing:
    """Copy a preprocessing for a model of bytes, which have the values of the canvas."""
    return replace(preprocessing, scale=_AS_BYTES.scale, mean=_AS_BYTES.mean, std=_AS_BYTES.std)


def _check_bytes_alone(session: OnnxSession, preprocessing: Preprocessing) -> None:
    """Raise `InputError` for a preprocessing of a model of bytes that makes other numbers of them."""
    if session.takes_bytes:
        are_bytes = preprocessing == _with_bytes_of(preprocessing)
        expected = f"scale=255, mean 0 and std 1 for {session.path.name}, which takes bytes"
        got = f"scale={preprocessing.scale:g}, mean={preprocessing.mean}, std={preprocessing.std}"
        check(are_bytes, "preprocessing", expected, got)


def _merged_preprocessing(
    usual: Preprocessing, settings: OnnxSettings, option: Preprocessing | Mapping[str, Any] | None
) -> Preprocessing:
    """Override the usual preprocessing by the settings of the model, and these by an option."""
    if isinstance(option, Preprocessing):
        return option
    stored = usual.merged(settings.get("preprocessing", {}))
    return stored if option is None else stored.merged(option)


def _class_names(
    file: _ModelFile,
    head: str,
    outputs: Mapping[str, Tensor],
    size: Canvas,
    stated: Sequence[str] | None,
) -> Sequence[str]:
    """Find a name for each score of a head.

    Args:
        file: the model, for a file of names beside it; a published one has the classes of COCO.
        head: name of the head.
        outputs: the outputs for one canvas, whose scores are counted.
        size: `(width, height)` of the canvas.
        stated: names in the settings.

    Returns:
        The names.

    Raises:
        InputError: the head does not fit the outputs, or there are no names, or others than scores.
    """
    nearby = None
    if stated is None and file.published is None:
        nearby = names_beside(file.given)
    names = stated
    # Outputs of a network that selects boxes itself do not tell how many classes there are; a file of names does.
    if names is None and HEADS[head].selects:
        names = nearby
    scores = _score_count(head, outputs, size, names)
    if HEADS[head].selects:
        warnings.warn(
            f"{file.given.name} selects boxes itself and returns one class of each, so all other scores are 0; "
            "exported with end2end=False (and without NMS or top-k) it has all scores, from which beliefs learn more",
            stacklevel=3,
        )
    if names is None:
        names = _unstated_names(nearby, scores, file.given)
    check(len(names) == scores, "classes", f"{scores} names, one for each score", len(names))
    return names


def _score_count(head: str, outputs: Mapping[str, Tensor], size: Canvas, names: Sequence[str] | None) -> int:
    """Count the scores of a box by decoding outputs of one canvas; raises `InputError` where the head does not fit."""
    try:
        candidates = HEADS[head].decode(outputs, size, None if names is None else len(names))
    except InputError:
        raise
    except MISFITS as error:
        listed = ", ".join(f"{name} {tuple(output.shape)}" for name, output in outputs.items())
        raise InputError(
            f"head: expected the model's head, got {head!r}, which does not fit the outputs {listed[:_MOST_LISTED]}"
        ) from error
    count = candidates.classes.shape[-1]
    check(count > 0, "outputs", "at least one score", f"{count} with head {head!r}")
    return count


def _model_digest(path: Path) -> str:
    """Compute the sha256 of a model's file; with weights in other files, of all of them."""
    import onnx

    tensors = onnx.load(path, load_external_data=False).graph.initializer
    places = places_of_weights(tensors)
    if not places:
        return sha256(path)
    files = [inside(path.parent, place) for place in sorted(places)]
    return json_sha256([sha256(path), *map(sha256, files)])


def _canvas_size(session: OnnxSession, input_size: int | Sequence[int] | None) -> Canvas:
    """Choose `(width, height)` of a model's canvas: its fixed size, or the wanted size of a model that takes any."""
    height, width = session.shape[2:]
    if input_size is None:
        if height is None or width is None:
            expected = f"(width, height), as {session.path.name} takes any size"
            raise InputError(f"input_size: expected {expected}, got None; give that of its training, as input_size=640")
        check_canvas(session.path.name, (width, height))
        return width, height
    size = _sides(input_size)
    check_canvas("input_size", size)
    check(_takes(session, size), "input_size", f"the model's fixed size, {width} x {height}", size)
    return size


def _sides(input_size: int | Sequence[int]) -> Canvas:
    """Complete one side, or two, to `(width, height)`."""
    size = (input_size, input_size) if isinstance(input_size, int) else tuple(input_size)
    are_sides = len(size) == 2 and all(isinstance(side, int) and side > 0 for side in size)
    check(are_sides, "input_size", "(width, height) in pixels", excerpt(size))
    width, height = size
    return width, height


def _unstated_names(nearby: Sequence[str] | None, count: int, file: Path) -> Sequence[str]:
    """Name scores by a file beside the model, or 80 by COCO's classes, or 91 by COCO's category ids with their gaps."""
    in_file = [] if nearby is None else [nearby, without_placeholders(nearby)]  # a list may begin with background
    for names in (*in_file, COCO_CLASSES):
        if len(names) == count:
            return names
    if count == COCO_CATEGORIES:
        return coco_categories()
    raise UnnamedClasses(count, file, nearby)
