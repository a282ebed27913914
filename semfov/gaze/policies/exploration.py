"""Policies of scene exploration. Of those that look ahead, `kl`, `negative-entropy` and `two-peaks` are published."""

from typing import Self

from torch import Tensor

from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.gaze.acquisition.accuracy import ExpectedAccuracy
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.closer_look import CloserLook
from semfov.gaze.acquisition.expected_gain import ExpectedGain
from semfov.gaze.acquisition.exploration import (
    BayesianSurprise,
    KLDivergence,
    NegativeEntropy,
    ProbabilityOfImprovement,
    TwoPeaks,
    UpperConfidenceBound,
)
from semfov.gaze.acquisition.objects import ObjectEvidence
from semfov.gaze.policies.base import GazeModel, Means, ModelPolicy, Policy


class KL(ModelPolicy):
    """Where a look takes the map furthest from its prior (`semfov.acquisition.KLDivergence`).

    Args:
        model: observation model.
        prior: Dirichlet parameter of every class before the first look.
    """

    name = "kl"
    tasks = ("exploration",)

    def __init__(self, model: GazeModel, prior: float = 0.5) -> None:
        super().__init__(model)
        self.prior = prior

    @classmethod
    def make(cls, means: Means) -> Self:
        """With the observation model and the prior."""
        assert means.model is not None
        return cls(means.model, means.prior)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The divergence from the prior."""
        return KLDivergence(self.model, grid, prior=self.prior)


class Surprise(ModelPolicy):
    """Where a look changes the map most (`semfov.acquisition.BayesianSurprise`)."""

    name = "surprise"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The divergence from the present map."""
        return BayesianSurprise(self.model, grid)


class Negentropy(ModelPolicy):
    """Where a look leaves the map most certain (`semfov.acquisition.NegativeEntropy`)."""

    name = "negative-entropy"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The entropy lost."""
        return NegativeEntropy(self.model, grid)


class Peaks(ModelPolicy):
    """Where a look changes the lead of the most probable class most (`semfov.acquisition.TwoPeaks`)."""

    name = "two-peaks"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The change of the lead."""
        return TwoPeaks(self.model, grid)


class ConfidenceBound(ModelPolicy):
    """Where a look raises upper confidence bounds most (`semfov.acquisition.UpperConfidenceBound`)."""

    name = "upper-confidence-bound"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The rise of the bounds."""
        return UpperConfidenceBound(self.model, grid)


class Improvement(ModelPolicy):
    """Where a look most likely makes the map surer (`semfov.acquisition.ProbabilityOfImprovement`)."""

    name = "probability-of-improvement"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The probability of improvement."""
        return ProbabilityOfImprovement(self.model, grid)


class Accuracy(ModelPolicy):
    """Where a look names most cells right (`semfov.acquisition.ExpectedAccuracy`); needs miss rates."""

    name = "expected-accuracy"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The cells that are named right."""
        return ExpectedAccuracy(self.model, grid)


class Closer(Policy):
    """Where the fovea comes closest to what is not named yet (`semfov.acquisition.CloserLook`).

    Args:
        fovea: width σ of the fovea in longer sides of the image.
    """

    name = "closer-look"
    tasks = ("exploration",)

    def __init__(self, fovea: float = 100 / 640) -> None:
        super().__init__()
        self.fovea = fovea

    @classmethod
    def make(cls, means: Means) -> Self:
        """With the width of the fovea."""
        return cls(means.fovea)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The acuity gained."""
        return CloserLook(grid, self.fovea)


class Gain(Policy):
    """Where a look is expected to name most cells right that are not yet (`semfov.acquisition.ExpectedGain`).

    Args:
        model: learned map.
    """

    name = "expected-gain"
    tasks = ("exploration",)
    needs_map = True

    def __init__(self, model: MapEvidence) -> None:
        super().__init__()
        self.model = model

    @classmethod
    def make(cls, means: Means) -> Self:
        """With the learned map."""
        assert means.map is not None
        return cls(means.map)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The cells gained."""
        return ExpectedGain(self.model, grid)


class Objects(Policy):
    """Where an object is (`semfov.acquisition.ObjectEvidence`): with a `Landing` observer, where people look."""

    name = "objects"
    tasks = ("exploration",)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The evidence for any object."""
        return ObjectEvidence()
