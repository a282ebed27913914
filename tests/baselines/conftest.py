"""Images that all saliency tests share."""

import numpy as np
import pytest
import torch

from semfov import example


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request: pytest.FixtureRequest) -> torch.dtype:
    return request.param


@pytest.fixture
def tolerance(dtype: torch.dtype) -> float:
    """Largest error allowed to values up to 1."""
    return 5e-6 if dtype == torch.float32 else 1e-6


@pytest.fixture
def photograph() -> np.ndarray:
    """A picture of odd height and width, `(97, 131, 3)` in [0, 1], in colours: each channel is another photograph."""
    names = "beach", "market", "lifeboat"
    parts = [example(name)[0, 80 : 80 + 2 * 97 : 2, 150 : 150 + 2 * 131 : 2] for name in names]
    return torch.stack(parts, -1).double().numpy()
