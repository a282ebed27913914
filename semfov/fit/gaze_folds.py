"""Scores of models of where people look, on folds of the pictures that they were fitted without."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path

import torch
from torch import Tensor

from semfov.errors import SemfovError
from semfov.fit.gaze import GazeFit, fitted_density, maps_of, score
from semfov.fit.viewing import Viewed, log_centre
from semfov.gaze.saliency.fixation_density import FixationDensity, cells_of
from semfov.io.code import modules_digest
from semfov.io.storage import read_tensors, write_tensors
from semfov.runs.scene_run import digest_of

Scores = dict[tuple[str, int], Tensor]
"""By row and data set, NSS, AUC and log likelihood in bits above uniform, means of each picture `(P, 3)`."""

_Groups = Callable[[], Sequence[Viewed]]  # gives the pictures, by data set and size

CENTRE = "centre bias"
ROWS = {False: ("map", "map and centre bias"), True: ("map and oculomotor biases", "all terms")}
"""Rows by the terms of their models, without and with the scanpath."""


class Fold:
    """Pictures that are held out in one of `count` folds, and those a model is fitted to; looked at when needed."""

    def __init__(self, groups: _Groups, number: int, count: int, settings: GazeFit) -> None:
        self.groups, self.number, self.count, self.settings = groups, number, count, settings
        self.title = f"fold {number + 1} of {count}"
        self.judges = groups  # the same pictures, with the fixations that are predicted

    @property
    def what(self) -> dict[str, object]:
        """What models and scores depend on, beside the pictures."""
        return {"fit": self.settings.plain(), "fold": [self.number, self.count]}

    @cached_property
    def _split(self) -> list[tuple[list[int], list[int]]]:
        """For each group the other pictures and those held out."""
        before: dict[int, int] = {}
        split = []
        for group in self.groups():  # the pictures of one size, of which every `count`-th of the data set is held out
            first = before.get(group.source, 0)
            held = [*range((self.number - first) % self.count, len(group), self.count)]
            split.append(([each for each in range(len(group)) if each not in set(held)], held))
            before[group.source] = first + len(group)
        return split

    def fitted(self, source: int | None = None) -> list[list[int]]:
        """The pictures of each group that models are fitted to, of one data set or of all."""
        pairs = zip(self.groups(), self._split, strict=True)
        return [fitted if source in (None, group.source) else [] for group, (fitted, _) in pairs]

    @cached_property
    def centres(self) -> dict[int, Tensor]:
        """Log density of the centre bias of each data set."""
        sources = {each.source for each in self.groups()}
        return {source: log_centre(self.groups(), self.fitted(source)) for source in sources}

    def fit(self) -> FixationDensity:
        """The model that is fitted to the other pictures."""
        return fitted_density(self.settings, self.groups(), self.fitted(), self.title)

    def maps(self, model: FixationDensity, group: Viewed, pictures: Sequence[int]) -> list[Tensor]:
        """The maps of some pictures of a group."""
        return maps_of(model, group, pictures)

    def scores(self, model: FixationDensity) -> Scores:
        """Scores on the held-out pictures with and without each term, and of the centre bias of each data set."""
        scores: dict[tuple[str, int], list[Tensor]] = {}
        for group, seen, (_, some) in zip(self.groups(), self.judges(), self._split, strict=True):
            known = self.maps(model, group, some)
            bias = FixationDensity({"none": 1}, centre=self.centres[group.source])
            flat = [torch.zeros(1, *cells_of(group.size))] * len(some)
            found = {CENTRE: score(bias, seen, flat, some, conditional=False)[0]}
            for conditional, names in ROWS.items():
                if self.settings.saccade_epochs or not conditional:
                    scored = score(model, seen, known, some, conditional=conditional, without=((CENTRE,), ()))
                    found |= dict(zip(names, scored, strict=True))
            for name, each in found.items():
                scores.setdefault((name, group.source), []).append(each)
        return {key: torch.cat(parts) for key, parts in scores.items()}


class FoldStore:
    """Models of folds and what is computed of them, in a folder, once for the same data, settings and program."""

    def __init__(self, folder: Path, what: Mapping[str, object]) -> None:
        self.folder, code = folder, modules_digest("semfov.gaze.saliency", __name__)
        self.what = {**what, "code": code}

    def model(self, name: str, fold: Fold) -> FixationDensity:
        """The model of a fold, read or fitted."""
        key = digest_of({**self.what, "name": name, **fold.what})
        path = self.folder / f"{name} {fold.title} model.safetensors"
        try:
            model = FixationDensity.from_pretrained(path)
            if model.metadata.get("key") == key:
                return model.requires_grad_(False)
        except SemfovError:  # whatever is wrong with the file, it can be fitted again
            pass
        model = fold.fit()
        model.metadata["key"] = key
        model.save(path)
        return model

    def scores(self, name: str, folds: Iterable[Fold]) -> Scores:
        """The scores of folds as one, read or computed."""

        def computed(fold: Fold) -> dict[str, Tensor]:
            scores = fold.scores(self.model(name, fold))
            return {f"{row}/{source}": each for (row, source), each in scores.items()}

        parts: dict[str, list[Tensor]] = {}
        for fold in folds:
            kept = self.kept(f"{name} {fold.title}", {"name": name, **fold.what}, partial(computed, fold))
            for key, each in kept.items():
                parts.setdefault(key, []).append(each)
        named = ((*key.rpartition("/")[::2], torch.cat(each)) for key, each in parts.items())
        return {(row, int(source)): each for row, source, each in named}

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
