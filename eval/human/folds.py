"""Folds of people who view pictures: of one data set, of given maps, or scored by other people than fitted."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.fit.gaze import GazeFit, fit_oculomotor
from semfov.fit.gaze_folds import Fold
from semfov.fit.viewing import Viewed, counted, log_centre
from semfov.gaze.saliency.fixation_density import FixationDensity, blurred, cells_of

Groups = Callable[[], Sequence[Viewed]]
"""Gives the pictures, by data set and size."""

Maps = Literal["features", "none", "other people"]
"""What the map is: fitted to feature maps, flat, or the density of all other people in the picture."""


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
        return [others_of(group, each, self.centres[group.source]) for each in pictures]


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


def others_of(group: Viewed, picture: int, centre: Tensor, *, blur: float = 1.3, share: float = 0.05) -> Tensor:
    """Log density of the fixations of all other people, for each person of a picture, `(people, rows, columns)`.

    Counts without first fixations are blurred by `blur` cells, and mixed with a `share` of the centre bias `centre`, a
    log density `(rows, columns)`.
    """
    cells = cells_of(group.size)
    bias = F.interpolate(centre[None, None], cells, mode="bilinear")[0, 0].flatten().softmax(0)
    counts = counted(group.paths[picture], group.size, cells)
    smooth = blurred(counts.sum(0) - counts, torch.tensor(blur)).flatten(1)
    total = smooth.sum(1, keepdim=True)
    density = (1 - share) * torch.where(total > 0, smooth / total, bias) + share * bias
    return density.log().unflatten(1, cells)
