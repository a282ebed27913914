"""Scores of models of where people look, on folds of the pictures that they were fitted without."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from semfov.errors import SemfovError, check
from semfov.fit.gaze import GazeFit, fit_oculomotor, fitted_density, maps_of, score
from semfov.fit.viewing import Viewed, log_centre, others_of
from semfov.gaze.saliency.fixation_density import FixationDensity, cells_of
from semfov.io.code import modules_digest
from semfov.io.storage import read_tensors, write_tensors
from semfov.runs.scene_run import digest_of

Maps = Literal["features", "none", "other people"]
"""What the map is: fitted to feature maps, flat, or the density of all other people in the picture."""

Scores = dict[tuple[str, int], Tensor]
"""By row and data set, NSS, AUC and log likelihood in bits above uniform, means of each picture `(P, 3)`."""

Groups = Callable[[], Sequence[Viewed]]
"""Gives the pictures, by data set and size."""

CENTRE = "centre bias"
ROWS = {False: ("map", "map and centre bias"), True: ("map and oculomotor biases", "all terms")}
"""Rows by the terms of their models, without and with the scanpath."""


def _folds(number: int, count: int, fold: int, first: int = 0) -> tuple[list[int], list[int]]:
    """Pictures to fit on and pictures held out of one of `count` folds: every `count`-th picture is held out.

    `first` is the number of the first picture in its data set, of which a group has the pictures of one size.
    """
    check(0 <= fold < count, "fold", f"a number from 0 to {count - 1}", fold)
    held = [*range((fold - first) % count, number, count)]
    return [each for each in range(number) if each not in set(held)], held


class Fold:
    """The pictures of one of `count` folds, which are held out, and the others, to which models are fitted.

    With `only`, models are fitted to one data set, and scored on all. The pictures are looked at when they are needed.
    """

    def __init__(self, groups: Groups, number: int, count: int, only: int | None = None) -> None:
        self._groups, self.number, self.count, self.only = groups, number, count, only

    @property
    def groups(self) -> Sequence[Viewed]:
        """The pictures, by data set and size."""
        return self._groups()

    @cached_property
    def _split(self) -> list[tuple[list[int], list[int]]]:
        """For each group the other pictures and those held out."""
        before: dict[int, int] = {}
        split = []
        for group in self.groups:
            first = before.get(group.source, 0)
            split.append(_folds(len(group), self.count, self.number, first))
            before[group.source] = first + len(group)
        return split

    @property
    def held(self) -> list[list[int]]:
        """The pictures of each group that are held out."""
        return [held for _, held in self._split]

    @property
    def fitted(self) -> list[list[int]]:
        """The pictures of each group that models are fitted to."""
        return self._of(self.only)

    @cached_property
    def centres(self) -> dict[int, Tensor]:
        """Log density of the centre bias of each data set."""
        return {source: log_centre(self.groups, self._of(source)) for source in {each.source for each in self.groups}}

    def _of(self, source: int | None) -> list[list[int]]:
        """The other pictures of each group of one data set, or of all."""
        pairs = zip(self.groups, self._split, strict=True)
        return [fitted if source in (None, group.source) else [] for group, (fitted, _) in pairs]

    def fit(self, fit: GazeFit, maps: Maps = "features") -> FixationDensity:
        """The model that is fitted to the other pictures; that of given maps has oculomotor biases alone."""
        if maps == "features":
            return fitted_density(fit, self.groups, self.fitted, f"fold {self.number + 1} of {self.count}")
        # The density of other people holds the centre bias already.
        centre = log_centre(self.groups, self.fitted) if maps == "none" else torch.zeros(1, 1)
        model = FixationDensity({"none": 1}, centre=centre)
        known = [self.given(maps, *each) for each in zip(self.groups, self.fitted, strict=True)]
        fit_oculomotor(model, self.groups, known, self.fitted, fit)
        return model.requires_grad_(False)

    def given(self, maps: Maps, group: Viewed, pictures: Sequence[int]) -> list[Tensor]:
        """Maps that are not fitted: flat ones, or the densities of other people."""
        if maps == "other people":
            return [others_of(group, each, self.centres[group.source]) for each in pictures]
        return [torch.zeros(1, *cells_of(group.size))] * len(pictures)

    def scores(
        self, model: FixationDensity, fit: GazeFit, maps: Maps = "features", judges: Groups | None = None
    ) -> Scores:
        """Scores on the held-out pictures with and without each term, and of the centre bias of each data set.

        `judges` are the same pictures viewed by other people, whose fixations are predicted.
        """
        scores: dict[tuple[str, int], list[Tensor]] = {}
        for group, seen, some in zip(self.groups, (judges or self._groups)(), self.held, strict=True):
            known = maps_of(model, group, some) if maps == "features" else self.given(maps, group, some)
            bias = FixationDensity({"none": 1}, centre=self.centres[group.source])
            found = {CENTRE: score(bias, seen, self.given("none", group, some), some, conditional=False)[0]}
            for conditional, names in ROWS.items():
                if fit.saccade_epochs or not conditional:
                    scored = score(model, seen, known, some, conditional=conditional, without=((CENTRE,), ()))
                    found |= dict(zip(names, scored, strict=True))
            for name, each in found.items():
                scores.setdefault((name, group.source), []).append(each)
        return {key: torch.cat(parts) for key, parts in scores.items()}


class FoldStore:
    """Models of folds, their scores and what else is computed of them in a folder, each computed once.

    A change of the data, of the settings or of the program computes them anew.
    """

    def __init__(self, folder: Path, what: Mapping[str, object]) -> None:
        self.folder, code = folder, modules_digest("semfov.gaze.saliency", __name__)
        self.what = {**what, "code": code}

    def model(self, name: str, fold: Fold, fit: GazeFit, maps: Maps = "features") -> FixationDensity:
        """The model of a fold, read or fitted."""
        file, what = self._place(name, fold, fit, maps)
        key, path = digest_of({**self.what, **what}), self.folder / f"{file} model.safetensors"
        try:
            model = FixationDensity.from_pretrained(path)
            if model.metadata.get("key") == key:
                return model.requires_grad_(False)
        except SemfovError:  # whatever is wrong with the file, it can be fitted again
            pass
        model = fold.fit(fit, maps)
        model.metadata["key"] = key
        model.save(path)
        return model

    def scores(
        self, name: str, fold: Fold, fit: GazeFit, maps: Maps = "features", judges: Groups | None = None
    ) -> Scores:
        """The scores of a fold, read or computed."""

        def computed() -> dict[str, Tensor]:
            scores = fold.scores(self.model(name, fold, fit, maps), fit, maps, judges)
            return {f"{row}/{source}": each for (row, source), each in scores.items()}

        kept = self.kept(*self._place(name, fold, fit, maps), computed)
        return {(row, int(source)): kept[f"{row}/{source}"] for row, source in (key.rsplit("/", 1) for key in kept)}

    def kept(
        self, name: str, what: Mapping[str, object], compute: Callable[[], dict[str, Tensor]]
    ) -> dict[str, Tensor]:
        """Tensors that depend on `what`, read from the file of this name, or computed and written."""
        key, path = digest_of({**self.what, **what}), self.folder / f"{name}.safetensors"
        kept = read_tensors(path, key)
        if kept is None:
            kept = compute()
            write_tensors(path, key, kept)
        return kept

    def _place(self, name: str, fold: Fold, fit: GazeFit, maps: Maps) -> tuple[str, dict[str, object]]:
        """The name of a fold's files, and what they depend on."""
        what: dict[str, object] = {"name": name, "fit": fit.plain()}
        what |= {"fold": [fold.number, fold.count, fold.only], "maps": maps}
        return f"{name} fold {fold.number + 1} of {fold.count}", what


def joined(scored: Sequence[Scores]) -> Scores:
    """The scores of several folds as one."""
    return {key: torch.cat([fold[key] for fold in scored]) for key in (scored[0] if scored else {})}
