"""Sufficient statistics of Dirichlets: sums that can be merged, with a result that does not depend on the order."""

import math
from collections.abc import Sequence
from os import PathLike
from typing import Self

import torch
from torch import Tensor

from semfov.errors import DataError, InputError, check, check_finite, check_shape
from semfov.io.files import JsonObject
from semfov.io.schema import Field, Number, Schema
from semfov.io.storage import read, write_file

# Sums are integers in units of 2^-32. Integers add exactly, so any order and any split of the samples give the same
# bits.
_FRACTION_BITS = 32
# Largest deviation of a sum of half-precision scores from 1.
_OFF_SIMPLEX = 1e-2


class DirichletStatistics:
    r"""Count, `Σ ln s`, `Σ s` and `Σ s²` of score vectors, for every cell of a table of Dirichlets.

    Scores are raised to `epsilon` and scaled to sum to 1, in float64. Each term is then rounded to a multiple of
    2^-32 and added as an integer. The sums are therefore the same to the last bit for any order of updates and merges,
    any batch size and any number of workers. The rounding changes a mean by at most 2^-33 (1.2e-10). At the default
    `epsilon` a cell can hold about 1.5e8 samples; more raise an error.

    Args:
        shape: shape of the table, for example `(K+1, N)` for classes and levels.
        components: length of the score vectors, 2 or more.
        epsilon: lower bound of the scores, between 0 and 1.

    Attributes:
        count: `(*shape)` int64, number of samples.
        sums: `(3, *shape, components)` int64, `Σ ln s`, `Σ s` and `Σ s²` in units of 2^-32.

    Raises:
        InputError: a size or `epsilon` is out of range.

    >>> statistics = DirichletStatistics((2,), components=3)
    >>> scores = torch.tensor([[0.2, 0.3, 0.5], [0.4, 0.1, 0.5]])
    >>> statistics.update(scores, torch.tensor([1, 1])).mean[1]
    tensor([0.3000, 0.2000, 0.5000], dtype=torch.float64)
    """

    def __init__(self, shape: Sequence[int], components: int, *, epsilon: float = 1e-6) -> None:
        check(min(shape, default=0) >= 1, "shape", "positive sizes", tuple(shape))
        check(components >= 2, "components", "at least 2", components)
        check(0 < epsilon < 1, "epsilon", "a number between 0 and 1", epsilon)
        self.shape = tuple(shape)
        self.components = components
        self.epsilon = epsilon
        self.count = torch.zeros(self.shape, dtype=torch.int64)
        self.sums = torch.zeros(3, *self.shape, components, dtype=torch.int64)

    @torch.no_grad()
    def update(self, scores: Tensor, index: Tensor | Sequence[Tensor]) -> Self:
        """Add score vectors to their cells.

        Args:
            scores: `(M, components)`, points of the simplex.
            index: the cell of each vector: a tuple of `len(shape)` integer tensors `(M,)`, one for each dimension of
                the table, or one tensor `(M,)` of row-major cell numbers.

        Returns:
            These statistics.

        Raises:
            InputError: a vector is off the simplex, an index is outside the table, or a sum would overflow.
        """
        self._check_simplex(scores)
        scores = scores.reshape(-1, self.components)
        device = self.count.device
        cells = self._cells(index, len(scores)).to(device)
        added = torch.bincount(cells, minlength=self.count.numel()).view(self.shape)
        count = self.count + added
        self._check_room(count)

        raised = scores.to(device, torch.float64).clamp(min=self.epsilon).contiguous()
        # The sum is computed over integers, too: the last bit of a sum of floats can depend on the layout of the batch.
        total = (raised * 2.0**48).round().to(torch.int64).sum(-1, keepdim=True)
        shares = raised / (total.to(torch.float64) / 2.0**48)
        terms = torch.stack([shares.log(), shares, shares.square()])
        whole_terms = (terms * 2.0**_FRACTION_BITS).round().to(torch.int64)
        self.count = count
        sums_by_cell = self.sums.view(3, -1, self.components)
        sums_by_cell.index_add_(1, cells, whole_terms)
        return self

    def _check_simplex(self, scores: Tensor) -> None:
        """Raise `InputError` unless scores are points of the simplex, `(M, components)`."""
        check_shape(scores, "scores", None, self.components)
        check_finite(scores, "scores")
        check(not bool((scores < 0).any()), "scores", "no negative numbers", "some")
        is_off = (scores.sum(-1) - 1).abs() > _OFF_SIMPLEX
        check(not bool(is_off.any()), "scores", "vectors that sum to 1", f"{int(is_off.sum())} that do not")

    def _cells(self, index: Tensor | Sequence[Tensor], samples: int) -> Tensor:
        """Check the cells of samples (`update`), and number them row by row, `(samples,)`."""
        if isinstance(index, Tensor):
            indices: tuple[Tensor, ...] = (index,)
            sizes: tuple[int, ...] = (self.count.numel(),)
        else:
            indices = tuple(index)
            sizes = self.shape
        check(len(indices) == len(sizes), "index", f"{len(sizes)} tensors, one for each dimension", len(indices))
        cells = torch.zeros(samples, dtype=torch.int64, device=indices[0].device)
        for row, size in zip(indices, sizes, strict=True):
            is_whole = not row.is_floating_point() and row.dtype != torch.bool
            has_shape = row.shape == (samples,)
            check(is_whole and has_shape, "index", f"({samples},) integers", (row.dtype, row.shape))
            are_inside = bool(((row >= 0) & (row < size)).all())
            check(are_inside, "index", f"numbers from 0 to {size - 1}", "one outside")
            cells = cells * size + row
        return cells

    def merge(self, other: "DirichletStatistics") -> Self:
        """Add the sums of other samples.

        Args:
            other: statistics of the same shape, number of components and epsilon; they are not changed.

        Returns:
            These statistics.

        Raises:
            InputError: the other table has another shape, number of components or epsilon, or a sum would overflow.
        """
        required = (self.shape, self.components, self.epsilon)
        got = (other.shape, other.components, other.epsilon)
        check(got == required, "other", f"statistics of shape, components and epsilon {required}", got)
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
        """Pool the statistics over a dimension of the table.

        Args:
            dim: the dimension; negative numbers count from the end.

        Returns:
            New statistics, with one dimension less.

        Raises:
            InputError: the table has one dimension only, or a sum would overflow.
        """
        check(len(self.shape) > 1, "dim", "a table of two dimensions or more", self.shape)
        dim = range(len(self.shape))[dim]
        shape = self.shape[:dim] + self.shape[dim + 1 :]
        pooled = DirichletStatistics(shape, self.components, epsilon=self.epsilon)
        pooled.count = self.count.sum(dim)
        pooled.sums = self.sums.sum(dim + 1)  # before the shape of the table stand the three sums
        self._check_room(pooled.count)
        return pooled

    def save(self, path: str | PathLike[str], **record: object) -> None:
        """Write the statistics to a safetensors file, atomically; the same sums give the same bytes.

        Args:
            path: the file.
            record: JSON values to save with the statistics.
        """
        settings = {"kind": "dirichlet-statistics", "epsilon": self.epsilon, "fraction_bits": _FRACTION_BITS}
        write_file(path, {"count": self.count, "sums": self.sums}, {**record, **settings})

    @classmethod
    def load(cls, path: str | PathLike[str]) -> tuple[Self, JsonObject]:
        """Load statistics that `save` wrote.

        Args:
            path: the file.

        Returns:
            The statistics, and the record that was saved with them.

        Raises:
            DataError: the file is missing or damaged, or was not written by `save`.
        """
        tensors, record = read(path, "dirichlet-statistics")
        count = tensors.get("count")
        sums = tensors.get("sums")
        if count is None or sums is None or count.ndim < 1 or sums.shape[:-1] != (3, *count.shape):
            shapes = {name: tuple(t.shape) for name, t in tensors.items()}
            raise DataError(f"{path}: expected tensors `count` and `sums` of matching shapes, got {shapes}")
        fields = {
            "count": Field(tuple(count.shape), torch.int64, low=0),
            "sums": Field(tuple(sums.shape), torch.int64),
        }
        try:
            Schema(fields, {"epsilon": Number(above=0, high=1)}).check(tensors, record)
        except InputError as error:
            raise DataError(f"{path}: expected a complete file of Dirichlet statistics, got: {error}") from None
        if record.get("fraction_bits") != _FRACTION_BITS:
            raise DataError(f"{path}: expected sums in units of 2^-{_FRACTION_BITS}, got {record.get('fraction_bits')}")
        statistics = cls(tuple(count.shape), sums.shape[-1], epsilon=record["epsilon"])
        statistics.count = count
        statistics.sums = sums
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
        """Divide one of the three `sums` by the count."""
        total = self.sums[which].to(torch.float64) / 2.0**_FRACTION_BITS
        return total / self.count[..., None]

    def _check_room(self, count: Tensor) -> None:
        """Raise `InputError` if the sums of so many samples could exceed 63 bits."""
        longest = math.log((2 + self.components * self.epsilon) / self.epsilon)
        room = int(2.0 ** (63 - _FRACTION_BITS) / longest)
        if int(count.max()) > room:
            raise InputError(
                f"statistics: expected at most {room} samples in a cell, got {int(count.max())}; fit on fewer samples"
            )
