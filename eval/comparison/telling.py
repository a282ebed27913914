"""How well scores tell whether a target is present, and places where it is, with errors over scenes."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence

import torch
from torch import Tensor

from eval.bootstrap import Bootstrap
from eval.chance import errors_by_chance
from eval.presence import hits_at
from semfov.data.scene import Scenes
from semfov.metrics.calibration import calibration_error
from semfov.metrics.episodes import area_under_roc
from semfov.runs.tables import plus_minus, table

_SHARES = (0.01, 0.02, 0.05)
"""False alarm rates at which the tables give the hit rate."""

TELLING = ["area under ROC", *(f"hits at {100 * share:.0f} %" for share in _SHARES)]
"""Column headings of `Telling.rows`."""

_PLACE = "place right"

CALIBRATED = ["ECE", "ECE if calibrated"]
"""Column headings of `calibrated`."""

ERRORS_TEXT = (
    "± is the standard error, and two numbers in brackets are a 95 % interval, both by bootstrap over scenes, since "
    "the searches of a scene are not independent. `ECE if calibrated`: the ECE that perfectly calibrated probabilities "
    "would have in as many searches, its mean and the limit below which 95 % of them are."
)
"""Caption of the errors."""

FREQUENCY = "class frequency"
"""Name of the score that knows only how many of the other scenes hold the class."""


def class_frequencies(scenes: Scenes) -> list[Tensor]:
    """For each scene, the share of the other scenes that hold each class, `(K+1,)`; 0 for background."""
    held = torch.zeros(len(scenes), len(scenes.classes) + 1, dtype=torch.float64)
    for index in range(len(scenes)):
        held[index, scenes.annotation(index).labels] = 1
    return list((held.sum(0) - held) / max(len(scenes) - 1, 1))


class Telling:
    """Scores of the same searches by several ways to search, with the places that these report.

    Shapes: by_name `(M,)`, there `(M,)`, right `(M,)`.
    """

    def __init__(
        self,
        by_name: Mapping[str, Tensor],
        there: Tensor,
        scenes: Sequence[Hashable],
        right: Mapping[str, Tensor] | None = None,
    ) -> None:
        self.names = list(by_name)
        self.places = right or {}
        scores = [score.double() for score in by_name.values()]
        nowhere = torch.full((len(there),), torch.nan, dtype=torch.float64)
        places = torch.stack([self.places.get(name, nowhere).double() for name in by_name])

        def measure(index: Tensor) -> Tensor:
            figures = torch.tensor([_tells(score[index], there[index]) for score in scores], dtype=torch.float64)
            return torch.cat([figures, places[:, index].nanmean(1, keepdim=True)], 1)

        self.figures = Bootstrap.of(measure, scenes)

    def rows(self) -> list[list[str]]:
        """Cells under the headings `TELLING` for each way."""
        interval = self.figures.interval()
        return [_cells(self.figures, interval, way, TELLING) for way in range(len(self.names))]

    def place(self, name: str) -> str:
        """Share of right places of a way, in percent, with its interval."""
        way = self.names.index(name)
        return _spanned(self.figures.value[way, -1], *self.figures.interval()[:, way, -1], digits=1)

    def differences(self, name: str) -> list[str]:
        """Table of the differences of all ways to one of them, paired over the searches."""
        differences = self.figures.less(self.names.index(name))
        interval = differences.interval()
        heads = [*TELLING, _PLACE] if self.places else TELLING
        rows = [[f"difference to {name}", *heads]]
        for way, other in enumerate(self.names):
            if other != name:
                rows.append([other, *_cells(differences, interval, way, heads, sign="+")])
        return table(rows)


def _cells(figures: Bootstrap, interval: Tensor, way: int, heads: Sequence[str], *, sign: str = "") -> list[str]:
    """Write the figures of a way under headings: the area with its standard error, and shares with their intervals.

    Args:
        figures: the figures of all ways, `(ways, columns)`.
        interval: their intervals, `(2, ways, columns)`.
        way: number of the way.
        heads: the headings, those of `TELLING` first.
        sign: `+` writes the sign of positive figures, too.
    """
    value = figures.value[way]
    low, high = interval[:, way]
    area = "-"
    if value[0].isfinite():
        area = plus_minus(float(value[0]), float(figures.error[way, 0]), 3, sign=sign)
    cells = [area]
    for column in range(1, len(heads)):
        digits = 1 if heads[column] == _PLACE else 0
        cells.append(_spanned(value[column], low[column], high[column], digits=digits, sign=sign))
    return cells


def _tells(score: Tensor, there: Tensor) -> list[float]:
    """Area under the ROC curve, and hit rates at the false alarm rates `_SHARES`; NaN if all or none are present."""
    if not there.any() or there.all():
        return [torch.nan] * (1 + len(_SHARES))
    return [area_under_roc(score, there), *(hits_at(score, there, share) for share in _SHARES)]


def calibrated(probability: Tensor, there: Tensor) -> list[str]:
    """Cells under the headings `CALIBRATED` for probabilities `(M,)` and outcomes `(M,)`."""
    chance = errors_by_chance(probability)
    return [
        f"{calibration_error(probability, there):.3f}",
        f"{chance.mean():.3f}, to {chance.quantile(0.95):.3f}",
    ]


def _spanned(value: Tensor, low: Tensor, high: Tensor, *, digits: int = 0, sign: str = "") -> str:
    """Write a share in percent with its interval, such as `66 (57 to 73)`; a dash where there is none."""
    if not value.isfinite():
        return "-"
    share, least, most = (f"{100 * float(figure):{sign}.{digits}f}" for figure in (value, low, high))
    return f"{share} ({least} to {most})"
