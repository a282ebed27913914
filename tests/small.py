"""Small models, beliefs, looks and detectors: seeded random numbers, or a rule that a test can state."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from semfov import ActivePerception, EmbeddedScenes, Eye, FovealObservationModel, Foveation, Grid, Scanpath
from semfov.belief import Belief, DirichletBelief, Verification
from semfov.belief.observers import Evidence, Semantic
from semfov.data.scene import Annotation, Scene
from semfov.detection import Candidates, Detections, Detector, Selection
from semfov.gaze.policies import Policy
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.paths.fovea import FoveaLook, FoveaLooks
from semfov.runs.config import BeliefConfig, DataConfig, ProtocolConfig
from semfov.runs.store import RememberedLooks

CLASSES = ("cat", "cup", "person")
GRID = Grid(4, 3, (64, 48))


def rand(*shape: int) -> Tensor:
    """Uniform random numbers in [0, 1) that depend only on the shape."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(sum(shape)))


def slopes(width: int, height: int) -> Tensor:
    """Bytes of a picture `(3, H, W)` whose colours rise across and down: of noise, figures are long to compress."""
    across, down = torch.linspace(0, 255, width).expand(height, -1), torch.linspace(0, 255, height)[:, None]
    return torch.stack([across, down.expand(-1, width), 255 - across]).byte()


def draw(*shape: int, dtype: torch.dtype = torch.float64, device: torch.device | None = None, seed: int = 0) -> Tensor:
    """Uniform random numbers in [0, 1) of any precision, on any device."""
    generator = torch.Generator().manual_seed(seed + sum(shape))
    return torch.rand(shape, dtype=dtype, generator=generator).to(device)


def close(a: Tensor, b: Tensor, tolerance: float = 1e-12) -> None:
    """Check that numbers differ by no more than a tolerance."""
    torch.testing.assert_close(a, torch.as_tensor(b, dtype=a.dtype, device=a.device), rtol=0, atol=tolerance)


def area(box: Sequence[float]) -> float:
    """Area of a box (x1, y1, x2, y2)."""
    return (box[2] - box[0]) * (box[3] - box[1])


def shared(a: Sequence[float], b: Sequence[float]) -> float:
    """Area that two boxes share."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0)


def iou(a: Sequence[float], b: Sequence[float]) -> float:
    """Intersection over union of two boxes."""
    return shared(a, b) / (area(a) + area(b) - shared(a, b))


def kaplan(beta: Any, likelihood: Any) -> Any:
    """Equation 7 of Luzio, Bernardino and Moreno (2024), of NumPy's arrays."""
    expected = (beta * likelihood).sum()
    return beta * (1 + likelihood / expected) / (1 + likelihood.min() / expected)


def once(words: Sequence[str]) -> list[str]:
    """The words of a command, in which each option keeps the last of its values: a command takes an option once."""
    kept: dict[str, list[str]] = {"": []}
    for word in words:
        if word.startswith("--"):
            kept.pop(word, None)
            kept[word] = []
        else:
            kept[next(reversed(kept))].append(word)
    return [word for option, values in kept.items() for word in (option, *values) if word]


def cells_of(text: str) -> list[list[str]]:
    """The cells of all rows of the tables in a text of Markdown, with their heads and rules."""
    return [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines() if line[:1] == "|"]


def write_network(
    path: Path,
    steps: Sequence[Any],
    inputs: dict[str, Any],
    outputs: dict[str, Any],
    stored: dict[str, Any],
    **more: Any,
) -> Path:
    """Save a network of given nodes; inputs and outputs are shapes of floats, or pairs of a type and a shape."""
    from onnx import TensorProto, helper, numpy_helper, save

    def named(tensors: dict[str, Any]) -> list[Any]:
        typed = {name: each if isinstance(each, tuple) else (TensorProto.FLOAT, each) for name, each in tensors.items()}
        return [helper.make_tensor_value_info(name, *each) for name, each in typed.items()]

    constants = [numpy_helper.from_array(np.asarray(value), name) for name, value in stored.items()]
    graph = helper.make_graph(steps, "network", named(inputs), named(outputs), constants)
    opset = [helper.make_opsetid("", more.get("opset", 17))]
    model = helper.make_model(graph, producer_name=more.get("producer", ""), opset_imports=opset, ir_version=8)
    helper.set_model_props(model, more.get("metadata") or {})
    save(model, str(path))
    return path


