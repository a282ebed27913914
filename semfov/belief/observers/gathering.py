"""What observers have in common that weigh all looks by networks: what looks say, what is gathered, and how."""

from __future__ import annotations

from abc import ABC
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.evidence import Evidence, farther, nearness
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer

READ = ("closest", "score", "looks", "visited")
"""What networks read as it is, in the order of `Gathered`."""


@dataclass(frozen=True)
class EvidenceLook(Look):
    """What looks say of a class in every cell, or of T classes at once.

    Attributes:
        evidence: `(B, X·Y)` or `(B, T, X·Y)`, log odds.
        distance: `(B, X·Y)`, from the fixation, in longer sides of the image.
        score: `(B,)` or `(B, T)`, highest score of each class in any detection.
        fixated: `(B,)`, cell that holds the fixation.
        target: `(B,)` or `(B, T)`, the classes.
        columns: cells in a row.
    """

    evidence: Tensor
    distance: Tensor
    score: Tensor
    fixated: Tensor
    target: Tensor
    columns: int

    def __getitem__(self, index: Tensor | slice) -> Self:
        """Some of the looks."""
        chosen: dict[str, Any] = {name: tensor[index] for name, tensor in self._tensors().items()}
        return replace(self, **chosen)

    @classmethod
    def join(cls, looks: Sequence[Self]) -> Self:
        """All looks of several batches."""
        names = looks[0]._tensors()
        joined: dict[str, Any] = {name: torch.cat([getattr(look, name) for look in looks]) for name in names}
        return replace(looks[0], **joined)

    def _tensors(self) -> dict[str, Tensor]:
        """All but the number of columns, which is the same for all looks."""
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name != "columns"}


@dataclass(frozen=True)
class GatheredBelief(Belief, ABC):
    """Base of beliefs that are read from what all looks gathered, of one class or of each of K.

    Attributes:
        closest: `(B, X·Y)`, see `Belief`.
        nearest: `(B, X·Y)` or `(B, K, X·Y)`, evidence of the closest look at each cell.
        best: as `nearest`, strongest evidence of any look.
        total: as `nearest`, evidence of all looks, each counted by its nearness.
        weight: `(B, X·Y)`, sum of the nearness of all looks.
        score: `(B,)` or `(B, K)`, highest score of each class in any detection.
        looks: `(B,)`, number of looks.
        visited: `(B, X·Y)` boolean, cells that were fixated.
    """

    closest: Tensor
    nearest: Tensor
    best: Tensor
    total: Tensor
    weight: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor

    def map(self, function: Callable[[Tensor], Tensor]) -> Self:
        """The belief with all tensors replaced."""
        return replace(self, **{each.name: function(getattr(self, each.name)) for each in fields(self)})


class Gatherer(Observer):
    """Base of the observers that weigh what all looks say by networks.

    Args:
        together: compute all episodes of a batch at once: faster, but how figures are rounded depends on the batch.
    """

    model: Evidence

    def __init__(self, together: bool) -> None:
        super().__init__()
        self.together = together

    def nothing(self, batch: int, grid: Grid, like: Tensor, *classes: int) -> dict[str, Tensor]:
        """What is gathered before the first look: the attributes of `GatheredBelief`.

        Args:
            batch: number of episodes.
            grid: the cells.
            like: whose dtype and device they take.
            classes: how many rows there are in each episode, 1 of which stands for any number; none for one class.
        """
        cells, each = like.new_zeros(batch, len(grid)), like.new_zeros(batch, *classes, len(grid))
        return {
            "closest": cells + torch.inf,
            "nearest": each,
            "best": each - torch.inf,
            "total": each,
            "weight": cells,
            "score": like.new_zeros(batch, *classes),
            "looks": like.new_zeros(batch),
            "visited": cells.bool(),
        }

    def gather(self, known: GatheredBelief, said: EvidenceLook) -> dict[str, Tensor]:
        """What is gathered after one more look in each episode: the attributes of `GatheredBelief`."""

        def by_cell(values: Tensor) -> Tensor:
            """`(B, X·Y)`, the same for all classes."""
            return values if said.evidence.ndim == values.ndim else values[:, None]

        near = self.each(nearness, said.distance)
        return {
            "closest": torch.minimum(said.distance, known.closest),
            "nearest": torch.where(by_cell(said.distance < known.closest), said.evidence, known.nearest),
            "best": torch.maximum(said.evidence, known.best),
            "total": known.total + by_cell(near) * said.evidence,
            "weight": known.weight + near,
            "score": torch.maximum(said.score, known.score),
            "looks": known.looks + 1,
            "visited": known.visited.scatter(-1, said.fixated[:, None], True),
        }

    def read(self, gathered: dict[str, Tensor]) -> list[Tensor]:
        """What networks read of all looks: the attributes of `Gathered` up to the class, of one class or of several."""
        total, weight = gathered["total"], gathered["weight"]
        mean = total / (weight if total.ndim == weight.ndim else weight[:, None])
        return [gathered["nearest"], gathered["best"], mean, *(gathered[name] for name in READ)]

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> Belief:
        r"""What looks gathered counts less, and a closest look counts as one from farther away; see `Observer.fade`.

        With r = -ln k, what is gathered for a cell moves by :math:`e \leftarrow e_0 + k (e - e_0)` towards the evidence
        :math:`e_0` of a look from far away that shows nothing. Looks count by their nearness :math:`e^{-d/R}`
        (`semfov.belief.evidence.nearness`), which fades with them: so does that of the closest look, by
        :math:`d \leftarrow d + r R`, and a fresh look from farther takes its place in time.
        """
        if keep == 1:
            return belief
        known: dict[str, Tensor] = vars(belief)
        unseen = self.model.unseen(belief.closest)
        faded: dict[str, Any] = {name: unseen + keep * (known[name] - unseen) for name in ("nearest", "best")}
        faded |= {name: keep * known[name] for name in ("total", "weight", "score", "looks")}
        return replace(belief, **faded, closest=known["closest"] + farther(keep), visited=visited)  # type: ignore[type-var]

    def each(self, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """`function` of the rows of tensors `(B, ...)`, each alone (`one_by_one`) or all at once."""
        return function(*rows) if self.together else one_by_one(function, *rows)
