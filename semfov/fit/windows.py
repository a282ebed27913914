"""Fit evidence by magnification on mosaics of photographs, and on other kinds of large pictures."""

import math
import random
from collections.abc import Mapping, Sequence
from contextlib import closing

import torch

from semfov.belief.verification import Verification
from semfov.data.mosaics import Mosaics
from semfov.data.scene import ChosenScenes, Scenes
from semfov.errors import check
from semfov.fit.training import training_of
from semfov.fit.windows_certainty import certainty_again
from semfov.fit.windows_decisions import WindowSearches, fit_closer_looks, fit_judge, judge_searches
from semfov.fit.windows_evidence import SurveyExample, ZoomExample, fit_rates, fit_survey
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.fit.zoom_store import StoredWindowLooks, WindowLookStore
from semfov.io.files import json_sha256
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.runs.scene_run import store_folder
from semfov.runs.setup import make_detector, split_photographs
from semfov.runs.workers import prepare_worker, run_tasks
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import half_steps
from semfov.zoom.survey import Survey

_CROWDED = 1 / 3  # share of the photographs that the crowded mosaics show, those with the most objects


def crowded(scenes: Scenes, share: float) -> ChosenScenes:
    """Choose the given share of a set's scenes, those with the most objects; among equals the first scenes count."""
    check(0 < share <= 1, "share", "above 0 and at most 1", share)
    check(len(scenes) > 0, "scenes", "at least one scene", len(scenes))
    counts = [len(scenes.annotation(index).boxes) for index in range(len(scenes))]
    order = sorted(range(len(scenes)), key=lambda index: -counts[index])
    chosen = sorted(order[: math.ceil(share * len(scenes))])
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

    Attributes:
        config: the settings.
        eye: looks at windows.
        training: photographs to compose pictures to fit on.
        held_out: photographs to compose pictures to evaluate on.
        mosaics: mosaics by the name of their kind.
        pictures: these and pictures of other kinds.
        store: keeps the looks on disk.
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
        """Fit the numbers of objects of each class that closer looks find; examples by kind."""
        self._seed()
        metadata = {**self.eye.settings(), **training_of(self.config, self.mosaics["near"], "judged")}
        model = GlimpseEvidence(len(self.eye.detector.classes), metadata=metadata)
        training = [example for kind in ("near", "far", *self.kinds) for example in examples[kind]]
        fit_rates(model, training, self.config.steps)
        return model.eval().requires_grad_(False)

    def fit_survey(self, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> None:
        """Fit the numbers of objects of any class that closer looks find; examples by kind."""
        self._seed()
        # A new one, since a fit may be repeated with a model that has one.
        survey = Survey(model.classes, foresight=model.survey.foresight)
        training = [SurveyExample.of(example) for kind in ("near", "far", "crowded") for example in examples[kind]]
        fit_survey(survey, training, self.config.survey_steps)
        model.survey = survey.eval().requires_grad_(False)

    def fit_decisions(self, model: GlimpseEvidence) -> list[str]:
        """Fit the decisions of searches: the probability of presence, and the thresholds; returns lines of Markdown."""
        prepare_worker()
        torch.manual_seed(self.config.seed)
        searches = {
            use: WindowSearches.join(
                WindowSearches.of(model, self.pictures[kind], self.opened(kind), self.config, f"searching, {kind}")
                for kind in kinds
            )
            for use, kinds in self._searched().items()
        }
        fit_judge(model, searches["searched"], self.config.judging)
        rows = judge_searches(model, searches["judged"], self.config)
        assert model.thresholds is not None
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
        ]

    def fit_verification(self, model: GlimpseEvidence, prior: Verification | None = None) -> list[str]:
        """Fit the probabilities after closer looks; returns lines of Markdown.

        Args:
            model: the evidence, with fitted decisions.
            prior: centre of the prior of the parameters.
        """
        prepare_worker()
        pictures = {
            use: [(self.pictures[kind], self.opened(kind)) for kind in kinds] for use, kinds in self._searched().items()
        }
        return ["Closer looks:", "", fit_closer_looks(model, pictures, self.config, prior)]

    def fit_certainty(self, model: GlimpseEvidence) -> list[str]:
        """Fit the probability that an object is there, and the spread of expected numbers; returns lines."""
        prepare_worker()
        fitted, judged = self.explored_pictures()
        return certainty_again(model, fitted, judged, passes=self.config.passes)

    def explored_pictures(self) -> list[dict[str, tuple[Scenes, list[StoredWindowLooks]]]]:
        """Open the pictures to fit the certainty on, and those to evaluate it on, by kind, with their looks."""
        searched = self._searched()
        counts = self.config.some_explored
        return [
            {kind: (self.pictures[kind], self.opened(kind)[: counts.get(kind)]) for kind in dict.fromkeys(kinds)}
            for kinds in ((*searched["searched"], *counts), searched["judged"])
        ]

    def _searched(self) -> dict[str, tuple[str, ...]]:
        """List the kinds of pictures to fit decisions on, and to choose thresholds on."""
        of_held_out = (f"judged {kind}" for kind in self.kinds)
        return {"searched": ("searched", *self.kinds), "judged": ("judged", *of_held_out)}
