"""Images that all saliency tests share."""

import numpy as np
import pytest
import torch


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
