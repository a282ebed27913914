"""Models of a head that need no trained weights: the detector sees squares of pure colour."""

import pytest
import torch

from semfov import Eye, FovealObservationModel, Foveation
from semfov.observation.presence import Presence
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
    classes = ["red", "green", "blue"]
    odds = torch.tensor([[1.0, 1], [0.1, 0.3], [0.15, 0.2], [0.2, 0.35]])
    presence = Presence(torch.tensor(-0.4), torch.tensor([0.7, 0.2]), torch.full((3,), 0.5))
    search = FovealObservationModel.identity(classes, [0.2], miss_odds=odds, refutation=0.6, presence=presence)
    # Its map is in doubt about cells without detections, so that some looks in a view pay.
    observation = FovealObservationModel.identity(classes, [0.2], cell=(0.4, 1.0, 1.0))
    return search.requires_grad_(False), observation.requires_grad_(False)


@pytest.fixture
def panorama():
    """360 × 180 px, black, with a red square behind, across the seam, and a blue one ahead, to the right."""
    image = torch.zeros(3, 180, 360)
    image[0, 80:100, :10] = image[0, 80:100, -10:] = 1
    image[2, 80:100, 200:220] = 1
    return image
