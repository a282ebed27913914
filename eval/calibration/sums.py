"""Sums over predictions of parts of the data, which add up and are kept as JSON."""

import math
from collections.abc import Mapping
from typing import Any, Self

import torch

from semfov.metrics.calibration import BinarySums


class AddedSums(BinarySums):
    """Sums over binary predictions (`BinarySums`); those of parts of the data add up."""

    @classmethod
    def nothing(cls) -> Self:
        """Make the sums over no predictions, to which others are added."""
        return cls(torch.zeros(3, len(cls.EDGES) + 1, dtype=torch.float64), 0.0, 0.0)

    def __add__(self, other: Self) -> Self:
        """Compute sums over the predictions of both."""
        return type(self)(self.bins + other.bins, self.surprisal + other.surprisal, self.square + other.square)

    @property
    def probability(self) -> float:
        """Mean predicted probability."""
        return float(self.bins[1].sum()) / (self.count or math.nan)

    @property
    def rate(self) -> float:
        """Fraction of the predictions that came true."""
        return float(self.bins[2].sum()) / (self.count or math.nan)

    def record(self) -> dict[str, Any]:
        """Write the sums as JSON values, without empty bins; `from_record` reads them."""
        filled = self.bins[0].nonzero()[:, 0].tolist()
        bins = {str(number): self.bins[:, number].tolist() for number in filled}
        return {"bins": bins, "surprisal": self.surprisal, "square": self.square}

    @classmethod
    def from_record(cls, record: Mapping[str, Any]) -> Self:
        """Read the sums from JSON values."""
        sums = cls.nothing()
        for number, column in record["bins"].items():
            sums.bins[:, int(number)] = torch.tensor(column, dtype=torch.float64)
        return cls(sums.bins, record["surprisal"], record["square"])
