"""Policies of scene exploration.

`kl`, `negative-entropy` and `two-peaks` are those of Luzio, Bernardino and Moreno (2024).
"""

from typing import Self

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.gaze.acquisition.accuracy import ExpectedAccuracy, ExpectedGain
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.exploration import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.policies.base import Means, ModelPolicy, Policy, SamplingPolicy
from semfov.observation.foveal import FovealObservationModel


class KL(SamplingPolicy):
    """Look where the divergence of the map from its prior is expected to grow most (`semfov.acquisition.KLDivergence`).

    Args:
        model: observation model.
        prior: Dirichlet parameter of every class before the first look.
        samples: number of drawn looks for each class and level; None takes the look with the expected scores.
        calibrated: whether the scores of a drawn look are calibrated (`SamplingPolicy`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = KL(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]), prior=1.0)
    >>> policy(None, Grid(4, 3, (40, 30))).prior
    1.0
    """

    name = "kl"
    tasks = ("exploration",)

    def __init__(
        self, model: FovealObservationModel, prior: float = 0.5, samples: int | None = None, calibrated: bool = True
    ) -> None:
        super().__init__(model, samples, calibrated)
        self.prior = prior

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the observation model, the prior and the number of samples."""
        assert means.model is not None
        return cls(means.model, means.prior, means.samples, means.calibrated)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The divergence from the prior."""
        return KLDivergence(self.model, grid, prior=self.prior, likelihoods=self.likelihoods)


class Surprise(SamplingPolicy):
    """Look where the map is expected to change most (`semfov.acquisition.BayesianSurprise`).

    Args:
        model: observation model.
        samples: number of drawn looks for each class and level; None takes the look with the expected scores.
        calibrated: whether the scores of a drawn look are calibrated (`SamplingPolicy`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Surprise(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(None, Grid(4, 3, (40, 30)))).__name__
    'BayesianSurprise'
    """

    name = "surprise"
    tasks = ("exploration",)
    function = BayesianSurprise


class Negentropy(SamplingPolicy):
    """Look where the entropy of the map is expected to fall most (`semfov.acquisition.NegativeEntropy`).

    Args:
        model: observation model.
        samples: number of drawn looks for each class and level; None takes the look with the expected scores.
        calibrated: whether the scores of a drawn look are calibrated (`SamplingPolicy`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Negentropy(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(None, Grid(4, 3, (40, 30)))).__name__
    'NegativeEntropy'
    """

    name = "negative-entropy"
    tasks = ("exploration",)
    function = NegativeEntropy


class Peaks(SamplingPolicy):
    """Look where the margin of a most probable class is expected to change most (`semfov.acquisition.TwoPeaks`).

    Args:
        model: observation model.
        samples: number of drawn looks for each class and level; None takes the look with the expected scores.
        calibrated: whether the scores of a drawn look are calibrated (`SamplingPolicy`).

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Peaks(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(None, Grid(4, 3, (40, 30)))).__name__
    'TwoPeaks'
    """

    name = "two-peaks"
    tasks = ("exploration",)
    function = TwoPeaks


class ConfidenceBound(ModelPolicy):
    """Look where the upper confidence bounds are expected to rise most (`semfov.acquisition.UpperConfidenceBound`).

    Args:
        model: observation model.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = ConfidenceBound(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(None, Grid(4, 3, (40, 30)))).__name__
    'UpperConfidenceBound'
    """

    name = "upper-confidence-bound"
    tasks = ("exploration",)
    function = UpperConfidenceBound


class Improvement(ModelPolicy):
    """Look where the map most probably becomes more certain (`semfov.acquisition.ProbabilityOfImprovement`).

    Args:
        model: observation model.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> policy = Improvement(FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"]))
    >>> type(policy(None, Grid(4, 3, (40, 30)))).__name__
    'ProbabilityOfImprovement'
    """

    name = "probability-of-improvement"
    tasks = ("exploration",)
    function = ProbabilityOfImprovement


class Accuracy(ModelPolicy):
    """Look where most cells are expected to become correct (`semfov.acquisition.ExpectedAccuracy`).

    Args:
        model: observation model, with miss rates.

    >>> import torch
    >>> from semfov import FovealObservationModel
    >>> model = FovealObservationModel(torch.ones(2, 1, 2), [], ["cup"], miss_rate=torch.full((2, 1), 0.5))
    >>> type(Accuracy(model)(None, Grid(4, 3, (40, 30)))).__name__
    'ExpectedAccuracy'
    """

    name = "expected-accuracy"
    tasks = ("exploration",)
    function = ExpectedAccuracy


class Closer(Policy):
    """Look where the fovea comes closer than before to cells whose class is unknown (`semfov.acquisition.CloserLook`).

    Args:
        fovea: width σ of the fovea in units of the image's longer side.

    >>> Closer(0.2)(None, Grid(4, 3, (40, 30)))
    CloserLook(fovea=0.2)
    """

    name = "closer-look"
    tasks = ("exploration",)

    def __init__(self, fovea: float = 100 / 640) -> None:
        super().__init__()
        self.fovea = fovea

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the width of the fovea."""
        return cls(means.fovea)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The acuity gained."""
        return CloserLook(grid, self.fovea)


class Gain(Policy):
    """Look where a learned map expects most additional cells to become correct (`semfov.acquisition.ExpectedGain`).

    Args:
        model: learned map.

    >>> type(Gain(MapEvidence(components=3))(None, Grid(4, 3, (40, 30)))).__name__
    'ExpectedGain'
    """

    name = "expected-gain"
    tasks = ("exploration",)
    needs_map = True

    def __init__(self, model: MapEvidence) -> None:
        super().__init__()
        self.model = model

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the learned map."""
        assert means.map is not None
        return cls(means.map)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The expected number of additional correct cells."""
        return ExpectedGain(self.model, grid)
