"""Policies of visual search.

`random`, `non-predictive` and `predictive` are those of Luzio, Bernardino and Moreno (2024), `entropy-limit` and
`ideal-observer` those of Najemnik and Geisler (2009, 2005), whose searcher by maximum a posteriori is `non-predictive`.
The others are ours.
"""

from typing import ClassVar, Self

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.ideal import CorrectLocalisation, EntropyLimit
from semfov.gaze.acquisition.place import FovealHit, PlaceInformation
from semfov.gaze.acquisition.search import NeighbourhoodPosterior, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Uniform
from semfov.gaze.learned import LearnedAcquisition, LearnedGaze
from semfov.gaze.policies.base import Means, ModelPolicy, Policy, Task, wanted


class Random(Policy):
    """Any cell, for searches and explorations (`semfov.acquisition.Uniform`)."""

    name = "random"
    tasks: ClassVar[tuple[Task, ...]] = ("search", "exploration")

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The same value for every cell."""
        return Uniform()


class NonPredictive(Policy):
    """Where the target is most probable (`semfov.acquisition.TargetPosterior`).

    It is also the searcher by maximum a posteriori (MAP) that Najemnik and Geisler (2005) compare with their ideal one.
    """

    name = "non-predictive"
    tasks = ("search",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The posterior of the target."""
        return TargetPosterior(wanted(target, self.name))


class Predictive(ModelPolicy):
    """Where a look is expected to leave the target most probable (`semfov.acquisition.PredictedTargetPosterior`)."""

    name = "predictive"
    tasks = ("search",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The predicted posterior of the target."""
        return PredictedTargetPosterior(wanted(target, self.name), self.model)


class Neighbourhood(ModelPolicy):
    """Where the target is expected in the cell or beside it (`semfov.acquisition.NeighbourhoodPosterior`)."""

    name = "neighbourhood"
    tasks = ("search",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The predicted posterior of the target in the neighbourhood."""
        return NeighbourhoodPosterior(wanted(target, self.name), self.model, grid)


class FovealHits(ModelPolicy):
    """From where the target is most likely detected (`semfov.acquisition.FovealHit`); needs miss rates."""

    name = "foveal-hit"
    tasks = ("search",)
    by_place = True

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The probability of a detection."""
        return FovealHit(wanted(target, self.name), self.model, grid)


class InformationOnPlace(ModelPolicy):
    """From where the target's place is told best (`semfov.acquisition.PlaceInformation`); needs miss rates."""

    name = "place-information"
    tasks = ("search",)
    by_place = True

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The expected information about the place."""
        return PlaceInformation(wanted(target, self.name), self.model, grid)


class EntropyLimitMinimisation(ModelPolicy):
    """From where the entropy of the target's place can fall most (`semfov.acquisition.EntropyLimit`).

    It needs miss rates, and a model whose Dirichlets are densities of the scores (`semfov.observation.visibility`).
    """

    name = "entropy-limit"
    tasks = ("search",)
    by_place = True

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The limit of the entropy lost."""
        return EntropyLimit(wanted(target, self.name), self.model, grid)


class IdealObserver(ModelPolicy):
    """From where the target is most likely told right (`semfov.acquisition.CorrectLocalisation`).

    It needs what `EntropyLimitMinimisation` does, and time: a tenth of a second and more for 100 cells.
    """

    name = "ideal-observer"
    tasks = ("search",)
    by_place = True

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The probability of being right."""
        return CorrectLocalisation(wanted(target, self.name), self.model, grid)


class Learned(Policy):
    """A gaze policy learned end to end (`semfov.gaze.LearnedGaze`).

    Args:
        gaze: the learned network.
    """

    name = "learned"
    tasks = ("search",)
    needs_gaze = True

    def __init__(self, gaze: LearnedGaze) -> None:
        super().__init__()
        self.gaze = gaze

    @classmethod
    def make(cls, means: Means) -> Self:
        """With the learned network."""
        assert means.gaze is not None
        return cls(means.gaze)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """What the network makes of the belief."""
        return LearnedAcquisition(self.gaze, wanted(target, self.name), grid)
