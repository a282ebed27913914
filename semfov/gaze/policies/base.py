"""The base class of policies, and their registry by name."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, Self

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.lookahead import sampled_likelihoods
from semfov.observation.foveal import FovealObservationModel

Task = Literal["search", "exploration"]


@dataclass(frozen=True)
class Means:
    """The models and settings that policies are made from; `Policy.make` takes the ones it needs.

    Attributes:
        model: observation model, for the expected scores and the miss rates.
        map: learned map.
        fovea: width σ of the fovea in units of the image's longer side.
        prior: Dirichlet parameter of every class before the first look.
        samples: number of drawn looks over which policies that predict looks take the expectation; None takes the look
            with the expected scores.
        calibrated: whether scores are calibrated before they update the belief; it matters for drawn looks.

    >>> named_policy("kl", "exploration", Means(prior=1.0))
    Traceback (most recent call last):
    ...
    semfov.errors.InputError: policy 'kl': expected an observation model in `Means.model`, got none
    """

    model: FovealObservationModel | None = None
    map: MapEvidence | None = None
    fovea: float = 100 / 640
    prior: float = 0.5
    samples: int | None = None
    calibrated: bool = True


class Policy(nn.Module, ABC):
    """Base of all policies: how to choose where to look, for any target on any grid.

    A subclass is registered under its `name` when it is defined, and settings can then refer to it by that name.
    `needs_model` and `needs_map` declare what it is made from, and `make` takes that from `Means`.

    Attributes:
        name: name in settings.
        tasks: tasks that the policy is for.
        needs_model: whether it is made from an observation model.
        needs_map: whether it is made from a learned map, and works on the belief of that map alone.
        by_belief: whether its choice depends on the belief.
        by_samples: whether it can take an expectation over drawn looks (`SamplingPolicy`).
        by_place: whether it searches by the probability of the target in every cell alone, and so works on any belief.

    >>> from semfov import acquisition
    >>> class Leftmost(Policy):
    ...     name, tasks = "leftmost", ("search", "exploration")
    ...     def forward(self, target, grid):
    ...         return acquisition.Static(-grid.centres[:, 0])
    >>> named_policy("leftmost", "search")(3, Grid(10, 10, (640, 480)))
    Static()
    >>> del POLICIES["leftmost"]
    """

    name: ClassVar[str]
    tasks: ClassVar[tuple[Task, ...]]
    needs_model: ClassVar[bool] = False
    needs_map: ClassVar[bool] = False
    by_belief: ClassVar[bool] = True
    by_samples: ClassVar[bool] = False
    by_place: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "name" in cls.__dict__:
            POLICIES[cls.name] = cls

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy from the models and settings that it needs.

        Args:
            means: models and settings; those that the policy declares to need are given.

        Returns:
            The policy.
        """
        return cls()

    @abstractmethod
    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """Make the acquisition function for a target on a grid.

        Args:
            target: class 1..K, a tensor `(B,)` with one for each episode, or None in an exploration.
            grid: the cells.

        Returns:
            The acquisition function.
        """


class ModelPolicy(Policy):
    """Base of the policies that use an observation model: how well the detector sees at each distance from the fovea.

    Args:
        model: observation model.

    Attributes:
        function: acquisition function that `forward` makes, unless a subclass defines `forward`.

    >>> issubclass(POLICIES["predictive"], ModelPolicy), issubclass(POLICIES["random"], ModelPolicy)
    (True, False)
    """

    needs_model = True
    function: ClassVar[type[AcquisitionFunction]]

    def __init__(self, model: FovealObservationModel) -> None:
        super().__init__()
        self.model = model

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The acquisition function `function` of the model and the grid, in a search for the target."""
        searched = (required_target(target, self.name),) if "search" in self.tasks else ()
        return self.function(*searched, self.model, grid)

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the observation model."""
        assert means.model is not None
        return cls(means.model)


class SamplingPolicy(ModelPolicy):
    """Base of the policies that can take the expectation over drawn looks, in place of the look with expected scores.

    Args:
        model: observation model; for samples its Dirichlets must be densities of the scores.
        samples: number of looks that are drawn for each class and level; None takes the expected scores, as published.
        calibrated: whether the scores of a drawn look are calibrated before they update the belief.

    Raises:
        InputError: `samples` is less than 1, or the model's Dirichlets are not densities of the scores.

    >>> issubclass(POLICIES["kl"], SamplingPolicy), issubclass(POLICIES["neighbourhood"], SamplingPolicy)
    (True, False)
    """

    by_samples = True
    likelihoods: Tensor | None

    def __init__(self, model: FovealObservationModel, samples: int | None = None, calibrated: bool = True) -> None:
        super().__init__(model)
        drawn = None if samples is None else sampled_likelihoods(model, samples, calibrated=calibrated)
        self.register_buffer("likelihoods", drawn, persistent=False)

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The acquisition function `function` of the model, the grid and the drawn looks."""
        return self.function(self.model, grid, likelihoods=self.likelihoods)

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the observation model and the number of samples."""
        assert means.model is not None
        return cls(means.model, means.samples, means.calibrated)


POLICIES: dict[str, type[Policy]] = {}
"""All registered policies by name."""


def policy_names(task: Task) -> list[str]:
    """Names of the policies for a task.

    Args:
        task: `search` or `exploration`.

    Returns:
        The names in the order of registration.

    >>> "predictive" in policy_names("search"), "kl" in policy_names("search")
    (True, False)
    """
    return [name for name, kind in POLICIES.items() if task in kind.tasks]


def named_policy(name: str, task: Task, means: Means | None = None) -> Policy:
    """Make a policy by its name.

    Args:
        name: name of a registered policy.
        task: task that it must be for, `search` or `exploration`.
        means: models and settings to make it from.

    Returns:
        The policy.

    Raises:
        InputError: no policy for this task has that name, or `means` lacks a model that it needs.

    >>> named_policy("non-predictive", "search")(3, Grid(10, 10, (640, 480)))
    TargetPosterior()
    """
    kind = POLICIES[lookup(name, policy_names(task), f"{task} policy")]
    means = means or Means()
    if kind.needs_model and means.model is None:
        raise InputError(f"policy {name!r}: expected an observation model in `Means.model`, got none")
    if kind.needs_map and means.map is None:
        raise InputError(f"policy {name!r}: expected a learned map in `Means.map`, got none")
    return kind.make(means)


def required_target(target: int | Tensor | None, name: str) -> int | Tensor:
    """Return the target, or raise an error where there is none.

    A search policy calls it in `forward`.

    Args:
        target: class 1..K, a tensor `(B,)`, or None.
        name: name of the policy, for the error.

    Returns:
        The target.

    Raises:
        InputError: `target` is None.

    >>> required_target(3, "non-predictive")
    3
    """
    if target is None:
        raise InputError(f"policy {name!r}: expected a target to search for, got none")
    return target
