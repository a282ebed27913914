"""Errors of figures over cases that are not independent of each other, such as the searches of a photograph."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from semfov.errors import check
from semfov.metrics.labels import as_labels


@dataclass(frozen=True)
class Bootstrap:
    r"""Figures of a set of cases, and the same figures of samples of it (Efron, 1979).

    A sample has as many groups as the set, drawn with replacement, each with all its cases (Field and Welsh, 2007, the
    cluster bootstrap). The standard error is the standard deviation over the B samples, and the interval lies between
    their quantiles:

    .. math:: \mathrm{SE} = \sqrt{\frac{1}{B - 1} \sum_b (\theta_b - \bar\theta)^2}

    The difference of two figures of the same samples is paired.

    Shapes: samples `(B, ...)`.
    """

    value: Tensor
    samples: Tensor

    @classmethod
    def of(
        cls, measure: Callable[[Tensor], Tensor], groups: Sequence[Hashable], *, samples: int = 1000, seed: int = 0
    ) -> Self:
        """Measure all cases, and samples of them; measure `(M,)`."""
        names = as_labels(groups, "groups")
        check(len(names) > 0, "groups", "the group of at least one case", "none")
        check(samples >= 2, "samples", "2 or more", samples)
        members: dict[Hashable, list[int]] = {}
        for case, group in enumerate(names):
            members.setdefault(group, []).append(case)
        cases = [torch.tensor(group) for group in members.values()]
        generator = torch.Generator().manual_seed(seed)
        drawn = torch.randint(len(cases), (samples, len(cases)), generator=generator).tolist()
        figures = [measure(torch.cat([cases[group] for group in sample])) for sample in drawn]
        return cls(measure(torch.arange(len(names))), torch.stack(figures))

    @property
    def error(self) -> Tensor:
        """Standard error of the figures, `(...)`, without the samples that have none."""
        there = ~self.samples.isnan()
        apart = torch.where(there, self.samples - self.samples.nanmean(0), 0.0)
        return (apart.square().sum(0) / (there.sum(0) - 1)).sqrt()

    def cells(self, row: int, digits: int = 3, *, sign: str = "", unit: float = 1.0) -> list[str]:
        """Write a row of the figures, each with its standard error, such as `0.512 ± 0.013`, for a table.

        Args:
            row: number of the row.
            digits: decimal places.
            sign: `+` writes the sign of positive values, too.
            unit: factor of all figures, 100 for percent.

        Returns:
            The cells.
        """
        pairs = zip(self.value[row].tolist(), self.error[row].tolist(), strict=True)
        return [f"{unit * value:{sign}.{digits}f} ± {unit * error:.{digits}f}" for value, error in pairs]

    def interval(self, level: float = 0.95) -> Tensor:
        """Interval that contains a share of the samples, with as many below as above it; → `(2, ...)`."""
        ends = self.samples.new_tensor([(1 - level) / 2, (1 + level) / 2])
        return self.samples.nanquantile(ends, 0)

    def less(self, other: int) -> Self:
        """Differences to one of the figures, paired over the samples."""
        return type(self)(self.value - self.value[other], self.samples - self.samples[:, other, None])
