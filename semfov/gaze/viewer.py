"""A choice of the next fixation that imitates people who view a picture freely."""

from collections.abc import Mapping

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.gaze.choice import Choice
from semfov.gaze.saliency import FixationDensity, cell_saliency


class Viewer(Choice):
    """Sample each fixation from the predicted density of people's next fixations, given the fixations so far.

    A cell is drawn with the probability that the density has in it, among the cells not visited, as for any policy.
    The values of the acquisition function do not matter.

    Args:
        model: density of people's fixations.
        terms: its terms for the picture (`FixationDensity.terms`, without a scanpath).
        grid: the cells over the picture.
        start: `(B,)`, the first cell of each episode.
        generator: random generator of the draws.

    >>> model, grid = FixationDensity({"backbone8": 3}).requires_grad_(False), Grid(4, 3, (80, 60))
    >>> terms = model.terms({"backbone8": torch.rand(1, 3, 6, 8)}, (60, 80))
    >>> choice = Viewer(model, terms, grid, torch.tensor([5]), torch.Generator().manual_seed(0))
    >>> visited = torch.arange(12)[None] != 7
    >>> choice(0, torch.tensor([0]), torch.zeros(1, 12), visited, grid.centres)[1]
    tensor([7])
    """

    def __init__(
        self,
        model: FixationDensity,
        terms: Mapping[str, Tensor],
        grid: Grid,
        start: Tensor,
        generator: torch.Generator | None = None,
    ) -> None:
        self.model = model
        self.terms = terms
        self.grid = grid
        self.generator = generator
        # All fixations so far, `(B, n, 2)`; an episode that has ended repeats its last one.
        self.path = grid.centres.to(model.read)[start][:, None]

    @torch.no_grad()
    def __call__(
        self, shift: int, episodes: Tensor, values: Tensor, visited: Tensor, centres: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Return the centre of the drawn cell and the cell; any cell where all were visited."""
        height_and_width = int(self.grid.size[1]), int(self.grid.size[0])
        device = self.path.device
        rows = episodes.to(device)
        terms = self.model.given(self.terms, height_and_width, self.path[rows])
        log_density = torch.stack([*terms.values()]).sum(0)
        pixel_density = log_density.flatten(1).double().softmax(1).view_as(log_density)
        density = cell_saliency(pixel_density, self.grid.columns, self.grid.rows)

        # Where all cells were visited, or those that were not have no probability, all of them are alike.
        free = ~visited.to(device)
        may_be_drawn = free | ~free.any(-1, keepdim=True)
        weights = (density + torch.finfo(density.dtype).tiny) * may_be_drawn
        # On the CPU, so that a seed draws the same fixations on every device.
        cell = weights.cpu().multinomial(1, generator=self.generator)[:, 0].to(visited.device)

        following = self.path[:, -1].clone()
        following[rows] = centres[cell].to(following)
        self.path = torch.cat([self.path, following[:, None]], 1)
        return centres[cell], cell
