"""The choice of people's next fixation."""

import torch

from semfov import Grid
from semfov.gaze import Viewer
from semfov.gaze.saliency import FixationDensity

SIZE = (60, 80)


def model_of(log):
    torch.manual_seed(0)
    model = FixationDensity({"none": 1}).requires_grad_(False)
    model.oculomotor.saccade.normal_(0, 0.3)
    return model, {"map": log[None], "centre bias": torch.zeros(1, *log.shape)}


def test_cells_are_drawn_as_often_as_the_density_says():
    """Twin: the sum of the density over the fine cells in each cell of the grid, among those not visited."""
    model, terms = model_of(torch.randn(39, 52))
    grid, draws = Grid(4, 3, (80, 60)), 2000
    start = torch.full((draws,), 5)
    choice = Viewer(model, terms, grid, start, torch.Generator().manual_seed(1))
    visited = torch.zeros(draws, 12, dtype=torch.bool)
    visited[:, [5, 0]] = True
    points, cells = choice(0, torch.arange(draws), torch.zeros(draws, 12), visited, grid.centres)
    path = grid.centres[5].view(1, 1, 2)
    density = torch.stack([*model.given(terms, SIZE, path).values()]).sum(0)[0].flatten().softmax(0).view(39, 52)
    expected = density.view(3, 13, 4, 13).sum((1, 3)).flatten()
    expected[[5, 0]] = 0
    share = torch.bincount(cells, minlength=12) / draws
    torch.testing.assert_close(share, expected / expected.sum(), atol=0.04, rtol=0)
    torch.testing.assert_close(points, grid.centres[cells])


def test_the_path_grows_and_ended_episodes_stay_where_they_are():
    model, terms = model_of(torch.zeros(39, 52))
    grid = Grid(4, 3, (80, 60))
    choice = Viewer(model, terms, grid, torch.tensor([0, 3]), torch.Generator().manual_seed(1))
    only = torch.arange(12).expand(2, -1) != 7
    choice(0, torch.tensor([0, 1]), torch.zeros(2, 12), only, grid.centres)
    choice(1, torch.tensor([1]), torch.zeros(1, 12), torch.ones(1, 12, dtype=torch.bool), grid.centres)
    assert choice.path.shape == (2, 3, 2)
    torch.testing.assert_close(choice.path[:, 1], grid.centres[[7, 7]].float())
    torch.testing.assert_close(choice.path[0, 2], grid.centres[7].float())
