"""Fit evidence by magnification on mosaics of photographs, and on other kinds of large pictures."""

import math
import random
from collections.abc import Collection, Mapping, Sequence
from contextlib import closing
from typing import Literal, get_args

import torch

from semfov.data.mosaics import Mosaics
from semfov.data.scene import ChosenScenes, Scenes
from semfov.errors import DataError, check
from semfov.fit.photographs import fit_photographs
from semfov.fit.training import training_of
from semfov.fit.windows_certainty import fit_certainty
from semfov.fit.windows_decisions import (
    MosaicSearch,
    WindowSearches,
    choose_places,
    fit_presence,
    judge_searches,
    search_pictures,
)
from semfov.fit.windows_evidence import ZoomExample, fit_rates, fit_survey, judge_windows
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.files import json_sha256
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.scene_run import store_folder
from semfov.runs.setup import make_detector, make_scenes, split_photographs
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker, run_tasks
from semfov.runs.zoom_store import StoredWindowLooks, WindowLookStore
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import half_steps
from semfov.zoom.survey import Survey

RefitPart = Literal["survey", "certainty", "decision", "photograph"]
"""Parts of evidence that may be fitted again: numbers of objects of any class, the probability that an object is there
with the spread of expected numbers, decisions of searches, and the evidence for photographs."""

_CROWDED = 1 / 3  # share of the photographs that the crowded mosaics show, those with the most objects


def crowded(scenes: Scenes, share: float) -> ChosenScenes:
    """Choose the scenes with the most objects.

    Args:
        scenes: the scenes.
        share: share of them that is chosen.

    Returns:
        The chosen scenes, in the order of the set; among scenes with as many objects the first ones are chosen.
    """
    check(0 < share <= 1, "share", "above 0 and at most 1", share)
    check(len(scenes) > 0, "scenes", "at least one scene", len(scenes))
    objects = [len(scenes.annotation(index).boxes) for index in range(len(scenes))]
    by_objects = sorted(range(len(scenes)), key=lambda index: -objects[index])
    count = math.ceil(share * len(scenes))
    chosen = sorted(by_objects[:count])
    ids: list[int] | list[str] = [scenes.ids[index] for index in chosen]  # type: ignore[assignment]
    return ChosenScenes([(scenes, index) for index in chosen], ids, json_sha256([scenes.fingerprint, ids]))


def _look(fit: "MosaicFit", task: tuple[str, int]) -> bytes:
    """Look at all windows of a picture that are not in the store yet; returns what the store has of it."""
    kind, index = task
    pictures = fit.pictures[kind]
    source = StoredWindowLooks(fit.eye, pictures, index, fit.store)
    source.see([*half_steps(source.lattice)])
    source.save()
    tensors = fit.store.read(pictures.digest(index))
    return b"" if tensors is None else pack_tensors(tensors)


