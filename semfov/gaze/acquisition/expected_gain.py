"""Exploration that looks where it has learned that a look names most."""

from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers.base import own
from semfov.belief.observers.learned_map import MapBelief
from semfov.gaze.acquisition.base import AcquisitionFunction


class ExpectedGain(AcquisitionFunction):
    r"""How many more cells a look from each cell is expected to name right, :math:`E[\Delta \mid f]`.

    The sum over all cells of what `MapEvidence.gain` has learned from the looks of explorations: a cell gains by a
    closer look, and more so the less sure the map is of it. An exploration is worth its price as long as some cell is
    expected to gain more (`semfov.ActivePerception.explore(until=...)`).

    Args:
        model: that the map is learned with.
        grid: the cells of one image.
    """

    distance: Tensor

    def __init__(self, model: MapEvidence, grid: Grid) -> None:
        super().__init__()
        self.model = model
        self.register_buffer("distance", grid.cell_distance)

    def forward(self, belief: Belief, visited: Tensor) -> Tensor:
        """Values `(B, X·Y)` in cells, for a belief of `semfov.observers.LearnedMap`."""
        known = own(belief, MapBelief, "belief")
        return one_by_one(self._values, known.probabilities, known.closest, known.looks)

    def _values(self, probabilities: Tensor, closest: Tensor, looks: Tensor) -> Tensor:
        return self.model.gain(probabilities, closest, looks, self.distance.to(closest)).sum(-1)
