"""Small models, beliefs, looks and images, made from seeded random numbers."""

import torch
from torch import Tensor, nn

from semfov import FovealObservationModel, Grid
from semfov.belief import ContextPrior, MapEvidence, TargetEvidence
from semfov.belief.observers import Semantic
from semfov.detection import Candidates, Detections, Detector, Selection

CLASSES = ("cat", "cup", "person")
GRID = Grid(4, 3, (64, 48))


def rand(*shape: int) -> Tensor:
    """Uniform random numbers in [0, 1) that depend only on the shape."""
    return torch.rand(shape, generator=torch.Generator().manual_seed(sum(shape)))


def model() -> FovealObservationModel:
    """An observation model of three levels, with miss rates."""
    alpha = 0.5 + 4 * rand(4, 3, 4) + 3 * torch.eye(4)[:, None]
    return FovealObservationModel(alpha, [0.2, 0.5], CLASSES, miss_rate=0.1 + 0.8 * rand(4, 3)).eval()


def evidence() -> TargetEvidence:
    """An untrained model of target evidence."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return TargetEvidence(4, 4).eval()


def mapping() -> MapEvidence:
    """An untrained model of map evidence."""
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return MapEvidence(4, 4, components=4).eval()


def observing() -> Semantic:
    """The observer of the paper with an untrained observation model."""
    return Semantic(4, model().requires_grad_(False))


def context(**weights: tuple[float, float]) -> ContextPrior:
    """A random context prior (which classes occur near each other); its weights are for a map unless given."""
    return ContextPrior(CLASSES, rand(4, 3, 3), rand(4, 4, 3), [0.2, 0.4], weights=weights or {"map": (0.5, 0.2)})


def beliefs() -> Tensor:
    """Parameters `(2, 12, 4)` of two Dirichlet beliefs."""
    return 0.5 + 3 * rand(2, len(GRID), 4)


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
