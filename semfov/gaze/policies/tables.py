"""Policies that choose by a table, computed for every scene: the saliency of its cells, or attention to a target."""

from abc import abstractmethod
from typing import ClassVar, Self

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.errors import InputError
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.gaze.acquisition.static import Static
from semfov.gaze.acquisition.templates import TemplateAttention
from semfov.gaze.policies.base import Means, Policy, Task, required_target


class TablePolicy(Policy):
    """Base of the policies that need a table of every scene; they declare it (`table`) and implement `in_scene`.

    >>> from semfov.gaze.policies import POLICIES
    >>> [(name, kind.table) for name, kind in POLICIES.items() if issubclass(kind, TablePolicy)]
    [('saliency', 'saliency'), ('ivsn', 'attention')]
    """

    def forward(self, target: int | Tensor | None, grid: Grid) -> AcquisitionFunction:
        """Raise an error, since there is no table without a scene."""
        raise InputError(
            f"policy {self.name!r}: expected the {self.table} of a scene, which `in_scene` takes, got none"
        )

    @abstractmethod
    def in_scene(
        self, target: int | Tensor | None, grid: Grid, table: Tensor | None, cell: Tensor
    ) -> AcquisitionFunction:
        """Make the acquisition function of episodes in a scene from its table (`Policy.in_scene`)."""


class SaliencyMaximum(TablePolicy):
    """Look at the most salient cell, whatever the target and the belief (`semfov.acquisition.Static`).

    >>> saliency = torch.tensor([[0.1, 0.7], [0.4, 0.2]])  # of both cells, seen from each of them
    >>> SaliencyMaximum().in_scene(None, Grid(2, 1, (20, 10)), saliency, torch.tensor([1])).values
    tensor([[0.4000, 0.2000]])
    """

    name = "saliency"
    tasks: ClassVar[tuple[Task, ...]] = ("search", "exploration")
    table = "saliency"
    by_belief = False

    def in_scene(
        self, target: int | Tensor | None, grid: Grid, table: Tensor | None, cell: Tensor
    ) -> AcquisitionFunction:
        """The saliency of all cells, seen from the fixated one."""
        return Static(salient_from(_required_table(table, self), cell))


class TemplateSearch(TablePolicy):
    """Look at what resembles the template of the target's class: IVSN (`semfov.acquisition.TemplateAttention`).

    Args:
        fovea: width σ of the fovea in units of the image's longer side; attention falls off with it.

    >>> attention = torch.tensor([[0.1, 0.9], [0.2, 0.3]])[:, None]  # to the one class, seen from each of two cells
    >>> policy = TemplateSearch(fovea=0.2)
    >>> type(policy.in_scene(1, Grid(2, 1, (20, 10)), attention, torch.tensor([0]))).__name__
    'TemplateAttention'
    """

    name = "ivsn"
    tasks = ("search",)
    table = "attention"

    def __init__(self, fovea: float = 100 / 640) -> None:
        super().__init__()
        self.fovea = fovea

    @classmethod
    def make(cls, means: Means) -> Self:
        """Make the policy with the width of the fovea."""
        return cls(means.fovea)

    def in_scene(
        self, target: int | Tensor | None, grid: Grid, table: Tensor | None, cell: Tensor
    ) -> AcquisitionFunction:
        """The attention to the target, accumulated over the fixated cells."""
        return TemplateAttention(required_target(target, self.name), _required_table(table, self), grid, self.fovea)


def _required_table(table: Tensor | None, policy: Policy) -> Tensor:
    """Return the table that a policy needs, or raise an error where there is none."""
    if table is None:
        raise InputError(f"policy {policy.name!r}: expected the {policy.table} of the scene, got none")
    return table


def salient_from(saliency: Tensor, cell: Tensor) -> Tensor:
    """Saliency of all cells in the view from the fixated `cell` of each episode, `(B, X·Y)`."""
    return saliency[cell if len(saliency) > 1 else torch.zeros_like(cell)]
