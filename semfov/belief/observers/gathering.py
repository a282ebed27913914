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
    """Evidence `(B, X·Y)` of looks about a class, or `(B, T, X·Y)`; distance `(B, X·Y)`, score `(B,)` or `(B, T)`."""

    evidence: Tensor
    distance: Tensor
    score: Tensor
    fixated: Tensor
    target: Tensor
    columns: int


@dataclass(frozen=True)
class GatheredBelief(Belief, ABC):
    """Base of beliefs from all looks; cells `(B, X·Y)` or `(B, K, X·Y)`, score `(B,)` or `(B, K)`, looks `(B,)`."""

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
        """Gathered evidence before the first look, for one class, or with a row for each of several `classes`."""
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

    def gather(self, belief: GatheredBelief, look: EvidenceLook) -> tuple[dict[str, Tensor], list[Tensor]]:
        """Gather one more look: the attributes of `GatheredBelief`, and the inputs of `Gathered` up to the class."""

        def by_cell(values: Tensor) -> Tensor:
            """`(B, X·Y)`, the same for all classes."""
            return values if look.evidence.ndim == values.ndim else values[:, None]

        near = self.each(nearness, look.distance)
        gathered = {
            "closest": torch.minimum(look.distance, belief.closest),
            "nearest": torch.where(by_cell(look.distance < belief.closest), look.evidence, belief.nearest),
            "best": torch.maximum(look.evidence, belief.best),
            "total": belief.total + by_cell(near) * look.evidence,
            "weight": belief.weight + near,
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
        faded: dict[str, Any] = {name: unseen + keep * (fields[name] - unseen) for name in ("nearest", "best")}
        faded |= {name: keep * fields[name] for name in ("total", "weight", "score", "looks")}
        return replace(belief, **faded, closest=fields["closest"] + farther(keep), visited=visited)  # type: ignore[type-var]

    def each(self, function: Callable[..., Tensor], *rows: Tensor) -> Tensor:
        """Apply a function to the rows of tensors `(B, ...)`: one by one (`one_by_one`), or all at once."""
        return function(*rows) if self.together else one_by_one(function, *rows)
