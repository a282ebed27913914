"""A detector that needs no weights: it sees squares of pure red, green or blue, if they are large enough."""

import pytest
import torch

from semfov import WindowEye, ZoomAgent
from semfov.zoom import GlimpseEvidence
from tests.small import Tiles


class Squares(Tiles):
    """One box for each of three colours in every cell of 16 px that shows it, by how full the cell is."""

    def __init__(self, size=(128, 128)):
        super().__init__(("red", "green", "blue"), size, name="squares", pure=True, fill=0.0)


@pytest.fixture
def detector():
    return Squares().eval()


@pytest.fixture
def agent(detector):
    torch.manual_seed(4)
    return ZoomAgent(WindowEye(detector), GlimpseEvidence(3)).eval()


@pytest.fixture
def picture():
    """1024 × 768 px, dark, with a red square of 32 px and a blue one of 64 px."""
    image = torch.rand(3, 768, 1024, generator=torch.Generator().manual_seed(0)) * 0.03  # not blank
    image[0, 320:352, 640:672] = 1
    image[2, 64:128, 128:192] = 1
    return image
