"""Exploration that looks where a learned model expects to classify most cells correctly."""

from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers.base import own
from semfov.belief.observers.learned_map import MapBelief
from semfov.gaze.acquisition.base import AcquisitionFunction


class ExpectedGain(AcquisitionFunction):
    r"""Expected number of additional cells that the map classifies correctly after a look, :math:`E[\Delta \mid f]`.

    `MapEvidence.gain` predicts the gain of each cell, and this is the sum over the cells. The prediction was learned
    from looks of explorations: a cell gains by a closer look, and gains more where the map is less certain. An
    exploration can end when no cell is expected to gain more than a look costs
    (`semfov.ActivePerception.explore(worth=...)`).

    Args:
        model: the model that the map is learned with.
        grid: the cells of one image.

    >>> from semfov.belief.observers import LearnedMap
    >>> import torch
    >>> model = MapEvidence(components=3).requires_grad_(False)
    >>> grid = Grid(3, 1, (30, 10))
    >>> belief = LearnedMap(model).start(1, grid, torch.zeros(1))
    >>> ExpectedGain(model, grid)(belief, torch.zeros(1, 3, dtype=torch.bool)).shape
    torch.Size([1, 3])
    """

    distance: Tensor

    def __init__(self, model: MapEvidence, grid: Grid) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("distance", grid.cell_distance)

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)`, in cells, for a belief of `semfov.observers.LearnedMap`."""
        belief = own(belief, MapBelief, "belief")
        return one_by_one(self._values, belief.probabilities, belief.closest, belief.looks)

    def _values(self, probabilities: Tensor, closest: Tensor, looks: Tensor) -> Tensor:
        return self.model.gain(probabilities, closest, looks, self.distance.to(closest)).sum(-1)
