"""Average precision over seconds, beside slices of SAHI and supervision on the same detector and pictures.

    python -m benchmarks.sahi --mosaics 20
    python -m benchmarks.sahi --data.root DIR --data.annotations FILE --mosaics 0 --target person --passes 33

SAHI (Akyon, Altinuc and Temizel, 2022) looks at every slice and at the whole picture, the slicer of supervision at the
slices alone. Both merge by suppression, which is what SAHI does where scores below 0.1 count, as they do here. Slices
of one size have a single result, so they are cut in several sizes. Beside them are fewer of the slices, and `find_all`
after more and more passes. Every way looks anew, so that its seconds are its own: resampling, detecting, choosing and
merging for a picture in memory, on one thread (processor time). The detector sees all parts through the same eye.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import islice
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.tables import table
from eval.bootstrap import Bootstrap
from eval.zoom.objects import SEMFOV, average_precision
from eval.zoom.orders import adaptive_slices, in_order, quad_tree, sparse
from eval.zoom.run import ZoomConfig, ZoomRun
from semfov.agents.windows import ZoomAgent
from semfov.data.images import to_bytes
from semfov.detection.objects import FAINTEST, Objects
from semfov.io.files import write_text
from semfov.observation.matching import right_boxes
from semfov.runs.command import command
from semfov.runs.config import DataConfig
from semfov.runs.window_looking import TileSize
from semfov.settings import FindSettings
from semfov.threads import one_thread
from semfov.viz.style import COLOURS, make_figure, save_figure, styled
from semfov.zoom.episode import Order, WindowStep, look_by_look
from semfov.zoom.eye import WindowEye
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window
from semfov.zoom.objects import merge
from semfov.zoom.slices import slices

if TYPE_CHECKING:
    from matplotlib.figure import Figure

try:
    import supervision
    from sahi.models.base import DetectionModel
    from sahi.predict import get_sliced_prediction
    from sahi.prediction import ObjectPrediction
except ImportError as error:
    # SAHI depends on opencv-python, which would overwrite the files of opencv-python-headless, but also runs with the
    # latter.
    raise ModuleNotFoundError(
        "benchmarks.sahi needs SAHI: pip install 'semfov[peers,notebook]' && pip install --no-deps sahi"
    ) from error

_Pixels = NDArray[np.uint8]
_Way = Callable[[_Pixels], tuple[Objects, int]]

_SAHI, _SLICER = "SAHI", "supervision"
_MARKERS = {SEMFOV: "o", _SAHI: "s", _SLICER: "^"}


@dataclass(frozen=True)
class SahiConfig(ZoomConfig):
    """Average precision over seconds of slices, and of windows that semfov chooses.

    Args:
        sides: sides in pixels of the slices of SAHI and of supervision.
        frames: neighbouring frames of one scene, for a second table and panel. They are nearly one picture, so no
            errors are given.
        out: folder for the tables and the figure.
    """

    sides: tuple[TileSize, ...] = (416, 640, 960, 1280)
    frames: DataConfig = field(default_factory=lambda: DataConfig(min_instances=0, max_target_area=None))
    out: Path = Path("runs/sahi")


class Parts:
    """Looks at parts of a picture, and counts them.

    Args:
        eye: the eye.
        target: class 1..K whose own score counts, as in `merge`; None: the best class of each box.
    """

    def __init__(self, eye: WindowEye, target: int | None) -> None:
        self.eye, self.target, self.passes = eye, target, 0

    def __call__(self, pixels: _Pixels) -> Objects:
        """Return the boxes of a part `(H, W, 3)` that `merge` would take."""
        self.passes += 1
        view = self.eye.open(np.ascontiguousarray(pixels))
        look = self.eye.detect(view, torch.tensor([Window.overview(view.lattice).fixation]), hints=False).detections
        scores, labels = look.confidence[0], look.labels[0]
        if self.target is not None:
            scores, labels = look.scores[0, :, self.target], torch.full_like(labels, self.target)
        return Objects(look.boxes[0], scores, labels, torch.zeros_like(labels)).above(FAINTEST)


class Slicing(DetectionModel):
    """Looks at parts of a picture, with the interface of SAHI."""

    def __init__(self, parts: Parts) -> None:
        names = {str(number): name for number, name in enumerate(parts.eye.detector.classes, 1)}
        super().__init__(model=parts, device="cpu", confidence_threshold=FAINTEST, category_mapping=names)

    def set_model(self, model: Any, **kwargs: Any) -> None:
        """Set the detector."""
        self.model = model

    def perform_inference(self, image: _Pixels) -> None:
        """Detect in a slice `(H, W, 3)`."""
        self._original_predictions = self.model(image)

    def _create_object_prediction_list_from_original_predictions(
        self,
        shift_amount_list: list[list[int | float]] | None = None,
        full_shape_list: list[list[int | float]] | None = None,
    ) -> None:
        objects: Any = self._original_predictions
        # For a single image, SAHI may pass the values without the list around them.
        shift, shape = (
            values[0] if values and isinstance(values[0], list) else values
            for values in (shift_amount_list, full_shape_list)
        )
        names = self.category_mapping or {}
        self._object_prediction_list_per_image = [
            [
                ObjectPrediction(
                    bbox=box,
                    category_id=label,
                    category_name=names[str(label)],
                    score=score,
                    shift_amount=shift or [0, 0],
                    full_shape=shape,
                )
                for box, label, score in zip(
                    objects.boxes.tolist(), objects.labels.tolist(), objects.scores.tolist(), strict=True
                )
            ]
        ]


@dataclass
class Outcome:
    """What a way of looking returns for each picture: boxes, whether they are right, passes and seconds."""

    objects: list[int] = field(default_factory=list)
    scores: list[Tensor] = field(default_factory=list)
    right: list[Tensor] = field(default_factory=list)
    passes: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)

    def precision(self) -> Bootstrap:
        """Average precision at IoU 0.5, with samples of the pictures."""
        scores, right, counts = torch.cat(self.scores), torch.cat(self.right), torch.tensor(self.objects)
        pictures = torch.arange(len(counts)).repeat_interleave(torch.tensor([len(each) for each in self.scores]))

        def measure(drawn: Tensor) -> Tensor:
            weight = drawn.bincount(minlength=len(counts))
            return torch.tensor(average_precision(scores, right, int(counts[drawn].sum()), weight[pictures]))

        return Bootstrap.of(measure, range(len(counts)))

    def mean(self) -> tuple[float, float]:
        """Return passes and seconds of a picture."""
        return sum(self.passes) / len(self.passes), sum(self.seconds) / len(self.seconds)


def _sahi(run: ZoomRun, side: int, pixels: _Pixels) -> tuple[Objects, int]:
    """Objects that SAHI reports for a picture `(H, W, 3)`, and its passes."""
    parts, overlap = Parts(run.eye, run.target), run.config.overlap
    result = get_sliced_prediction(
        pixels,
        Slicing(parts),
        slice_height=side,
        slice_width=side,
        overlap_height_ratio=overlap,
        overlap_width_ratio=overlap,
        postprocess_type="NMS",
        postprocess_match_metric="IOU",
        verbose=0,
    )
    predictions = result.object_prediction_list
    boxes = torch.tensor([each.bbox.to_xyxy() for each in predictions], dtype=torch.float32).view(-1, 4)
    labels = torch.tensor([each.category.id for each in predictions], dtype=torch.long)
    scores = torch.tensor([each.score.value for each in predictions], dtype=torch.float32)
    return Objects(boxes, scores, labels, torch.zeros_like(labels)), parts.passes


def _slicer(run: ZoomRun, side: int, pixels: _Pixels) -> tuple[Objects, int]:
    """Objects that the slicer of supervision reports for a picture `(H, W, 3)`, and its passes."""
    parts = Parts(run.eye, run.target)

    def callback(part: _Pixels) -> supervision.Detections:
        seen = parts(part)
        return supervision.Detections(
            xyxy=seen.boxes.numpy(), confidence=seen.scores.numpy(), class_id=seen.labels.numpy()
        )

    overlap = round(run.config.overlap * side)
    found = supervision.InferenceSlicer(callback, slice_wh=(side, side), overlap_wh=(overlap, overlap))(pixels)
    boxes, scores, labels = (torch.from_numpy(each) for each in (found.xyxy, found.confidence, found.class_id))
    return Objects(boxes.float(), scores, labels.long(), torch.zeros_like(labels)), parts.passes


def _chosen(run: ZoomRun, passes: int, pixels: _Pixels) -> tuple[Objects, int]:
    """Objects that `find_all` finds in a picture `(H, W, 3)` with so many passes, and the passes that it took."""
    path = ZoomAgent(run.eye, run.evidence).find_all(pixels, run.target, FindSettings(passes=passes, min_gain=0.0))
    return path.candidates, path.passes


def _ordered(run: ZoomRun, pixels: _Pixels, *, order: Callable[[Lattice, list[Window]], Order]) -> tuple[Objects, int]:
    """Objects that looks at windows in an order show, merged here, and the number of looks."""
    source = LiveWindowLooks(run.eye, run.eye.open(pixels))
    lattice, config = source.lattice, run.config
    steps: Iterable[WindowStep[Any]] = look_by_look(
        source, order(lattice, slices(lattice, config.slice, config.step)), None
    )
    looks = [step.look for step in islice(steps, config.passes)]
    return merge(looks, run.target), len(looks)


def ways(run: ZoomRun, sides: Iterable[int]) -> dict[tuple[str, str], _Way]:
    """Return the ways of looking at a picture, by name and what was chosen."""
    config, targets = run.config, [] if run.target is None else [run.target]
    orders: dict[str, Callable[[Lattice, list[Window]], Order]] = {
        "slices, merged here": lambda lattice, cut: in_order(cut),
        "slices, sparse": lambda lattice, cut: sparse(cut, targets, config.sparse),
        "slices as in ASAHI": lambda lattice, cut: in_order(adaptive_slices(lattice)),
        "quad-tree": lambda lattice, cut: quad_tree(lattice, run.target, most=False),
    }
    return {
        **{(_SAHI, f"{side} px"): partial(_sahi, run, side) for side in sides},
        **{(_SLICER, f"{side} px"): partial(_slicer, run, side) for side in sides},
        **{(name, ""): partial(_ordered, run, order=order) for name, order in orders.items()},
        **{(SEMFOV, f"{number} passes"): partial(_chosen, run, number) for number in run.numbers if number > 1},
    }


def measure(run: ZoomRun, sides: Iterable[int]) -> dict[tuple[str, str], Outcome]:
    """Look at every picture in all ways."""
    every = ways(run, sides)
    outcomes = {name: Outcome() for name in every}
    for index in range(len(run.scenes)):
        annotation, pixels = run.annotation(index), to_bytes(run.scenes[index].image)
        for name, way in every.items():
            began = process_time()
            objects, passes = way(pixels)
            seconds, outcome = process_time() - began, outcomes[name]
            right = right_boxes(objects, annotation)
            outcome.scores.append(objects.scores[right >= 0].double())  # not those in a crowd
            outcome.right.append(right[right >= 0] > 0)
            outcome.objects.append(int((~annotation.crowd).sum()))
            outcome.passes.append(passes)
            outcome.seconds.append(seconds)
        print(f"{index + 1} of {len(run.scenes)} pictures", flush=True)
    return outcomes


@styled
def plot_seconds(panels: Mapping[str, Mapping[tuple[str, str], tuple[float, float, float]]]) -> Figure:
    """Average precision over seconds, with bars and a band of one standard error where it is a number.

    Args:
        panels: for each title, seconds, average precision and its error by way of looking and what was chosen.

    Returns:
        The figure.
    """
    figure, axes = make_figure(1, len(panels), width=4.1 * len(panels), height=3.3)
    for ax, (title, points) in zip(axes, panels.items(), strict=True):
        for order, (name, marker) in enumerate(_MARKERS.items()):
            mine = [(choice, *numbers) for (way, choice), numbers in points.items() if way == name]
            if not mine:
                continue
            seconds, precision, error = (np.array([each[n] for each in mine]) for n in (1, 2, 3))
            colour, chosen = COLOURS[order], name == SEMFOV
            if chosen:
                ax.plot(seconds, precision, color=colour, marker=marker, markersize=4, label=name)
                if np.isfinite(error).all():
                    ax.fill_between(seconds, precision - error, precision + error, color=colour, alpha=0.15, lw=0)
            else:
                ax.plot(seconds, precision, color=colour, marker=marker, markersize=4, linestyle="none", label=name)
                if np.isfinite(error).all():
                    ax.vlines(seconds, precision - error, precision + error, color=colour, linewidth=0.8)
            if name != _SLICER:
                place: Any = {"xytext": (-3, 4), "ha": "right"} if chosen else {"xytext": (4, -9), "ha": "left"}
                for choice, x, y, _ in mine:
                    text = choice.split()[0] if chosen else choice
                    ax.annotate(text, (x, y), **place, textcoords="offset points", fontsize=7, color=colour)
        longest = max(seconds for seconds, *_ in points.values())
        ax.set(title=title, xlabel="seconds a picture (one thread)", ylabel="AP50", ylim=(0, 1))
        ax.set_xlim(0, 1.15 * longest)
        ax.grid(alpha=0.3, linewidth=0.5)
    axes[0].legend(loc="lower right")
    return figure


def compare(config: SahiConfig) -> None:
    """Look at every picture in all ways, and write tables and the figure."""
    runs = [ZoomRun(config)]
    if config.frames.root is not None:
        runs.append(ZoomRun(replace(config, data=config.frames, mosaics=0)))
    lines: list[str] = []
    panels = {}
    for number, run in enumerate(runs):
        with one_thread(), torch.inference_mode():
            outcomes = measure(run, config.sides)
        width, height = run.scenes.annotation(0).size
        objects = sum(next(iter(outcomes.values())).objects)
        frames = "frames of one scene" if number else "pictures"
        title = f"{len(run.scenes)} {frames}, {width} × {height} px, {objects} × {config.target or 'object'}"
        points: dict[tuple[str, str], tuple[float, float, float]] = {}
        rows: list[list[str]] = []
        for name, outcome in outcomes.items():
            precision, (passes, seconds) = outcome.precision(), outcome.mean()
            if rows and name[0] == SEMFOV and rows[-1][1] == f"{passes:.1f}":
                continue  # nothing was left to look at
            value, error = float(precision.value), float("nan") if number else float(precision.error)
            points[name] = seconds, value, error
            shown = f"{value:.3f}" if number else f"{value:.3f} ± {error:.3f}"
            rows.append([", ".join(filter(None, name)), f"{passes:.1f}", f"{seconds:.2f}", shown])
        panels[title] = points
        lines += [f"{title}:", "", table(["", "passes", "seconds", "AP50"], rows), ""]
    text = "\n".join(lines)
    write_text(config.out / "summary.md", text)
    save_figure(plot_seconds(panels), config.out / "seconds.png", dpi=120)
    print(text)


main = command(compare, SahiConfig, __doc__)

if __name__ == "__main__":
    sys.exit(main())
