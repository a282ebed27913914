"""Miss rates: how often the detector finds nothing where there is an object."""

from collections.abc import Iterable

import torch
from torch import Tensor

from semfov.errors import check, check_shape


class MissCounts:
    """Counts of grid cells without a detection, by the true class and the level of distance; counts can be added.

    Args:
        components: K + 1, the number of classes with background, which comes first.
        levels: N, the number of levels of distance.

    Attributes:
        missed: `(K+1, N)` int64, cells of each class at each level that no detection covered.
        total: `(K+1, N)` int64, all cells of each class at each level.

    >>> counts = MissCounts(components=2, levels=1)  # background and one class
    >>> cup, detected = torch.tensor([[True, True, False]]), torch.tensor([True, False, False])
    >>> counts = counts.update(detected, cup, torch.tensor([1]), torch.tensor([0, 0, 0]))
    >>> counts.missed.tolist(), counts.total.tolist()  # of two cells with the cup, one was missed
    ([[1], [1]], [[1], [2]])
    """

    def __init__(self, components: int, levels: int) -> None:
        self.missed = torch.zeros(components, levels, dtype=torch.int64)
        self.total = torch.zeros_like(self.missed)

    def update(self, detected: Tensor, objects: Tensor, labels: Tensor, level: Tensor) -> "MissCounts":
        """Add the cells of one look.

        A cell without objects counts as background. A cell with several objects counts once for each of their classes.

        Args:
            detected: `(X·Y,)` boolean, cells that a detection covers.
            objects: `(M, X·Y)` boolean, cells that each object covers.
            labels: `(M,)`, class of each object, 1..K.
            level: `(X·Y,)`, level of distance from the fixation to each cell.

        Returns:
            These counts.

        Raises:
            InputError: a shape does not fit the others.
        """
        cells = len(detected)
        check_shape(objects, "objects", len(labels), cells)
        check_shape(level, "level", cells)
        present = torch.zeros(len(self.total), cells, dtype=torch.bool)  # classes in each cell
        present[0] = ~objects.any(0)
        for label in labels.unique():
            present[label] = objects[labels == label].any(0)
        one_hot = torch.nn.functional.one_hot(level, self.total.shape[1])  # (X·Y, N)
        self.total += present.long() @ one_hot
        self.missed += (present & ~detected).long() @ one_hot
        return self

    @classmethod
    def merge(cls, counts: Iterable["MissCounts"], components: int, levels: int) -> "MissCounts":
        """Add several counts.

        Args:
            counts: the counts, all of the same size.
            components: K + 1, number of classes with background.
            levels: N, number of levels of distance.

        Returns:
            New counts: the sum.
        """
        merged = cls(components, levels)
        for part in counts:
            merged.missed += part.missed
            merged.total += part.total
        return merged

    def rates(self, shrinkage: float = 50.0) -> Tensor:
        r"""Probability that nothing is detected in a cell of class k at level n.

        .. math:: m_{kn} = \frac{\mathrm{missed}_{kn} + s \, \bar m_n}{\mathrm{total}_{kn} + s}, \quad
                  \bar m_n = \frac{1 + \sum_{k \ge 1} \mathrm{missed}_{kn}}{2 + \sum_{k \ge 1} \mathrm{total}_{kn}}

        Rare classes are drawn towards the rate of all objects at that level. Background is not: its rate has one
        pseudo-count for a miss and one for a hit.

        Args:
            shrinkage: s, pseudo-counts, positive.

        Returns:
            `(K+1, N)`, m, background first.

        Raises:
            InputError: `shrinkage` is not positive.

        >>> counts = MissCounts(2, 1)
        >>> counts.total += torch.tensor([[8], [2]]); counts.missed += torch.tensor([[6], [1]])
        >>> counts.rates()
        tensor([[0.7000],
                [0.5000]])
        """
        check(shrinkage > 0, "shrinkage", "a positive number", shrinkage)
        missed = self.missed.double()
        total = self.total.double()
        missed_objects = missed[1:]
        all_objects = total[1:]
        pooled = (1 + missed_objects.sum(0)) / (2 + all_objects.sum(0))  # (N,)
        objects = (missed_objects + shrinkage * pooled) / (all_objects + shrinkage)
        background = (1 + missed[:1]) / (2 + total[:1])
        return torch.cat([background, objects]).to(torch.get_default_dtype())
