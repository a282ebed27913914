"""Images that all saliency tests share."""

import numpy as np
import pytest
import torch
from torch import Tensor


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def tolerance(dtype: torch.dtype) -> float:
    """Largest error allowed to values up to 1."""
    return 5e-6 if dtype == torch.float32 else 1e-6


@pytest.fixture
def photograph() -> np.ndarray:
    """Part of a photograph, with an odd height and width, `(97, 131, 3)` in [0, 1]."""
    from skimage import data

    return data.astronaut()[40 : 40 + 2 * 97 : 2, 150 : 150 + 2 * 131 : 2] / 255


@pytest.fixture
def pop_out() -> Tensor:
    """A red square among green ones of the same intensity on grey, `(1, 3, 240, 320)`; the red one is at (100, 180)."""
    image = torch.full((1, 3, 240, 320), 0.35)
    for row in range(4):
        for column in range(6):
            top, left = 36 + row * 32, 20 + column * 40
            image[..., top : top + 16, left : left + 16] = torch.tensor([0.1, 0.85, 0.1])[:, None, None]
    image[..., 100:116, 180:196] = torch.tensor([0.85, 0.1, 0.1])[:, None, None]
    return image
