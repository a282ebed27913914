"""Policies of visual search.

`random`, `non-predictive` and `predictive` are those of Luzio, Bernardino and Moreno (2024). `entropy-limit` and
`ideal-observer` are those of Najemnik and Geisler (2009, 2005), whose maximum a posteriori searcher equals
`non-predictive`. The others are ours.
"""

from typing import ClassVar

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import InputError
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.ideal import CorrectLocalisation, EntropyLimit
from semfov.gaze.acquisition.place import FovealHit, PlaceInformation
from semfov.gaze.acquisition.search import NeighbourhoodPosterior, PredictedTargetPosterior, TargetPosterior
from semfov.gaze.acquisition.static import Static, Uniform
from semfov.gaze.policies.base import ModelPolicy, Policy, SamplingPolicy, Task, required_target


class Random(Policy):
    """Look at random, in searches and explorations (`semfov.acquisition.Uniform`).

    >>> Random()(None, Grid(4, 3, (40, 30)))
    Uniform()
    """

    name = "random"
    tasks: ClassVar[tuple[Task, ...]] = ("search", "exploration")
    by_belief = False

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The same value for every cell."""
        return Uniform()


class SaliencyMaximum(Policy):
    """Look at the most salient cell of a scene, whatever the target and the belief (`semfov.acquisition.Static`).

    Args:
        saliency: `(X·Y,)` or `(B, X·Y)`, saliency of the cells; None where runs give it for every scene.

    Raises:
        InputError: the policy is used without the saliency of a scene.

    >>> import torch
    >>> policy = SaliencyMaximum(torch.tensor([0.4, 0.2]))
    >>> policy(None, Grid(2, 1, (20, 10))).values
    tensor([0.4000, 0.2000])
    """

    name = "saliency"
    tasks: ClassVar[tuple[Task, ...]] = ("search", "exploration")
    by_belief = False
    saliency: Tensor | None

    def __init__(self, saliency: Tensor | None = None) -> None:
        super().__init__()
        self.register_buffer("saliency", saliency, persistent=False)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The saliency of all cells."""
        if self.saliency is None:
            raise InputError("policy 'saliency': expected the saliency of a scene, got none")
        return Static(self.saliency)


class NonPredictive(Policy):
    """Look where the target is most probable (`semfov.acquisition.TargetPosterior`).

    It equals the maximum a posteriori (MAP) searcher that Najemnik and Geisler (2005) compare with their ideal one.

    >>> NonPredictive()(3, Grid(4, 3, (40, 30)))
    TargetPosterior()
    """

    name = "non-predictive"
    tasks = ("search",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The posterior of the target."""
        return TargetPosterior(required_target(target, self.name))


class Predictive(SamplingPolicy):
    """Look where the target will be most probable after the look (`semfov.acquisition.PredictedTargetPosterior`).

    Args:
        model: observation model.
        samples: number of drawn looks for each class and level; None takes the look with the expected scores.
        calibrated: whether the scores of a drawn look are calibrated (`SamplingPolicy`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Predictive(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(1, Grid(4, 3, (40, 30)))).__name__
    'PredictedTargetPosterior'
    """

    name = "predictive"
    tasks = ("search",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The predicted posterior of the target."""
        return PredictedTargetPosterior(required_target(target, self.name), self.model, likelihoods=self.likelihoods)


class Neighbourhood(ModelPolicy):
    """Look where the target is expected in the cell or its neighbours (`semfov.acquisition.NeighbourhoodPosterior`).

    Args:
        model: observation model.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Neighbourhood(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(1, Grid(4, 3, (40, 30)))).__name__
    'NeighbourhoodPosterior'
    """

    name = "neighbourhood"
    tasks = ("search",)
    function = NeighbourhoodPosterior


class FovealHits(ModelPolicy):
    """Look from where a detection of the target is most probable (`semfov.acquisition.FovealHit`).

    Args:
        model: observation model, with miss rates.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"], miss_rate=torch.full((2, 1), 0.5))
    >>> type(FovealHits(model)(1, Grid(4, 3, (40, 30)))).__name__
    'FovealHit'
    """

    name = "foveal-hit"
    tasks = ("search",)
    by_place = True
    function = FovealHit


class InformationOnPlace(ModelPolicy):
    """Look from where most information about the target's place is expected (`semfov.acquisition.PlaceInformation`).

    Args:
        model: observation model, with miss rates.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"], miss_rate=torch.full((2, 1), 0.5))
    >>> type(InformationOnPlace(model)(1, Grid(4, 3, (40, 30)))).__name__
    'PlaceInformation'
    """

    name = "place-information"
    tasks = ("search",)
    by_place = True
    function = PlaceInformation


class EntropyLimitMinimisation(ModelPolicy):
    """Look from where the entropy of the target's place can fall most (`semfov.acquisition.EntropyLimit`).

    Args:
        model: observation model, with miss rates, whose Dirichlets are densities of the scores
            (`semfov.observation.visibility`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"], miss_rate=torch.full((2, 1), 0.5))
    >>> type(EntropyLimitMinimisation(model)(1, Grid(4, 3, (40, 30)))).__name__
    'EntropyLimit'
    """

    name = "entropy-limit"
    tasks = ("search",)
    by_place = True
    function = EntropyLimit


class IdealObserver(ModelPolicy):
    """Look from where the target is most probably located correctly (`semfov.acquisition.CorrectLocalisation`).

    A decision takes a tenth of a second or more for 100 cells.

    Args:
        model: observation model, as for `EntropyLimitMinimisation`.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"], miss_rate=torch.full((2, 1), 0.5))
    >>> type(IdealObserver(model)(1, Grid(4, 3, (40, 30)))).__name__
    'CorrectLocalisation'
    """

    name = "ideal-observer"
    tasks = ("search",)
    by_place = True
    function = CorrectLocalisation
