"""What a policy is, and where policies are registered by name."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol, Self

from torch import Tensor, nn

from semfov.belief.grid import Grid
from semfov.belief.map_evidence import MapEvidence
from semfov.errors import InputError, lookup
from semfov.gaze.acquisition.accuracy import SightedModel
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.ideal import SignalModel
from semfov.gaze.acquisition.lookahead import LevelledModel
from semfov.gaze.acquisition.place import MissModel
from semfov.gaze.learned import LearnedGaze

Task = Literal["search", "exploration"]


class GazeModel(LevelledModel, MissModel, SightedModel, SignalModel, Protocol):
    """What all policies together need of an observation model (`semfov.FovealObservationModel`)."""


@dataclass(frozen=True)
class Means:
    """What a policy may be made from.

    Attributes:
        model: observation model, for the scores to expect and for miss rates.
        gaze: learned gaze policy.
        map: learned map.
        fovea: width σ of the fovea in longer sides of the image.
        prior: Dirichlet parameter of every class before the first look.
    """

    model: GazeModel | None = None
    gaze: LearnedGaze | None = None
    map: MapEvidence | None = None
    fovea: float = 100 / 640
    prior: float = 0.5


class Policy(nn.Module, ABC):
    """Base of all policies: how to choose where to look, for any target on any grid.

    A subclass is registered under its `name` when it is defined, and can then be named in settings. `needs_model`,
    `needs_gaze` and `needs_map` say what it is made from, and `make` takes that from `Means`.

    Attributes:
        name: that settings know it by.
        tasks: what it is for.
        needs_model: whether it is made from an observation model.
        needs_gaze: whether it is made from a learned gaze policy.
        needs_map: whether it is made from a learned map, and goes by that.
        by_place: whether it searches by the target's probability in every cell alone, and so with any belief.
    """

    name: ClassVar[str]
    tasks: ClassVar[tuple[Task, ...]]
    needs_model: ClassVar[bool] = False
    needs_gaze: ClassVar[bool] = False
    needs_map: ClassVar[bool] = False
    by_place: ClassVar[bool] = False

    def __init_subclass__(cls, **options: object) -> None:
        super().__init_subclass__(**options)
        if "name" in cls.__dict__:
            POLICIES[cls.name] = cls

    @classmethod
    def make(cls, means: Means) -> Self:
        """The policy from what it needs."""
        return cls()

    @abstractmethod
    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """The acquisition function for a target on a grid.

        Args:
            target: class 1..K, a tensor `(B,)` with one for each episode, or None where nothing is searched for.
            grid: the cells.
        """


class ModelPolicy(Policy):
    """Base of the policies that know how the detector sees.

    Args:
        model: observation model.
    """

    needs_model = True

    def __init__(self, model: GazeModel) -> None:
        super().__init__()
        self.model = model

    @classmethod
    def make(cls, means: Means) -> Self:
        """With the observation model."""
        assert means.model is not None
        return cls(means.model)


POLICIES: dict[str, type[Policy]] = {}
"""Every policy by its name."""


def policy_names(task: Task) -> list[str]:
    """Names of the policies for a task.

    >>> policy_names("search")[:3]
    ['random', 'non-predictive', 'predictive']
    """
    return [name for name, kind in POLICIES.items() if task in kind.tasks]


def named_policy(name: str, task: Task, means: Means | None = None) -> Policy:
    """The policy of a name.

    Args:
        name: of a registered policy.
        task: what it must be for.
        means: what it may be made from.

    Raises:
        InputError: no policy for this task has that name, or it needs what `means` has not.

    >>> named_policy("non-predictive", "search")(3, Grid(10, 10, (640, 480)))
    TargetPosterior()
    """
    kind = POLICIES[lookup(name, policy_names(task), f"{task} policy")]
    means = means or Means()
    if kind.needs_model and means.model is None:
        raise InputError(f"policy {name!r}: expected an observation model for the scores to expect, got none")
    if kind.needs_gaze and means.gaze is None:
        raise InputError(f"policy {name!r}: expected a learned gaze policy, got none")
    if kind.needs_map and means.map is None:
        raise InputError(f"policy {name!r}: expected a learned map, got none")
    return kind.make(means)


def wanted(target: int | Tensor | None, name: str) -> int | Tensor:
    """The target, which a policy of this name cannot do without."""
    if target is None:
        raise InputError(f"policy {name!r}: expected a target to search for, got none")
    return target
