"""Shared by the tests of decisions."""

import pytest
import torch


@pytest.fixture
def image():
    """A red square of 20 pixels in the last of 4 × 3 cells."""
    picture = torch.full((3, 120, 160), 0.4)
    picture[:, 90:110, 130:150] = torch.tensor([0.9, 0.1, 0.1])[:, None, None]
    return picture
