"""Folds of people who view pictures: of one data set, of given maps, or scored by other people than fitted."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Literal, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.gaze import GazeFit, fit_oculomotor
from semfov.fit.gaze_folds import Fold, Groups
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of
from semfov.human.viewing import Viewed, counted, log_centre

Maps = Literal["features", "none", "other people"]
"""What the map is: fitted to feature maps, flat, or the density of all other people in the picture."""

_BLURS = (0.7, 0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.5)  # standard deviations in cells from which one is chosen
_SHARES = (0.02, 0.05, 0.1, 0.15, 0.2)  # shares of the centre bias
_JUDGED = 100  # pictures of a data set by which blur and share are chosen, about


class Smoothing(NamedTuple):
    """How the fixations of people are made a density.

    Attributes:
        blur: standard deviation of the Gaussian around each fixation, in cells.
        share: share of the centre bias that is mixed in.
    """

    blur: float
    share: float


class StudiedFold(Fold):
    """A fold whose model is fitted to one data set `only`, has given `maps`, or is scored by other people, `judges`."""

    def __init__(
        self,
        groups: Groups,
        number: int,
        count: int,
        settings: GazeFit,
        *,
        maps: Maps = "features",
        only: int | None = None,
        judges: Groups | None = None,
    ) -> None:
        super().__init__(groups, number, count, settings)
        self._given, self._only, self.judges = maps, only, judges or groups

    @property
    def what(self) -> dict[str, object]:
        return {**super().what, "only": self._only, "maps": self._given}

    def fitted(self, source: int | None = None) -> list[list[int]]:
        return super().fitted(self._only if source is None else source)

    def fit(self) -> FixationDensity:
        """Fit the density; to given maps its oculomotor biases alone."""
        if self._given == "features":
            return super().fit()
        # The density of other people holds the centre bias already.
        centre = log_centre(self.groups(), self.fitted()) if self._given == "none" else torch.zeros(1, 1)
        model = FixationDensity({"none": 1}, centre=centre)
        known = [self.maps(model, *each) for each in zip(self.groups(), self.fitted(), strict=True)]
        fit_oculomotor(model, self.groups(), known, self.fitted(), self.settings)
        return model.requires_grad_(False)

    def maps(self, model: FixationDensity, group: Viewed, pictures: Sequence[int]) -> list[Tensor]:
        if self._given == "features":
            return super().maps(model, group, pictures)
        if self._given == "none":
            return [torch.zeros(1, *cells_of(group.size))] * len(pictures)
        smoothing = self.smoothings[group.source]
        return [others_of(group, each, self.centres[group.source], smoothing) for each in pictures]

    @cached_property
    def smoothings(self) -> dict[int, Smoothing]:
        """How people predict each other best in the pictures of each data set that models are fitted to."""
        return {
            source: likeliest_smoothing(self.groups(), self.fitted(source), centre)
            for source, centre in self.centres.items()
        }


def spread(number: int, count: int) -> list[int]:
    """Up to `count` of so many pictures, evenly spread."""
    return [*dict.fromkeys(number * each // count for each in range(count))]


def in_first(fold: Fold, picture: int) -> tuple[Viewed, int]:
    """Find the group of a picture of the first data set, and its place there."""
    places = [(group, place) for group in fold.groups() if group.source == 0 for place in range(len(group))]
    return places[picture]


def viewed_by(group: Viewed, subjects: Collection[str]) -> Viewed:
    """Return the same pictures, viewed by some of the people."""
    some = tuple(tuple(each for each in people if each.subject in subjects) for people in group.people)
    return replace(group, people=some)


def others_of(group: Viewed, picture: int, centre: Tensor, smoothing: Smoothing) -> Tensor:
    """Log density of the fixations of all other people, for each person of a picture, without first fixations.

    Args:
        group: pictures of one size.
        picture: number of the picture.
        centre: log density of the centre bias, `(rows, columns)`.
        smoothing: how fixations are made a density.

    Returns:
        `(people, rows, columns)`.
    """
    bias = _bias(centre, group)
    counts = counted(group.paths[picture], group.size, cells_of(group.size))
    density = (1 - smoothing.share) * _blurred_others(counts, bias, smoothing.blur) + smoothing.share * bias
    return density.log()


def _bias(centre: Tensor, group: Viewed) -> Tensor:
    """Interpolate the centre bias at the cells of pictures, as probabilities `(rows, columns)`."""
    cells = cells_of(group.size)
    return F.interpolate(centre[None, None], cells, mode="bilinear")[0, 0].flatten().softmax(0).unflatten(0, cells)


def _blurred_others(counts: Tensor, bias: Tensor, blur: float) -> Tensor:
    """Blur the counts of all others than each person to densities `(people, rows, columns)`; the bias without any."""
    smooth = blurred(counts.sum(0) - counts, torch.tensor(blur))
    total = smooth.sum((1, 2), keepdim=True)
    return torch.where(total > 0, smooth / total, bias)


def likeliest_smoothing(groups: Sequence[Viewed], pictures: Sequence[Sequence[int]], centre: Tensor) -> Smoothing:
    """Choose the smoothing by which the fixations of each person are likeliest, given those of all others.

    With a fixed one people would predict each other worse than they can.

    Args:
        groups: pictures of one size each.
        pictures: numbers of the pictures of each group.
        centre: log density of the centre bias.

    Returns:
        Blur and share with the largest mean over pictures of the log likelihood of a fixation.
    """
    chosen = [(group, number) for group, numbers in zip(groups, pictures, strict=True) for number in numbers]
    likelihood = torch.zeros(len(_BLURS), len(_SHARES))
    for group, number in chosen[:: max(1, len(chosen) // _JUDGED)]:
        bias = _bias(centre, group)
        counts = counted(group.paths[number], group.size, cells_of(group.size))
        person, row, column = counts.nonzero(as_tuple=True)
        weight = counts[person, row, column] / counts.sum()
        share = torch.tensor(_SHARES)[:, None]
        for place, blur in enumerate(_BLURS):
            # Only where somebody looked.
            smooth = _blurred_others(counts, bias, blur)[person, row, column]
            likelihood[place] += (((1 - share) * smooth + share * bias[row, column]).log() * weight).sum(1)
    best = int(likelihood.argmax())
    return Smoothing(_BLURS[best // len(_SHARES)], _SHARES[best % len(_SHARES)])
