"""Scores of models of where people look, on folds of the pictures that they were fitted without."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path

import torch
from torch import Tensor

from semfov.errors import SemfovError
from semfov.fit.gaze import GazeFit, fitted_density, maps_of, score
from semfov.gaze.saliency.fixation_density import FixationDensity, cells_of
from semfov.human.viewing import Viewed, log_centre
from semfov.io.code import modules_digest
from semfov.io.storage import read_tensors, write_tensors
from semfov.runs.scene_run import digest_of

Scores = dict[tuple[str, int], Tensor]
"""By row and data set, NSS, AUC and log likelihood in bits above uniform, means of each picture `(P, 3)`."""

Groups = Callable[[], Sequence[Viewed]]
"""Gives the pictures, by data set and size."""

CENTRE = "centre bias"
ROWS = {False: ("map", "map and centre bias"), True: ("map and oculomotor biases", "all terms")}
"""Rows by the terms of their models, without and with the scanpath."""


class Fold:
    """Pictures that are held out in one of `count` folds, and those a model is fitted to; looked at when needed.

    Attributes:
        groups: gives the pictures, with the fixations that models are fitted to.
        number: number of the fold, from 0.
        count: number of folds.
        settings: how models are fitted.
        title: the fold in words.
        judges: gives the same pictures, with the fixations that are predicted.
    """

    def __init__(self, groups: Groups, number: int, count: int, settings: GazeFit) -> None:
        self.groups = groups
        self.number = number
        self.count = count
        self.settings = settings
        self.title = f"fold {number + 1} of {count}"
        self.judges = groups

    @property
    def what(self) -> dict[str, object]:
        """What models and scores depend on, beside the pictures."""
        return {"fit": self.settings.plain(), "fold": [self.number, self.count]}

    @cached_property
    def split(self) -> list[tuple[list[int], list[int]]]:
        """For each group the other pictures and those held out."""
        pictures_before: dict[int, int] = {}  # of the data set in earlier groups
        split = []
        for group in self.groups():
            # Every `count`-th picture of the data set is held out, whatever the sizes of its pictures.
            first = pictures_before.get(group.source, 0)
            held_out = [*range((self.number - first) % self.count, len(group), self.count)]
            others = [picture for picture in range(len(group)) if picture not in set(held_out)]
            split.append((others, held_out))
            pictures_before[group.source] = first + len(group)
        return split

    def fitted(self, source: int | None = None) -> list[list[int]]:
        """Return the pictures of each group that models are fitted to, of one data set or of all."""
        return [
            others if source in (None, group.source) else []
            for group, (others, _) in zip(self.groups(), self.split, strict=True)
        ]

    @cached_property
    def centres(self) -> dict[int, Tensor]:
        """Log density of the centre bias of each data set."""
        sources = {group.source for group in self.groups()}
        return {source: log_centre(self.groups(), self.fitted(source)) for source in sources}

    def fit(self) -> FixationDensity:
        """Fit a model to the other pictures."""
        return fitted_density(self.settings, self.groups(), self.fitted(), self.title)

    def maps(self, model: FixationDensity, group: Viewed, pictures: Sequence[int]) -> list[Tensor]:
        """Compute the maps of some pictures of a group."""
        return maps_of(model, group, pictures)

    def scores(self, model: FixationDensity) -> Scores:
        """Score a model on the held-out pictures with and without each term, and the centre bias of each data set."""
        scores: dict[tuple[str, int], list[Tensor]] = {}
        for group, judge, (_, held_out) in zip(self.groups(), self.judges(), self.split, strict=True):
            for row, of_pictures in self._group_scores(model, group, judge, held_out).items():
                scores.setdefault((row, group.source), []).append(of_pictures)
        return {key: torch.cat(parts) for key, parts in scores.items()}

    def _group_scores(
        self, model: FixationDensity, group: Viewed, judge: Viewed, pictures: list[int]
    ) -> dict[str, Tensor]:
        """Score a model on pictures of one size; returns scores `(P, 3)` by row."""
        maps = self.maps(model, group, pictures)
        bias = FixationDensity({"none": 1}, centre=self.centres[group.source])
        flat_maps = [torch.zeros(1, *cells_of(group.size))] * len(pictures)
        scores = {CENTRE: score(bias, judge, flat_maps, pictures, conditional=False)[0]}
        for conditional, rows in ROWS.items():
            if self.settings.saccade_epochs or not conditional:
                of_rows = score(model, judge, maps, pictures, conditional=conditional, without=((CENTRE,), ()))
                scores |= dict(zip(rows, of_rows, strict=True))
        return scores


class FoldStore:
    """Folder of the models of folds and their scores, computed once for the same data, settings and code."""

    def __init__(self, folder: Path, what: Mapping[str, object]) -> None:
        self.folder = folder
        self.what = {**what, "code": modules_digest("semfov.gaze.saliency", __name__)}

    def model(self, name: str, fold: Fold) -> FixationDensity:
        """Read the model of a fold, or fit and write it."""
        key = digest_of({**self.what, "name": name, **fold.what})
        path = self.folder / f"{name} {fold.title} model.safetensors"
        with suppress(SemfovError):  # whatever is wrong with the file, it can be fitted again
            model = FixationDensity.from_pretrained(path)
            if model.metadata.get("key") == key:
                return model.requires_grad_(False)
        model = fold.fit()
        model.metadata["key"] = key
        model.save(path)
        return model

    def scores(self, name: str, folds: Iterable[Fold]) -> Scores:
        """Read or compute the scores of folds, and join them.

        Args:
            name: name of the models.
            folds: the folds.

        Returns:
            The scores of all folds.
        """
        parts: dict[tuple[str, int], list[Tensor]] = {}
        for fold in folds:
            what = {"name": name, **fold.what}
            tensors = self.kept(f"{name} {fold.title}", what, partial(self._scores_of, name, fold))
            for key, tensor in tensors.items():
                row, _, source = key.rpartition("/")
                parts.setdefault((row, int(source)), []).append(tensor)
        return {key: torch.cat(of_folds) for key, of_folds in parts.items()}

    def _scores_of(self, name: str, fold: Fold) -> dict[str, Tensor]:
        """Compute the scores of a fold, by row and data set in one name."""
        scores = fold.scores(self.model(name, fold))
        return {f"{row}/{source}": tensor for (row, source), tensor in scores.items()}

    def kept(
        self, name: str, what: Mapping[str, object], compute: Callable[[], dict[str, Tensor]]
    ) -> dict[str, Tensor]:
        """Read tensors from a file, or compute and write them.

        Args:
            name: name of the file.
            what: what the tensors depend on.
            compute: computes them.

        Returns:
            The tensors by name.
        """
        key = digest_of({**self.what, **what})
        path = self.folder / f"{name}.safetensors"
        tensors = read_tensors(path, key)
        if tensors is None:
            tensors = compute()
            write_tensors(path, key, tensors)
        return tensors
