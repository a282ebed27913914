"""Scores of a searcher against people, by picture."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from eval.human.search.trials import in_cells, shift_found
from semfov.belief.grid import Grid
from semfov.data.fixations import Fixations, by_picture
from semfov.human.scanpath.sequence import fitted_clusters
from semfov.metrics.episodes import cumulative_performance, standard_error
from semfov.metrics.scanpath import (
    edit_distance,
    mean_performance,
    multimatch,
    performance_area,
    probability_mismatch,
    scanpath_ratio,
    sequence_score,
    tfp_auc,
)

_Array = NDArray[np.float64]

DIMENSIONS = ("shape", "direction", "length", "position")
"""The dimensions of MultiMatch that need no fixation durations."""


@dataclass(frozen=True)
class Beside:
    """Scores of a searcher against people.

    Attributes:
        curve: `(N,)`, share of targets found by the 1st, 2nd, … fixation: the mean over people of each person's mean,
            or the mean over a model's searches.
        area: area under that curve (`performance_area`), and its standard error over pictures.
        tfp_auc: `semfov.metrics.scanpath.tfp_auc`, and its standard error by bootstrap over pictures.
        mismatch: probability mismatch with people's curve over the first seven fixations.
        ratio: mean scanpath ratio of the successful searches, and its standard error over pictures.
        alike: by picture `(6,)`: four dimensions of MultiMatch, sequence score, and edit distance to people.
    """

    curve: _Array
    area: tuple[float, float]
    tfp_auc: tuple[float, float]
    mismatch: float
    ratio: tuple[float, float]
    alike: Mapping[str, _Array]

    def mean(self, figure: int) -> tuple[float, float]:
        """Mean over pictures of one measure of `alike`, and its standard error."""
        values = np.array([each[figure] for each in self.alike.values()])
        return _mean_and_error(values[np.isfinite(values)])

    @property
    def multimatch(self) -> tuple[float, float]:
        """Mean of the four dimensions of MultiMatch, and its standard error over pictures."""
        return _mean_and_error(np.array([each[:4].mean() for each in self.alike.values() if np.isfinite(each[0])]))


class People:
    """Searches of people, prepared once for the comparison with several searchers.

    Args:
        searches: the searches of all people, in pixels of the screen.
        grid: grid on whose cells scanpaths are compared.
        longest: largest number of fixations in a search, including the first.
        bandwidth: bandwidth, in pixels, of the clusters of fixations that make up the letters of a sequence.
        bootstrap: number of bootstrap samples of the pictures.
    """

    def __init__(
        self, searches: Sequence[Fixations], grid: Grid, *, longest: int, bandwidth: float, bootstrap: int
    ) -> None:
        self.searches, self.grid, self.longest = list(searches), grid, longest
        self.bandwidth, self.bootstrap = bandwidth, bootstrap
        self.pictures = by_picture(self.searches)
        self.cells = {name: [in_cells(each, grid) for each in people] for name, people in self.pictures.items()}
        self.points = {name: np.concatenate([each.points for each in people]) for name, people in self.pictures.items()}
        self.clusters: dict[str, Any] = {}
        self.words = {name: self._words(name, people) for name, people in self.pictures.items()}
        finds = [shift_found(each, longest) for each in self.searches]
        self.curve = mean_performance(finds, [each.target for each in self.searches], 6)

    def score(self, searches: Sequence[Fixations]) -> Beside:
        """Score a searcher; each person is compared with all other people."""
        finds = np.array([shift_found(each, self.longest) for each in searches])
        shifts = self.longest - 1
        curve = mean_performance(finds.tolist(), [each.subject for each in searches], shifts)
        areas = defaultdict(list)
        for at, each in zip(finds, searches, strict=True):
            areas[each.picture].append(performance_area(cumulative_performance(np.array([at]), shifts)))
        by_category = mean_performance(finds.tolist(), [each.target for each in searches], 6)
        ratios = defaultdict(list)
        for each in searches:
            ratios[each.picture].append(scanpath_ratio(each.points + 0.5, each.box or (0, 0, 0, 0)))
        ratio = np.array([np.nanmean(v) for v in ratios.values() if np.isfinite(v).any()])
        return Beside(
            curve,
            (performance_area(curve), float(standard_error(np.array([np.mean(v) for v in areas.values()])))),
            (tfp_auc(finds.tolist(), [each.target for each in searches]), self._error(finds, searches)),
            probability_mismatch(by_category, self.curve),
            _mean_and_error(ratio),
            self._alike(searches),
        )

    def _alike(self, searches: Sequence[Fixations]) -> dict[str, _Array]:
        themselves = {id(each) for each in self.searches}
        alike = {}
        for name, ours in by_picture(searches).items():
            if name not in self.pictures:
                continue
            words = self._words(name, ours)
            rows: list[Any] = []
            for mine, word in zip(ours, words, strict=True):
                path = in_cells(mine, self.grid)
                for other, cells, letters in zip(self.pictures[name], self.cells[name], self.words[name], strict=True):
                    # Each pair of people is counted only once.
                    if id(mine) in themselves and other.subject <= mine.subject:
                        continue
                    both = shift_found(mine, 10**6) >= 0 and shift_found(other, 10**6) >= 0
                    figures = multimatch(path, cells, (self.grid.columns, self.grid.rows))[:4] if both else [np.nan] * 4
                    rows.append([*figures, sequence_score(word, letters), edit_distance(word, letters)])
            if rows:
                table = np.array(rows, dtype=np.float64)
                with_all = table[np.isfinite(table[:, 0])]
                first = with_all[:, :4].mean(0) if len(with_all) else np.full(4, np.nan)
                alike[name] = np.concatenate([first, table[:, 4:].mean(0)])
        return alike

    def _words(self, name: str, searches: Sequence[Fixations]) -> list[list[int]]:
        if name not in self.clusters:
            self.clusters[name] = fitted_clusters(self.points[name], self.bandwidth)
        labels = self.clusters[name].predict(np.concatenate([each.points for each in searches]))
        ends = np.cumsum([len(each) for each in searches]).tolist()
        return [labels[start:end].tolist() for start, end in zip([0, *ends], ends, strict=False)]

    def _error(self, finds: NDArray[np.int64], searches: Sequence[Fixations]) -> float:
        """Compute standard error of TFP-AUC by bootstrap: pictures are resampled with replacement, target by target."""
        pictures = defaultdict(list)
        for at, each in zip(finds.tolist(), searches, strict=True):
            pictures[each.target, each.picture].append(max(0, 7 - at) if at >= 0 else 0)
        # A search that succeeds after n gaze shifts counts in 7 - n of the seven values that are summed.
        categories = defaultdict(list)
        for (target, _), values in pictures.items():
            categories[target].append((float(np.sum(values)), len(values)))
        generator = np.random.default_rng(0)
        sums = np.zeros(self.bootstrap)
        for members in categories.values():
            table = np.array(members)
            drawn = table[generator.integers(0, len(table), (self.bootstrap, len(table)))].sum(1)
            sums += drawn[:, 0] / drawn[:, 1]
        return float((sums / len(categories)).std(ddof=1))


def _mean_and_error(values: _Array) -> tuple[float, float]:
    """Mean and standard error; NaN if there are too few values."""
    return (float(values.mean()), float(standard_error(values))) if len(values) else (float("nan"), float("nan"))
