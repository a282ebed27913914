"""Models of a head that need no trained weights: the detector sees squares of pure colour."""

import pytest
import torch

from semfov import Eye, Foveation, MapEvidence, TargetEvidence
from tests.small import Tiles


@pytest.fixture
def eye():
    return (
        Eye(Foveation(100.0, growth=2.0), Tiles(("red", "green", "blue"), fill=0.0, pure=True))
        .eval()
        .requires_grad_(False)
    )


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
