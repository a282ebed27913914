"""Base classes of the observers with learned evidence: their looks, their beliefs, and how evidence is gathered."""

from abc import ABC
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from semfov.belief.belief import Belief, one_by_one
from semfov.belief.evidence import Evidence, farther, nearness
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer

_Model = TypeVar("_Model", bound=Evidence)


@dataclass(frozen=True)
class EvidenceLook(Look):
    """Evidence of B looks about a class, or about T classes.

    Attributes:
        evidence: log odds of each cell, `(B, X·Y)` or `(B, T, X·Y)`.
        distance: from the fixation to each cell, `(B, X·Y)`, in longer sides of the image.
        score: highest score of the class in the look, `(B,)` or `(B, T)`.
        fixated: the fixated cell, `(B,)`.
        target: the class, `(B,)` or `(B, T)`.
        columns: X, cells in a row.
    """

    evidence: Tensor
    distance: Tensor
    score: Tensor
    fixated: Tensor
    target: Tensor
    columns: int


@dataclass(frozen=True)
class GatheredBelief(Belief, ABC):
    """Base of beliefs from all looks, about a class, or with a row for each of K classes.

    Attributes:
        closest: distance from each cell to its closest fixation, `(B, X·Y)`; infinite before the first look.
        nearest: evidence of each cell's closest look, `(B, X·Y)` or `(B, K, X·Y)`.
        best: strongest evidence of any look, of the same shape.
        total: sum of the evidence of all looks, weighted by `nearness`, of the same shape.
        weight: sum of these weights, `(B, X·Y)`.
        score: highest score of the class in any look, `(B,)` or `(B, K)`.
        looks: number of looks, `(B,)`.
        visited: fixated cells, `(B, X·Y)` boolean.
    """

    closest: Tensor
    nearest: Tensor
    best: Tensor
    total: Tensor
    weight: Tensor
    score: Tensor
    looks: Tensor
    visited: Tensor


class Gatherer(Observer, Generic[_Model]):
    """Base of the observers with learned evidence."""

    def __init__(self, model: _Model, *, together: bool = False) -> None:
        super().__init__()
        self.model = model
        self.together = together

    def nothing(self, batch: int, grid: Grid, like: Tensor, *classes: int) -> dict[str, Tensor]:
        """Make the attributes of `GatheredBelief` before the first look.

        Args:
            batch: B, number of episodes.
            grid: the cells.
            like: a tensor, whose dtype and device they take.
            classes: nothing for one class; K for a row for each of K classes.

        Returns:
            The attributes by name.
        """
        cells = like.new_zeros(batch, len(grid))
        by_class = like.new_zeros(batch, *classes, len(grid))
        return {
            "closest": cells + torch.inf,
            "nearest": by_class,
            "best": by_class - torch.inf,
            "total": by_class,
            "weight": cells,
            "score": like.new_zeros(batch, *classes),
            "looks": like.new_zeros(batch),
            "visited": cells.bool(),
        }

    def gather(self, belief: GatheredBelief, look: EvidenceLook) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Gather one more look.

        Args:
            belief: from the looks so far.
            look: the next look in each episode.

        Returns:
            The attributes of `GatheredBelief` by name, and the fields of `Gathered` in order, but for the last one,
            the class.
        """

        def by_cell(values: Tensor) -> Tensor:
            """Broadcast `(B, X·Y)` over the classes of the look."""
            return values if look.evidence.ndim == values.ndim else values[:, None]

        weight = self.each(nearness, look.distance)
        gathered = {
            "closest": torch.minimum(look.distance, belief.closest),
            "nearest": torch.where(by_cell(look.distance < belief.closest), look.evidence, belief.nearest),
            "best": torch.maximum(look.evidence, belief.best),
            "total": belief.total + by_cell(weight) * look.evidence,
            "weight": belief.weight + weight,
            "score": torch.maximum(look.score, belief.score),
            "looks": belief.looks + 1,
            "visited": belief.visited.scatter(-1, look.fixated[:, None], True),
        }
        mean = gathered["total"] / by_cell(gathered["weight"])
        unchanged = (gathered[name] for name in ("closest", "score", "looks", "visited"))
        return gathered, [gathered["nearest"], gathered["best"], mean, *unchanged]

    def fade(self, belief: Belief, look: Look, keep: float, visited: Tensor) -> Belief:
        """Discount the evidence towards that of nothing seen, and move the closest looks away; see `Observer.fade`."""
        if keep == 1:
            return belief
        fields: dict[str, Tensor] = vars(belief)
        unseen = self.model.unseen(belief.closest)
        # Without a look, evidence is that of a look that shows nothing; sums and counts are 0.
        faded: dict[str, Any] = {name: unseen + keep * (fields[name] - unseen) for name in ("nearest", "best")}
        faded |= {name: keep * fields[name] for name in ("total", "weight", "score", "looks")}
        return replace(belief, **faded, closest=fields["closest"] + farther(keep), visited=visited)  # type: ignore[type-var]

    def each(self, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """Apply a function to tensors `(B, ...)`, row by row (`one_by_one`), or with `together` all at once."""
        return function(*rows) if self.together else one_by_one(function, *rows)
