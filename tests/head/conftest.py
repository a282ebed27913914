"""Models of a head that need no trained weights: the detector sees squares of pure colour."""

import pytest
import torch
from torch import Tensor

from semfov.belief.map_evidence import MapEvidence
from semfov.belief.target_evidence import TargetEvidence
from semfov.detection.detector import Detector
from semfov.detection.scores import Candidates
from semfov.eye import Eye
from semfov.sensor import Foveation


class Squares(Detector):
    """One box for each class in every 16-px square that shows its colour, by how full it is."""

    def __init__(self):
        super().__init__("squares", ("red", "green", "blue"), (96, 96), fill=0.0)

    def propose(self, canvas: Tensor) -> Candidates:
        others = canvas.sum(1, keepdim=True) - canvas
        full = torch.nn.functional.avg_pool2d((canvas - others).clamp(0, 1), 16)
        rows, columns = full.shape[-2:]
        y, x = torch.meshgrid(torch.arange(rows) * 16.0, torch.arange(columns) * 16.0, indexing="ij")
        boxes = torch.stack([x, y, x + 16, y + 16], -1).reshape(1, -1, 4).expand(len(canvas), -1, -1)
        classes = full.flatten(2).mT
        return Candidates(boxes, classes, classes.amax(-1))


@pytest.fixture
def eye():
    return Eye(Foveation(100.0, growth=2.0), Squares()).eval().requires_grad_(False)


@pytest.fixture
def models():
    torch.manual_seed(0)
    return TargetEvidence(components=4).requires_grad_(False), MapEvidence(components=4).requires_grad_(False)


@pytest.fixture
def panorama():
    """360 × 180 px, black, with a red square behind, across the seam, and a blue one ahead, to the right."""
    image = torch.zeros(3, 180, 360)
    image[0, 80:100, :10] = image[0, 80:100, -10:] = 1
    image[2, 80:100, 200:220] = 1
    return image
