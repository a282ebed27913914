"""Models of a head that need no trained weights: the detector sees squares of pure colour."""

import pytest
import torch

from semfov import Eye, FovealObservationModel, Foveation, TargetEvidence
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
    # Its map is in doubt about cells without detections, so that some looks in a view pay.
    observation = FovealObservationModel.identity(["red", "green", "blue"], [0.2], cell=(0.4, 1.0, 1.0))
    return TargetEvidence(components=4).requires_grad_(False), observation.requires_grad_(False)


@pytest.fixture
def panorama():
    """360 × 180 px, black, with a red square behind, across the seam, and a blue one ahead, to the right."""
    image = torch.zeros(3, 180, 360)
    image[0, 80:100, :10] = image[0, 80:100, -10:] = 1
    image[2, 80:100, 200:220] = 1
    return image
