"""How often nothing is detected where there is something: the likelihood of an empty look."""

from collections.abc import Iterable

import torch
from torch import Tensor

from semfov.errors import check, check_shape


class MissCounts:
    """Cells in which nothing was detected, by the class that was there and the level of distance; sums that merge.

    Args:
        components: classes K + 1, background first.
        levels: number of levels of distance N.

    Attributes:
        missed: `(K+1, N)` int64, cells of the class seen from this level that no detection covered.
        total: `(K+1, N)` int64, all cells of the class seen from this level.
    """

    def __init__(self, components: int, levels: int) -> None:
        self.missed = torch.zeros(components, levels, dtype=torch.int64)
        self.total = torch.zeros_like(self.missed)

    def update(self, detected: Tensor, objects: Tensor, labels: Tensor, level: Tensor) -> "MissCounts":
        """Count one look and return the counts themselves.

        Args:
            detected: `(X·Y)` boolean, cells that a detection covers.
            objects: `(M, X·Y)` boolean, cells that each object covers.
            labels: `(M,)`, class of each object, 1..K. A cell without objects counts as background, one with several
                counts once for each of their classes.
            level: `(X·Y)`, level of distance from the fixation to each cell.
        """
        cells = len(detected)
        check_shape(objects, "objects", len(labels), cells)
        check_shape(level, "level", cells)
        there = torch.zeros(len(self.total), cells, dtype=torch.bool)
        there[0] = ~objects.any(0)
        for label in labels.unique():
            there[label] = objects[labels == label].any(0)
        seen_from = torch.nn.functional.one_hot(level, self.total.shape[1])
        self.total += there.long() @ seen_from
        self.missed += (there & ~detected).long() @ seen_from
        return self

    @classmethod
    def merge(cls, counts: Iterable["MissCounts"], components: int, levels: int) -> "MissCounts":
        """The sum of several counts."""
        merged = cls(components, levels)
        for each in counts:
            merged.missed += each.missed
            merged.total += each.total
        return merged

    def rates(self, shrinkage: float = 50.0) -> Tensor:
        r"""Probability that nothing is detected in a cell of class k seen from level n, `(K+1, N)`.

        .. math:: m_{kn} = \frac{\mathrm{missed}_{kn} + s \, \bar m_n}{\mathrm{total}_{kn} + s}, \quad
                  \bar m_n = \frac{1 + \sum_{k \ge 1} \mathrm{missed}_{kn}}{2 + \sum_{k \ge 1} \mathrm{total}_{kn}}

        Classes of which little was seen take the rate of all objects at that level; background keeps its own.

        Args:
            shrinkage: s, pseudo-counts.

        >>> counts = MissCounts(2, 1)
        >>> counts.total += torch.tensor([[8], [2]]); counts.missed += torch.tensor([[6], [1]])
        >>> counts.rates()
        tensor([[0.7000],
                [0.5000]])
        """
        check(shrinkage > 0, "shrinkage", "a positive number", shrinkage)
        missed, total = self.missed.double(), self.total.double()
        pooled = (1 + missed[1:].sum(0)) / (2 + total[1:].sum(0))
        objects = (missed[1:] + shrinkage * pooled) / (total[1:] + shrinkage)
        background = (1 + missed[:1]) / (2 + total[:1])
        return torch.cat([background, objects]).to(torch.get_default_dtype())
