"""What all tests share: devices, the development photographs, and a hypothesis profile without a stopwatch."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from hypothesis import HealthCheck, settings

settings.register_profile("semfov", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("semfov")


@pytest.fixture(
    params=["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU"))]
)
def device(request: pytest.FixtureRequest) -> torch.device:
    """Every device that this machine has."""
    return torch.device(request.param)


@pytest.fixture
def one_thread() -> Iterator[None]:
    """One thread, which repeats itself to the bit; the number before is put back at the end."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder of the development photographs and models."""
    folder = Path(os.environ.get("SEMFOV_SHARED", Path(__file__).parents[2] / "shared"))
    if not (folder / "coco").is_dir():
        pytest.skip(f"no development data in {folder} (set SEMFOV_SHARED)")
    return folder
