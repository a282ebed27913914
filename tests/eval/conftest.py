"""An episode that needs no detector, with names that try to be markup."""

import pytest
import torch

from semfov import Detections, Grid, Scanpath


@pytest.fixture
def hostile() -> str:
    """A class name that would run if it were taken for markup."""
    return "<script>document.title='taken'</script>"


@pytest.fixture
def scanpath(hostile: str) -> Scanpath:
    """Three fixations on a 4 × 3 grid; what is believed and seen differs from each to the next."""
    generator = torch.Generator().manual_seed(0)
    grid, cells = Grid(4, 3, (80, 60)), torch.tensor([0, 6, 11])
    scores = torch.rand(3, 2, 4, generator=generator).softmax(-1)
    corner = torch.rand(3, 2, 2, generator=generator) * 40
    boxes = torch.cat([corner, corner + 18], -1)
    looks = Detections(boxes, scores, torch.ones(3, 2, dtype=torch.bool))
    return Scanpath(
        grid=grid,
        classes=("background", "cat", hostile, "cup"),
        target=2,
        cells=cells,
        fixations=grid.centres[cells],
        detections=tuple(looks[number : number + 1] for number in range(3)),
        beliefs=torch.rand(3, 12, 4, generator=generator) + 0.1,
        values=torch.rand(3, 12, generator=generator),
        found=True,
        posterior=torch.rand(3, 12, generator=generator),
    )


@pytest.fixture
def image() -> torch.Tensor:
    """A picture in the frame of the episode."""
    across, down = torch.linspace(0, 1, 80).expand(60, 80), torch.linspace(0, 1, 60)[:, None].expand(60, 80)
    return torch.stack([across, down, 1 - across])
