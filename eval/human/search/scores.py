"""Scores of a searcher against people, by picture."""

from __future__ import annotations

import math
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

_SHIFTS = 6
"""Gaze shifts over which performance by category is compared: the first seven fixations."""


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

    def mean(self, measure: int) -> tuple[float, float]:
        """Average one measure of `alike` over pictures, with its standard error."""
        values = np.array([measures[measure] for measures in self.alike.values()])
        return _mean_and_error(values[np.isfinite(values)])

    @property
    def multimatch(self) -> tuple[float, float]:
        """Mean of the four dimensions of MultiMatch, and its standard error over pictures."""
        of_pictures = [measures[: len(DIMENSIONS)] for measures in self.alike.values()]
        return _mean_and_error(np.array([scores.mean() for scores in of_pictures if np.isfinite(scores[0])]))

    @property
    def sequence_score(self) -> tuple[float, float]:
        """Mean sequence score, and its standard error over pictures."""
        return self.mean(len(DIMENSIONS))

    @property
    def edit_distance(self) -> tuple[float, float]:
        """Mean edit distance, and its standard error over pictures."""
        return self.mean(len(DIMENSIONS) + 1)


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
        self,
        searches: Sequence[Fixations],
        grid: Grid,
        *,
        longest: int,
        bandwidth: float,
        bootstrap: int,
    ) -> None:
        self.searches = list(searches)
        self.grid = grid
        self.longest = longest
        self.bootstrap = bootstrap
        self.pictures = by_picture(self.searches)
        self._ids = {id(search) for search in self.searches}  # by which those of people are told from a model's
        self.clusters: dict[str, Any] = {}  # in each picture, of all people's fixations
        self.cells: dict[str, list[_Array]] = {}
        self.words: dict[str, list[list[int]]] = {}
        for name, people in self.pictures.items():
            self.clusters[name] = fitted_clusters(np.concatenate([search.points for search in people]), bandwidth)
            self.cells[name] = [in_cells(search, grid) for search in people]
            self.words[name] = self._words(name, people)
        finds = [shift_found(search, longest) for search in self.searches]
        self.curve = mean_performance(finds, [search.target for search in self.searches], _SHIFTS)

    def score(self, searches: Sequence[Fixations]) -> Beside:
        """Score a searcher; each person is compared with all other people."""
        finds = [shift_found(search, self.longest) for search in searches]
        targets = [search.target for search in searches]
        curve = mean_performance(finds, [search.subject for search in searches], self.longest - 1)
        by_category = mean_performance(finds, targets, _SHIFTS)
        return Beside(
            curve=curve,
            area=(performance_area(curve), self._area_error(finds, searches)),
            tfp_auc=(tfp_auc(finds, targets), self._tfp_auc_error(finds, searches)),
            mismatch=probability_mismatch(by_category, self.curve),
            ratio=_mean_ratio(searches),
            alike=self._alike(searches),
        )

    def _area_error(self, finds: Sequence[int], searches: Sequence[Fixations]) -> float:
        """Compute the standard error over pictures of the area under performance."""
        areas = defaultdict(list)
        for found, search in zip(finds, searches, strict=True):
            performance = cumulative_performance(np.array([found]), self.longest - 1)
            areas[search.picture].append(performance_area(performance))
        return float(standard_error(np.array([np.mean(of_picture) for of_picture in areas.values()])))

    def _tfp_auc_error(self, finds: Sequence[int], searches: Sequence[Fixations]) -> float:
        """Compute the standard error of TFP-AUC by bootstrap: pictures are drawn with replacement, target by target."""
        # A search that succeeds after n gaze shifts counts in 7 - n of the seven values that are summed.
        counts = defaultdict(list)
        for found, search in zip(finds, searches, strict=True):
            counts[search.target, search.picture].append(max(0, _SHIFTS + 1 - found) if found >= 0 else 0)
        pictures_of = defaultdict(list)
        for (target, _), of_picture in counts.items():
            pictures_of[target].append((float(np.sum(of_picture)), len(of_picture)))
        generator = np.random.default_rng(0)
        sums = np.zeros(self.bootstrap)
        for pictures in pictures_of.values():
            table = np.array(pictures)
            samples = generator.integers(0, len(table), (self.bootstrap, len(table)))
            counted, number = table[samples].sum(1).T
            sums += counted / number
        return float((sums / len(pictures_of)).std(ddof=1))

    def _alike(self, searches: Sequence[Fixations]) -> dict[str, _Array]:
        """Compare searches with people's, picture by picture (`Beside.alike`)."""
        alike = {}
        for name, in_picture in by_picture(searches).items():
            if name not in self.pictures:
                continue
            pairs = self._pairs(name, in_picture)
            if pairs:
                measures = np.array(pairs, dtype=np.float64)
                scanpaths = measures[:, : len(DIMENSIONS)]
                compared = scanpaths[np.isfinite(scanpaths[:, 0])]
                multimatch_mean = compared.mean(0) if len(compared) else np.full(len(DIMENSIONS), np.nan)
                alike[name] = np.concatenate([multimatch_mean, measures[:, len(DIMENSIONS) :].mean(0)])
        return alike

    def _pairs(self, name: str, searches: Sequence[Fixations]) -> list[list[float]]:
        """Compare each search in a picture with those of all other people.

        Args:
            name: the picture.
            searches: searches in it, of a model or of the people themselves.

        Returns:
            For each pair the six measures of `Beside.alike`; MultiMatch is NaN unless both searches succeed.
        """
        pairs = []
        for search, word in zip(searches, self._words(name, searches), strict=True):
            path = in_cells(search, self.grid)
            people = zip(self.pictures[name], self.cells[name], self.words[name], strict=True)
            for other, path_of_other, word_of_other in people:
                # Each pair of people is counted only once.
                if id(search) in self._ids and other.subject <= search.subject:
                    continue
                scanpath_measures = [math.nan] * len(DIMENSIONS)
                if _succeeds(search) and _succeeds(other):
                    match = multimatch(path, path_of_other, (self.grid.columns, self.grid.rows))
                    scanpath_measures = [*match[: len(DIMENSIONS)]]
                similarity = sequence_score(word, word_of_other)
                pairs.append([*scanpath_measures, similarity, edit_distance(word, word_of_other)])
        return pairs

    def _words(self, name: str, searches: Sequence[Fixations]) -> list[list[int]]:
        """Write each search in a picture as a word, whose letters are the clusters of its fixations."""
        letters = self.clusters[name].predict(np.concatenate([search.points for search in searches]))
        ends = np.cumsum([len(search) for search in searches])[:-1]
        return [word.tolist() for word in np.split(letters, ends)]


def _succeeds(search: Fixations) -> bool:
    """Tell whether a search finds its target, however many fixations it takes."""
    return shift_found(search, 10**6) >= 0


def _mean_ratio(searches: Sequence[Fixations]) -> tuple[float, float]:
    """Average the scanpath ratio of the successful searches, with its standard error over pictures."""
    ratios = defaultdict(list)
    for search in searches:
        ratios[search.picture].append(scanpath_ratio(search.points + 0.5, search.box or (0, 0, 0, 0)))
    with_success = [of_picture for of_picture in ratios.values() if np.isfinite(of_picture).any()]
    return _mean_and_error(np.array([np.nanmean(of_picture) for of_picture in with_success]))


def _mean_and_error(values: _Array) -> tuple[float, float]:
    """Average values, with the standard error; NaN if there are none."""
    if not len(values):
        return math.nan, math.nan
    return float(values.mean()), float(standard_error(values))
