"""A detector that needs no weights: it sees squares of pure red, green or blue, if they are large enough."""

import pytest
import torch
from torch import Tensor

from semfov.detection import Candidates, Detector


class Squares(Detector):
    """Proposes one box for each of its classes in every 16-px cell that shows its colour, by how full the cell is."""

    def __init__(self, size=(128, 128)):
        super().__init__("squares", ("red", "green", "blue"), size, fill=0.0)

    def propose(self, canvas: Tensor) -> Candidates:
        batch = canvas.shape[0]
        others = canvas.sum(1, keepdim=True) - canvas
        pure = (canvas - others).clamp(0, 1)
        full = torch.nn.functional.avg_pool2d(pure, 16)
        rows, columns = full.shape[-2:]
        y, x = torch.meshgrid(torch.arange(rows) * 16.0, torch.arange(columns) * 16.0, indexing="ij")
        boxes = torch.stack([x, y, x + 16, y + 16], -1).reshape(1, -1, 4).expand(batch, -1, -1)
        classes = full.flatten(2).mT
        return Candidates(boxes, classes, classes.amax(-1))


@pytest.fixture
def detector():
    return Squares().eval()


@pytest.fixture
def picture():
    """1024 × 768 px, dark, with a red square of 32 px and a blue one of 64 px."""
    image = torch.rand(3, 768, 1024, generator=torch.Generator().manual_seed(0)) * 0.03  # not blank
    image[0, 320:352, 640:672] = 1
    image[2, 64:128, 128:192] = 1
    return image