def scattered(index: int, grid: Grid, classes: int, most: int = 5) -> Detections:
    """Random detections from every cell of a scene."""
    generator, cells = torch.Generator().manual_seed(index), len(grid)
    corner = torch.rand(cells, most, 2, generator=generator) * 400
    boxes = torch.cat([corner, corner + 20 + torch.rand(cells, most, 2, generator=generator) * 150], -1)
    scores = (3 * torch.rand(cells, most, classes + 1, generator=generator)).softmax(-1)
    return Detections(boxes, scores, torch.rand(cells, most, generator=generator) < 0.6)


def run_settings(folder: Path, scenes: int = 1, columns: int = 4, rows: int = 3, **protocol: int) -> dict[str, Any]:
    """Settings of a small run on embedded scenes, which keeps everything in a folder."""
    return {
        "data": DataConfig(limit=scenes),
        "belief": BeliefConfig(columns=columns, rows=rows),
        "protocol": ProtocolConfig(**protocol),
        "cache": folder / "cache",
        "out": folder / "out",
        "workers": 1,
    }


def looking(classes: tuple[str, ...], grid: Grid, count: int) -> SimpleNamespace:
    """A stand-in for a run with stored looks at embedded scenes, whose detections are random."""
    scenes = EmbeddedScenes(classes, count=count)

    def detections(index: int) -> Detections:
        return scattered(index, grid, len(classes))

    def looks(index: int) -> RememberedLooks[int, Detections]:
        return RememberedLooks(lambda: lambda cell: detections(index)[cell : cell + 1])

    return SimpleNamespace(scenes=scenes, grid=lambda index: grid, detections=detections, looks=looks)


def values_of(acquisition: nn.Module, beta: Tensor) -> Tensor:
    """Values for a Dirichlet belief with these parameters, before any cell was visited."""
    return acquisition(DirichletBelief(beta), torch.zeros(beta.shape[:-1], dtype=torch.bool))


def model() -> FovealObservationModel:
    """An observation model of three levels, with miss rates."""
    alpha = 0.5 + 4 * rand(4, 3, 4) + 3 * torch.eye(4)[:, None]
    return FovealObservationModel(alpha, [0.2, 0.5], CLASSES, miss_rate=0.1 + 0.8 * rand(4, 3)).eval()


def search_model() -> FovealObservationModel:
    """An observation model of searches: with odds of a miss, refutation, presence and thresholds."""
    fitted = model()
    odds = 0.05 + 0.3 * rand(4, 3)
    shares = torch.tensor([0.2, 0.5, 0.8])
    presence = Presence(
        torch.tensor(-0.4), torch.tensor([0.7, 0.2]), shares, Thresholds(0.7, stop_below=0.02, place=0.3)
    )
    return FovealObservationModel(
        fitted.alpha, fitted.edges, CLASSES, miss_odds=odds, refutation=0.6, presence=presence
    ).eval()


def observing() -> Semantic:
    """The observer of the paper with an untrained observation model."""
    return Semantic(4, model().requires_grad_(False))


class FixedLook(Semantic):
    """An observer that returns a given look, whatever is detected."""

    def __init__(self, look: Evidence) -> None:
        super().__init__(4)
        self.look = look

    def weigh(self, detections, fixation, grid, target=None) -> Evidence:
        return self.look


def beliefs() -> Tensor:
    """Parameters `(2, 12, 4)` of two Dirichlet beliefs."""
    return 0.5 + 3 * rand(2, len(GRID), 4)


def tensors(belief: Belief) -> list[Tensor]:
    """The tensors of a belief."""
    found: list[Tensor] = []
    belief.map(lambda tensor: found.append(tensor) or tensor)
    return found


def memory() -> tuple[Tensor, Tensor]:
    """Two beliefs, and the distance of the fovea from each cell after looks at cells 2 and 7, `(2, 12)`."""
    closest = torch.minimum(*GRID.cell_distance[[2, 7]]).expand(2, -1).clone()
    return beliefs(), closest


