"""Sufficient statistics of Dirichlets: sums that merge, and do not depend on the order in which they were made."""

import math
from collections.abc import Sequence
from os import PathLike
from typing import Any, Self

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check, check_finite, check_shape
from semfov.io.schema import Field, Number, Schema
from semfov.io.storage import read, write

# Sums count quanta of 2^-32. Integers add exactly, so any order and any split of the samples give the same bits.
FRACTION_BITS = 32
# Scores in half precision sum to 1 within this.
_OFF_SIMPLEX = 1e-2


class DirichletStatistics:
    r"""Count, `Σ ln s`, `Σ s` and `Σ s²` of score vectors, for every cell of a table of Dirichlets.

    Scores are raised to `epsilon` and scaled to sum to 1, in float64. Each term is then rounded to a multiple of
    2^-32 and added as an integer, which makes the sums independent of the order of updates and merges, of batch sizes
    and of the number of workers, to the last bit. A mean is off by at most 2^-33 (1.2e-10) for it; a cell holds
    about 1.5e8 samples at the default `epsilon`, and going beyond raises.

    Args:
        shape: shape of the table, for example `(K+1, N)` for classes and levels.
        components: length of the score vectors.
        epsilon: the least score.

    Attributes:
        count: `(*shape)` int64, number of samples.
        sums: `(3, *shape, components)` int64, `Σ ln s`, `Σ s` and `Σ s²` in units of 2^-32.

    >>> statistics = DirichletStatistics((2,), components=3)
    >>> scores = torch.tensor([[0.2, 0.3, 0.5], [0.4, 0.1, 0.5]])
    >>> statistics.update(scores, torch.tensor([1, 1])).mean[1]
    tensor([0.3000, 0.2000, 0.5000], dtype=torch.float64)
    """

    def __init__(self, shape: Sequence[int], components: int, *, epsilon: float = 1e-6) -> None:
        check(all(n >= 1 for n in shape) and len(shape) >= 1, "shape", "positive sizes", tuple(shape))
        check(components >= 2, "components", "at least 2", components)
        check(0 < epsilon < 1, "epsilon", "a number between 0 and 1", epsilon)
        self.shape = tuple(shape)
        self.components = components
        self.epsilon = epsilon
        self.count = torch.zeros(self.shape, dtype=torch.int64)
        self.sums = torch.zeros(3, *self.shape, components, dtype=torch.int64)

    @torch.no_grad()
    def update(self, scores: Tensor, index: Tensor | Sequence[Tensor]) -> Self:
        """Add score vectors to their cells, and return the statistics themselves.

        Args:
            scores: `(M, components)`, points of the simplex.
            index: the cell of each vector, as for indexing a tensor of `shape`: a tuple of `len(shape)` integer
                tensors `(M,)`, or one tensor `(M,)` of row-major cell numbers.

        Raises:
            InputError: a vector is off the simplex, an index is outside the table, or a sum would overflow.
        """
        check_shape(scores, "scores", None, self.components)
        check_finite(scores, "scores")
        off = (scores.sum(-1) - 1).abs() > _OFF_SIMPLEX
        check(not bool((scores < 0).any()), "scores", "no negative numbers", "some")
        check(not bool(off.any()), "scores", "vectors that sum to 1", f"{int(off.sum())} that do not")
        scores = scores.reshape(-1, self.components)
        cells = self._cells(index, len(scores)).to(self.count.device)
        count = self.count + torch.bincount(cells, minlength=self.count.numel()).view(self.shape)
        self._check_room(count)
        terms = quantise(scores.to(self.count.device), self.epsilon)
        self.count = count
        self.sums.view(3, -1, self.components).index_add_(1, cells, terms)
        return self

    def merge(self, other: "DirichletStatistics") -> Self:
        """Add the sums of other samples, and return the statistics themselves.

        Raises:
            InputError: the other table has another shape, number of components or epsilon.
        """
        mine, theirs = (self.shape, self.components, self.epsilon), (other.shape, other.components, other.epsilon)
        check(mine == theirs, "other", f"statistics of shape, components and epsilon {mine}", theirs)
        count = self.count + other.count.to(self.count.device)
        self._check_room(count)
        self.count = count
        self.sums = self.sums + other.sums.to(self.sums.device)
        return self

    @property
    def mean_log(self) -> Tensor:
        """Mean of `ln s`, `(*shape, components)` in float64; NaN in cells without samples."""
        return self._mean(0)

    @property
    def mean(self) -> Tensor:
        """Mean scores, `(*shape, components)` in float64; NaN in cells without samples."""
        return self._mean(1)

    @property
    def variance(self) -> Tensor:
        """Variance of the scores (divided by n), `(*shape, components)` in float64; NaN in cells without samples."""
        return (self._mean(2) - self._mean(1).square()).clamp(min=0.0)

    def sum(self, dim: int) -> "DirichletStatistics":
        """Statistics pooled over a dimension of the table, which must have more than one."""
        check(len(self.shape) > 1, "dim", "a table of two dimensions or more", self.shape)
        dim = range(len(self.shape))[dim]
        pooled = DirichletStatistics(self.shape[:dim] + self.shape[dim + 1 :], self.components, epsilon=self.epsilon)
        pooled.count, pooled.sums = self.count.sum(dim), self.sums.sum(dim + 1)
        self._check_room(pooled.count)
        return pooled

    def save(self, path: str | PathLike[str], **record: Any) -> None:
        """Write a safetensors file, whole or not at all; the same sums give the same bytes.

        Args:
            path: the file.
            record: JSON values to keep with it.
        """
        own = {"kind": "dirichlet-statistics", "epsilon": self.epsilon, "fraction_bits": FRACTION_BITS}
        write(path, {"count": self.count, "sums": self.sums}, {**record, **own})

    @classmethod
    def load(cls, path: str | PathLike[str]) -> tuple[Self, dict[str, Any]]:
        """Statistics from a file, and the record that was saved with them.

        Raises:
            DataError: the file is missing, damaged or not one of `save`.
        """
        tensors, record = read(path, "dirichlet-statistics")
        count, sums = tensors.get("count"), tensors.get("sums")
        if count is None or sums is None or count.ndim < 1 or sums.shape[:-1] != (3, *count.shape):
            shapes = {name: tuple(t.shape) for name, t in tensors.items()}
            raise DataError(f"{path}: expected tensors count and sums that fit together, got {shapes}")
        whole = Field(tuple(count.shape), torch.int64, low=0)
        try:
            Schema(
                {"count": whole, "sums": Field(tuple(sums.shape), torch.int64)},
                {"epsilon": Number(above=0, high=1)},
            ).check(tensors, record)
        except InputError as error:
            raise DataError(f"{path}: not a complete file of statistics ({error})") from None
        if record.get("fraction_bits") != FRACTION_BITS:
            raise DataError(f"{path}: expected sums in units of 2^-{FRACTION_BITS}, got {record.get('fraction_bits')}")
        statistics = cls(tuple(count.shape), sums.shape[-1], epsilon=record["epsilon"])
        statistics.count, statistics.sums = count, sums
        return statistics, record

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, DirichletStatistics)
            and (self.shape, self.components, self.epsilon) == (other.shape, other.components, other.epsilon)
            and torch.equal(self.count, other.count)
            and torch.equal(self.sums, other.sums)
        )

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        samples = int(self.count.sum())
        return f"DirichletStatistics(shape={self.shape}, components={self.components}, samples={samples})"

    def _mean(self, which: int) -> Tensor:
        return self.sums[which].to(torch.float64) / 2.0**FRACTION_BITS / self.count[..., None]

    def _cells(self, index: Tensor | Sequence[Tensor], samples: int) -> Tensor:
        """Row-major numbers of the cells, checked."""
        parts = (index,) if isinstance(index, Tensor) else tuple(index)
        sizes = (self.count.numel(),) if isinstance(index, Tensor) else self.shape
        check(len(parts) == len(sizes), "index", f"{len(sizes)} tensors, one for each dimension", len(parts))
        cells = torch.zeros(samples, dtype=torch.int64, device=parts[0].device)
        for part, size in zip(parts, sizes, strict=True):
            whole = not part.is_floating_point() and part.dtype != torch.bool
            check(whole and part.shape == (samples,), "index", f"({samples},) integers", (part.dtype, part.shape))
            inside = bool(((part >= 0) & (part < size)).all())
            check(inside, "index", f"numbers from 0 to {size - 1}", "one outside")
            cells = cells * size + part
        return cells

    def _check_room(self, count: Tensor) -> None:
        """Raise `InputError` where the sums of so many samples might not fit into 63 bits."""
        longest = math.log((2 + self.components * self.epsilon) / self.epsilon)
        room = int(2.0 ** (63 - FRACTION_BITS) / longest)
        if int(count.max()) > room:
            raise InputError(f"statistics: a cell has room for {room} samples, got {int(count.max())}; fit on fewer")


def quantise(scores: Tensor, epsilon: float) -> Tensor:
    """`ln s`, `s` and `s²` of floored scores `(M, K)`, rounded to integers in units of 2^-32, `(3, M, K)`.

    The sum that scales the scores is itself taken over integers: a sum of floats may differ in its last bit with the
    layout of the batch.
    """
    raised = scores.to(torch.float64).clamp(min=epsilon).contiguous()
    total = (raised * 2.0**48).round().to(torch.int64).sum(-1, keepdim=True)
    shares = raised / (total.to(torch.float64) / 2.0**48)
    terms = torch.stack([shares.log(), shares, shares.square()])
    return (terms * 2.0**FRACTION_BITS).round().to(torch.int64)