class MosaicFit:
    """A fit of evidence part by part, with the mosaics, and the store of the looks at them.

    Each part uses those before it (`fit`):

        looks ─► numbers of objects of a class ─► of any class ─► certainty ─► decisions
                 (and, of photographs as they are, the evidence for photographs)

    Attributes:
        config: the settings.
        eye: looks at windows.
        training: photographs to compose pictures to fit on.
        held_out: photographs to compose pictures to evaluate on.
        mosaics: mosaics by the name of their kind.
        pictures: these and pictures of other kinds.
        store: keeps the looks on disk.
        figures: measures on held-out pictures by name.
    """

    kinds: tuple[str, ...] = ()
    """Kinds of pictures to fit on beside the mosaics."""

    def __init__(self, config: FitMosaicsConfig, eye: WindowEye | None = None) -> None:
        if eye is None:
            eye = WindowEye(make_detector(config.detector)).eval().requires_grad_(False)
        self.config = config
        self.eye = eye
        self.training, self.held_out = split_photographs(config.data, eye.detector.classes, config.holdout)
        half_tile = config.tile // 2, config.tile * 3 // 4 // 2
        self.mosaics = {
            "near": self.mosaic(self.training, 4, 4, config.mosaics, 0),
            "far": self.mosaic(self.training, 8, 6, config.far, 1),
            "small": Mosaics(self.training, 12, 12, tile=half_tile, count=config.far, seed=config.seed + 7),
            "judged": self.mosaic(self.held_out, 4, 4, config.judged, 2),
            "searched": self.mosaic(self.training, 4, 4, config.searched, 4),
            "crowded": self.mosaic(crowded(self.training, _CROWDED), 4, 4, config.crowded, 5),
        }
        self.pictures: dict[str, Scenes] = {**self.mosaics}
        self.store = WindowLookStore(store_folder(config.cache) / "glances", eye.settings(), len(eye.detector.classes))
        self.figures: dict[str, float] = {}

    def mosaic(self, scenes: Scenes, columns: int, rows: int, count: int, number: int) -> Mosaics:
        """Make mosaics of photographs.

        Args:
            scenes: the photographs.
            columns: photographs in a row.
            rows: photographs in a column.
            count: number of mosaics.
            number: number that the seed of the fit is raised by.

        Returns:
            The mosaics.
        """
        tile = self.config.tile, self.config.tile * 3 // 4
        return Mosaics(scenes, columns, rows, tile=tile, count=count, seed=self.config.seed + number)

    def opened(self, kind: str) -> list[StoredWindowLooks]:
        """Open the stored looks at each picture of a kind."""
        pictures = self.pictures[kind]
        return [StoredWindowLooks(self.eye, pictures, index, self.store) for index in range(len(pictures))]

    def fit(
        self,
        parts: Collection[RefitPart] = get_args(RefitPart),
        model: GlimpseEvidence | None = None,
    ) -> tuple[GlimpseEvidence, list[str]]:
        """Fit evidence, or parts of it again.

        Args:
            parts: the parts to fit, beside the numbers of objects of a class where there is no model.
            model: evidence that was fitted before; it is changed.

        Returns:
            The evidence, and lines of Markdown.

        Raises:
            DataError: mosaics are so small that one look shows all of them.
        """
        kinds = self.looked(parts, model is None)
        if "judged" in kinds and not any(looks.lattice.levels > 1 for looks in self.opened("judged")):
            raise DataError(
                "data: expected photographs whose mosaics are larger than the detector's input, got a width of "
                f"{self.config.tile} px for each; give larger ones, or raise tile"
            )
        examples = self.look(kinds)
        lines: list[str] = []
        if model is None:
            model = self.fit_prediction(examples)
            measured = judge_windows(model, examples["judged"])
            self.figures |= measured
            lines += [f"Evaluation on {len(examples['judged'])} mosaics of held-out photographs:", ""]
            lines += [*measure_table(measured), ""]
        if "survey" in parts:
            lines += self.fit_survey(model, examples)
        if "certainty" in parts:
            lines += self.fit_certainty(model)
        if "decision" in parts:
            lines += self.fit_decisions(model, self.search(model))
        if "photograph" in parts and self.config.photographs:
            scenes = make_scenes(self.config.data, self.eye.detector.classes)
            lines += ["Photographs:", "", fit_photographs(model, scenes, self.eye, self.config)]
        return model, lines

    def looked(self, parts: Collection[RefitPart], anew: bool) -> list[str]:
        """List the kinds of pictures that must be looked at to fit some parts, or all anew."""
        kinds = ["near", "far", "judged"] if anew or "survey" in parts else []
        if "survey" in parts:
            kinds.append("crowded")
        return [*kinds, *self.kinds] if anew else kinds

    def look(self, kinds: Sequence[str]) -> dict[str, list[ZoomExample]]:
        """Look at all pictures of some kinds, on the processors of the settings.

        Args:
            kinds: names of the kinds.

        Returns:
            The looks by kind, of pictures with closer looks.
        """
        tasks = [(kind, index) for kind in dict.fromkeys(kinds) for index in range(len(self.pictures[kind]))]
        # Workers store their looks themselves, unless they are on another machine.
        done = run_tasks(
            _look,
            tasks,
            where=self.config.where,
            make=type(self),
            settings=(self.config,),
            title="looking",
            unit="picture",
        )
        with closing(done):
            for (kind, index), looks in done:
                digest = self.pictures[kind].digest(index)
                if looks and self.store.read(digest) is None:
                    self.store.write(digest, unpack_tensors(looks))
        # After work in other processes this one still has all its threads, on which results depend.
        prepare_worker()
        return {kind: self._examples(kind) for kind in kinds}

    def _examples(self, kind: str) -> list[ZoomExample]:
        """Collect the looks at the pictures of a kind that have closer looks."""
        pictures = self.pictures[kind]
        least = self.eye.detector.score_threshold
        return [
            ZoomExample.of(pictures, index, looks, least)
            for index, looks in enumerate(self.opened(kind))
            if looks.lattice.levels > 1
        ]

    def _seed(self) -> None:
        """Seed the random generators of a part."""
        torch.manual_seed(self.config.seed)
        random.seed(self.config.seed)

    def fit_prediction(self, examples: Mapping[str, list[ZoomExample]]) -> GlimpseEvidence:
        """Fit the numbers of objects of each class that smaller windows show; examples by kind."""
        self._seed()
        metadata = {**self.eye.settings(), **training_of(self.config, self.mosaics["near"], "judged")}
        model = GlimpseEvidence(len(self.eye.detector.classes), metadata=metadata)
        training = [example for kind in ("near", "far", *self.kinds) for example in examples[kind]]
        fit_rates(model, training, self.config.steps)
        return model.eval().requires_grad_(False)

    def fit_survey(self, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> list[str]:
        """Fit the numbers of objects of any class that smaller windows show; returns lines of Markdown."""
        self._seed()
        # A new one, since a fit may be repeated with a model that has one.
        survey = Survey(model.classes, foresight=model.survey.foresight)
        training = [example for kind in ("near", "far", "crowded") for example in examples[kind]]
        fit_survey(survey, training, self.config.survey_steps)
        model.survey = survey.eval().requires_grad_(False)
        return []

    def search(self, model: GlimpseEvidence) -> dict[str, list[MosaicSearch]]:
        """Search pictures to fit decisions on (`searched`), and pictures to choose thresholds on (`judged`)."""
        prepare_worker()
        searched: dict[str, list[MosaicSearch]] = {}
        for use, kinds in self._searched().items():
            searched[use] = []
            for kind in kinds:
                title = f"searching, {kind}"
                searched[use] += search_pictures(model, self.pictures[kind], self.opened(kind), self.config, title)
        return searched

    def fit_decisions(self, model: GlimpseEvidence, searched: Mapping[str, Sequence[MosaicSearch]]) -> list[str]:
        """Fit the decisions of searches: the probability of presence, and thresholds; returns lines of Markdown."""
        searches = {use: WindowSearches.of(of_use, self.config.passes) for use, of_use in searched.items()}
        fit_presence(model, searches["searched"])
        rows = judge_searches(model, searches["judged"], self.config)
        assert model.thresholds is not None
        try:
            report = choose_places(model, searched["judged"], self.config)
        finally:
            # Looks of a fit that was stopped are those of the next.
            for search in searched["judged"]:
                search.source.save()
        return [
            f"The probability that a picture contains the target was fitted on {len(searches['searched'].there)} "
            f"searches, about half of them for absent classes, and evaluated on {len(searches['judged'].there)} "
            "searches in pictures of held-out photographs.",
            "",
            *rows,
            "",
            f"Thresholds: a target counts as found from a probability of {model.thresholds.confirm:.2f} on. The search "
            f"gives up when the best remaining look has a value below {model.thresholds.stop_below:g}.",
            "",
            "Closer looks:",
            "",
            *report,
        ]

    def fit_certainty(self, model: GlimpseEvidence) -> list[str]:
        """Fit the probability that an object is there, and the spread of expected numbers; returns lines."""
        prepare_worker()
        searched = self._searched()
        fitted = self._explored([*searched["searched"], *self.config.some_explored])
        judged = self._explored(searched["judged"])
        return fit_certainty(model, fitted, judged, passes=self.config.passes)

    def _explored(self, kinds: Sequence[str]) -> dict[str, tuple[Scenes, list[StoredWindowLooks]]]:
        """Collect the pictures of kinds with the looks at those of them that are explored: of some kinds the first."""
        explored = {}
        for kind in kinds:
            count = self.config.some_explored.get(kind)
            explored[kind] = (self.pictures[kind], self.opened(kind)[:count])
        return explored

    def _searched(self) -> dict[str, tuple[str, ...]]:
        """List the kinds of pictures to fit decisions on, and to choose thresholds on."""
        of_held_out = (f"judged {kind}" for kind in self.kinds)
        return {"searched": ("searched", *self.kinds), "judged": ("judged", *of_held_out)}


def measure_table(figures: Mapping[str, float]) -> list[str]:
    """Make a table of measures by name, in lines of Markdown."""
    return table([["measure", "value"], *([name, f"{value:.4f}"] for name, value in figures.items())])