def look() -> tuple[Tensor, Tensor, Tensor]:
    """Scores `(2, 2, 4)`, boxes `(2, 2, 4)` and fixations `(2, 2)` of one look at each of two images."""
    boxes = torch.tensor([[[4.0, 4, 30, 30], [20, 10, 60, 40]], [[8.0, 20, 40, 44], [30, 2, 62, 20]]])
    return rand(2, 2, 4).softmax(-1), boxes, torch.tensor([[20.0, 20.0], [41.0, 13.0]])


def detections(scores: Tensor, boxes: Tensor) -> Detections:
    """Detections without padding."""
    return Detections(boxes, scores, torch.ones(scores.shape[:2], dtype=torch.bool, device=scores.device))


def scanpath(
    grid: Grid,
    cells: Tensor,
    classes: tuple[str, ...] = ("background", "cat", "cup"),
    detections: Sequence[Detections] | None = None,
    seconds: Sequence[Mapping[str, float]] = (),
    **given: object,
) -> Scanpath:
    """A scanpath with random probabilities and values and without detections, unless they are given."""
    count, generator = len(cells), torch.Generator().manual_seed(0)
    settings = {
        "target": None,
        "probabilities": torch.rand(count, len(grid), len(classes), generator=generator),
        "values": torch.rand(count, len(grid), generator=generator),
        "found": False,
    } | given
    seen = (Detections.empty(1, len(classes) - 1),) * count if detections is None else detections
    belief = settings.get("posterior"), settings.get("presence")
    looks = fovea_looks(grid, cells, seen, settings["values"], *belief, seconds)
    return Scanpath(grid=grid, classes=classes, looks=looks, **settings)


def with_looks(record: Any, **columns: Sequence[object]) -> Any:
    """A record whose looks have other values of some fields, one for each look."""
    looks = []
    for number, look in enumerate(record.looks):
        looks.append(replace(look, **{name: values[number] for name, values in columns.items()}))
    return replace(record, looks=tuple(looks))


def fovea_looks(
    grid: Grid,
    cells: Tensor,
    detections: Sequence[Detections],
    values: Tensor,
    posterior: Tensor | None = None,
    presence: Tensor | None = None,
    seconds: Sequence[Mapping[str, float]] = (),
) -> tuple[FoveaLook, ...]:
    """Fixations of the centres of cells, from their columns."""
    made = FoveaLooks(grid)
    for number, cell in enumerate(cells.tolist()):
        made.fixate(
            cell,
            grid.centres[cell].tolist(),
            detections[number],
            seconds[number] if seconds else {},
            float(values[number - 1, cell]) if number else None,
            None if posterior is None else posterior[number],
            None if presence is None else float(presence[number]),
        )
    return tuple(made.looks)


class Blobs(Detector):
    """Detects each quarter of the canvas; a linear layer computes the scores from the mean colour."""

    def __init__(self) -> None:
        super().__init__("blobs", CLASSES, (64, 48), selection=Selection(threshold=0.0, iou=1.0))
        with torch.random.fork_rng():
            torch.manual_seed(0)
            self.score = nn.Linear(3, len(CLASSES))

    def propose(self, canvas: Tensor) -> Candidates:
        corners = canvas.new_tensor([[0, 0], [32, 0], [0, 24], [32, 24]])
        boxes = torch.cat([corners, corners + canvas.new_tensor([32, 24])], -1)
        colours = nn.functional.avg_pool2d(canvas, (24, 32)).flatten(2).mT
        return Candidates(boxes.expand(len(canvas), 4, 4), self.score(colours).sigmoid().to(canvas))


class Coloured(Detector):
    """One box around all pixels that are red (class 1), green (2) or blue (3).

    The score is the largest contrast with the other colours, or a given one. A colour that does not occur has an empty
    box and the score 0.
    """

    def __init__(self, classes=("red", "green"), size=(160, 120), *, score=None, **options) -> None:
        super().__init__("coloured", classes, size, **options)
        self.score = score

    def propose(self, canvas: Tensor) -> Candidates:
        kinds = len(self.classes)
        boxes, scores = canvas.new_zeros(len(canvas), kinds, 4), canvas.new_zeros(len(canvas), kinds, kinds)
        for row, image in enumerate(canvas):
            for kind in range(kinds):
                contrast = image[kind] - image[[channel for channel in range(3) if channel != kind]].amax(0)
                ys, xs = (contrast > 0.1).nonzero(as_tuple=True)
                if len(xs):
                    boxes[row, kind] = torch.stack([xs.min(), ys.min(), xs.max() + 1, ys.max() + 1]).to(canvas)
                    scores[row, kind, kind] = contrast.max().clamp(0, 1) if self.score is None else self.score
        return Candidates(boxes, scores)


class Shown(Detector):
    """Detects nothing; its only feature map is the canvas itself, as means of squares."""

    def __init__(self, *given, square=2, **options) -> None:
        super().__init__(*given, **options)
        self.square = square

    def propose(self, canvas: Tensor) -> Candidates:
        return Candidates(canvas.new_zeros(len(canvas), 0, 4), canvas.new_zeros(len(canvas), 0, 1))

    def propose_with_features(self, canvas: Tensor, layers=None):
        return self.propose(canvas), {"backbone8": nn.functional.avg_pool2d(canvas, self.square)}


class Sure(Verification):
    """Every place holds the target, with log odds of 4."""

    def forward(self, features: Tensor) -> Tensor:
        return torch.full_like(features[..., :2], 4.0)


class Tiles(Detector):
    """A box for every tile of 16 pixels, scored by its mean red, green and blue, squared.

    With `pure`, the score is how much of the tile shows only this colour.
    """

    def __init__(self, classes=("person", "cat", "cup"), size=(96, 96), *, name="tiles", pure=False, **options) -> None:
        super().__init__(name, classes, size, **options)
        self.pure = pure

    def propose(self, canvas: Tensor) -> Candidates:
        shown = (2 * canvas - canvas.sum(1, keepdim=True)).clamp(0, 1) if self.pure else canvas
        means = nn.functional.avg_pool2d(shown, 16)
        rows, columns = means.shape[-2:]
        y, x = torch.meshgrid(torch.arange(rows) * 16.0, torch.arange(columns) * 16.0, indexing="ij")
        boxes = torch.stack([x, y, x + 16, y + 16], -1).reshape(1, -1, 4).expand(len(canvas), -1, -1)
        classes = means.flatten(2).mT.clamp(0, 1) ** (1 if self.pure else 2)
        return Candidates(boxes, classes, classes.amax(-1))


class Fixed(Detector):
    """The same candidates on every canvas: one box of the first class, unless others are given."""

    def __init__(self, classes=("cup", "cat"), candidates: Candidates | None = None, **options) -> None:
        super().__init__("fixed", classes, (32, 32), **options)
        self.candidates = candidates

    def propose(self, canvas: Tensor) -> Candidates:
        if self.candidates is not None:
            return self.candidates
        box = canvas.new_tensor([[4.0, 4, 20, 20]]).expand(len(canvas), 1, 4)
        return Candidates(box, canvas.new_tensor([[0.9, 0.1]]).expand(len(canvas), 1, 2))


def agent(detector: Detector, *, grid=(8, 6), sigma=40.0, reference=160.0) -> ActivePerception:
    """An agent with the beliefs of the paper from raw scores; it explores at random."""
    observer, eye = Semantic(len(detector.classes) + 1), Eye(Foveation(sigma), detector, reference=reference)
    return ActivePerception(eye, (observer, Policy("non-predictive")), (observer, Policy("random")), grid=grid).eval()


class RedBoxes:
    """Dark photographs of 200 × 150 px with red boxes: one alone, and two of another class that overlap."""

    classes = ("box", "pair")
    ids = tuple(range(6))
    fingerprint = "red boxes"

    def __len__(self):
        return len(self.ids)

    def annotation(self, index):
        x = 8.0 * index
        boxes = torch.tensor([[20.0 + x, 20, 60 + x, 70], [80 + x, 90, 120 + x, 130], [100 + x, 90, 140 + x, 130]])
        return Annotation(boxes, torch.tensor([1, 2, 2]), torch.zeros(3).bool(), (200, 150))

    def __getitem__(self, index):
        generator = torch.Generator().manual_seed(index)
        image = 0.1 * torch.rand(3, 150, 200, generator=generator)
        told = self.annotation(index)
        for x1, y1, x2, y2 in told.boxes.int().tolist():
            image[0, y1:y2, x1:x2] = 1
        return Scene(index, str(index), image, told.boxes, told.labels)

    def digest(self, index):
        return hashlib.sha256(bytes([index])).hexdigest()
