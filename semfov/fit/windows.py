"""Fit evidence by magnification on mosaics of photographs, and on other kinds of large pictures."""

from __future__ import annotations

import json
import logging
import math
import random
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from statistics import median
from typing import Any, ClassVar

import numpy as np
import torch

from semfov.belief.verification import Verification
from semfov.data.mosaics import Mosaics
from semfov.data.scattered import Scattered
from semfov.data.scene import ChosenScenes, Scenes
from semfov.errors import check
from semfov.fit.detector_report import Difference, in_words, mean_percent, section
from semfov.fit.outputs import training_of
from semfov.fit.part import PartFit, PartInputs, PartResult
from semfov.fit.photographs import fit_photographs
from semfov.fit.verification import mean_of
from semfov.fit.windows_certainty import certainty_again, spread_again
from semfov.fit.windows_decision import Searches, fit_closer, fit_judge, judge_searches, picture_searches
from semfov.fit.windows_evidence import (
    SurveyExample,
    ZoomExample,
    example_of,
    fit_presence,
    fit_rates,
    fit_survey,
    judge_survey,
    pair_windows,
    presence_log_odds,
    presence_loss,
    rate_loss,
    windows_of,
)
from semfov.fit.windows_settings import PICTURE_KINDS, FitZoomConfig, PictureKind
from semfov.io.files import json_sha256
from semfov.io.manifest import Part
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.metrics.averages import FloatArray
from semfov.runs.config import SensorConfig
from semfov.runs.looks import one_thread
from semfov.runs.scene_run import store_folder
from semfov.runs.setup import make_detector, make_scenes, split_photographs
from semfov.runs.tables import table
from semfov.runs.window_looking import found_in
from semfov.runs.workers import prepare_worker, run_tasks
from semfov.runs.zoom_store import GlanceStore, StoredGlances
from semfov.zoom.episode import WindowStep, find_everything, look_by_look
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye
from semfov.zoom.glances import Glance, Glances
from semfov.zoom.networks import Survey
from semfov.zoom.slices import ranked, usual_slices


def _crowded(scenes: Scenes, share: float) -> ChosenScenes:
    """The given share of a set's scenes, those with the most objects; among equals the first scenes count."""
    check(0 < share <= 1, "share", "above 0 and at most 1", share)
    check(len(scenes) > 0, "scenes", "at least one scene", len(scenes))
    counts = [len(scenes.annotation(index).boxes) for index in range(len(scenes))]
    order = sorted(range(len(scenes)), key=lambda index: -counts[index])
    chosen = sorted(order[: math.ceil(share * len(scenes))])
    ids: list[int] | list[str] = [scenes.ids[index] for index in chosen]  # type: ignore[assignment]
    return ChosenScenes([(scenes, index) for index in chosen], ids, json_sha256([scenes.fingerprint, ids]))


_OTHER = ("kinds", "each", "judged_each", "tile", "seed")
"""Settings of the pictures that are no mosaics."""

_DECIDING = ("searched", "judged", "sought", "passes", "judging", "false_alarms", "surest", "lost", *_OTHER)
"""Settings that the thresholds and the probability of presence depend on."""

_VERIFYING = ("searched", "judged", "sought", "passes", "place", "false_alarms", "surest", *_OTHER)
"""Settings that the verification depends on."""

_COUNTING = ("searched", "far", "judged", "passes", *_OTHER)
"""Settings that the certainty and the spread depend on."""

_SURVEYING = ("mosaics", "far", "crowded", "judged", "judged_far", "survey_steps", "tile", "seed")
"""Settings that the survey depends on."""

_log = logging.getLogger(__name__)


def _compose_pictures(kind: PictureKind, scenes: Scenes, count: int, seed: int, tile: int = 480) -> Scenes:
    """Compose pictures of a kind."""
    seed += 10 + PICTURE_KINDS.index(kind)
    half, ground = (tile // 2, tile * 3 // 8), (8 * tile, 9 * tile // 2)
    match kind:
        case "few":
            return Mosaics(scenes, 3, 3, tile=(tile, tile * 3 // 4), count=count, seed=seed)
        case "many":
            return Mosaics(scenes, 12, 12, tile=half, count=count, seed=seed)
        case "one class":
            return Mosaics(scenes, 8, 6, tile=half, alike=True, count=count, seed=seed)
        case "photographs":
            sides = tile // 5, tile
            return Scattered(scenes, whole=True, size=ground, sides=sides, most=8, count=count, seed=seed)
        case "objects":
            return Scattered(scenes, size=ground, sides=(tile // 15, tile // 3), count=count, seed=seed)


def _look(fit: MosaicFit, task: tuple[str, int]) -> bytes:
    """Look at all windows of a picture that are not in the store yet; returns what the store has of it."""
    kind, index = task
    pictures = fit.pictures[kind]
    glances = StoredGlances(fit.eye, pictures, index, fit.store)
    glances.see(windows_of(pictures, index, glances.lattice))
    glances.save()
    kept = fit.store.read(pictures.digest(index))
    return b"" if kept is None else pack_tensors(kept)


class MosaicFit:
    """A fit of evidence part by part, with the mosaics and other pictures, and the store of the looks at them."""

    def __init__(self, config: FitZoomConfig, eye: WindowEye | None = None) -> None:
        if eye is None:
            eye = WindowEye(make_detector(config.detector)).eval().requires_grad_(False)
        self.config, self.eye = config, eye
        training, held_out = split_photographs(config.data, eye.detector.classes, config.holdout)
        tile, half = (config.tile, config.tile * 3 // 4), (config.tile // 2, config.tile * 3 // 4 // 2)
        most, most_held = _crowded(training, 1 / 3), _crowded(held_out, 1 / 3)
        seed = config.seed
        self.mosaics = {
            "near": Mosaics(training, 4, 4, tile=tile, count=config.mosaics, seed=seed),
            "far": Mosaics(training, 8, 6, tile=tile, count=config.far, seed=seed + 1),
            "small": Mosaics(training, 12, 12, tile=half, count=config.far, seed=seed + 7),
            "judged": Mosaics(held_out, 4, 4, tile=tile, count=config.judged, seed=seed + 2),
            "judged far": Mosaics(held_out, 8, 6, tile=tile, count=config.judged_far, seed=seed + 3),
            "searched": Mosaics(training, 4, 4, tile=tile, count=config.searched, seed=seed + 4),
            "crowded": Mosaics(most, 4, 4, tile=tile, count=config.crowded, seed=seed + 5),
            "judged crowded": Mosaics(most_held, 4, 4, tile=tile, count=config.judged, seed=seed + 6),
        }
        self.pictures: dict[str, Scenes] = {**self.mosaics}
        for kind in PICTURE_KINDS:
            self.pictures[kind] = _compose_pictures(kind, training, config.each, seed, config.tile)
            self.pictures[f"judged {kind}"] = _compose_pictures(
                kind, held_out, config.judged_each, seed + 20, config.tile
            )
        self.store = GlanceStore(store_folder(config.cache) / "glances", eye.settings(), len(eye.detector.classes))

    def opened(self, kind: str) -> list[StoredGlances]:
        """The stored looks at each picture of a kind."""
        pictures = self.pictures[kind]
        return [StoredGlances(self.eye, pictures, index, self.store) for index in range(len(pictures))]

    def look(self, kinds: Sequence[str]) -> dict[str, list[ZoomExample]]:
        """Look at all pictures of some kinds; returns the looks by kind, of pictures with closer looks."""
        todo = [(kind, n) for kind in dict.fromkeys(kinds) for n in range(len(self.pictures[kind]))]
        config, store = self.config, self.store
        done = run_tasks(
            _look, todo, where=config.where, make=MosaicFit, settings=(config,),
            title="looking", unit="picture",
        )  # fmt: skip
        with closing(done):
            for (kind, index), looks in done:
                digest = self.pictures[kind].digest(index)
                if looks and store.read(digest) is None:
                    store.write(digest, unpack_tensors(looks))
        prepare_worker()
        least = self.eye.detector.least
        return {
            kind: [
                example_of(self.pictures[kind], n, looks, least)
                for n, looks in enumerate(self.opened(kind))
                if looks.lattice.levels > 1
            ]
            for kind in kinds
        }

    def training(self, examples: Mapping[str, list[ZoomExample]]) -> list[ZoomExample]:
        """Looks at the mosaics and the other pictures on which predictions of closer looks are fitted."""
        return [each for kind in ("near", "far", *self.config.kinds) for each in examples[kind]]

    def closer(self, examples: Mapping[str, list[ZoomExample]]) -> GlimpseEvidence:
        """Fit the prediction of closer looks, class by class."""
        config = self.config
        torch.manual_seed(config.seed)
        random.seed(config.seed)
        metadata = {**self.eye.settings(), **training_of(config, self.mosaics["near"], "judged")}
        model = GlimpseEvidence(len(self.eye.detector.classes), metadata=metadata)
        looks = self.training(examples)
        fit_presence(model, pair_windows(looks), config.steps)
        fit_rates(model, looks, config.steps)
        return model.eval().requires_grad_(False)

    def survey(self, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> dict[str, float]:
        """Fit a new survey; returns its measures on the held-out mosaics that were looked at."""
        config = self.config
        torch.manual_seed(config.seed)
        random.seed(config.seed)
        survey = Survey(model.classes, foresight=model.survey.foresight)
        kinds = {
            kind: [SurveyExample.of(example) for example in examples[kind]]
            for kind in ("near", "far", "crowded", "judged", "judged crowded")
            if kind in examples
        }
        fit_survey(survey, kinds["near"] + kinds["far"] + kinds["crowded"], config.survey_steps)
        model.survey = survey.eval().requires_grad_(False)
        self._told(model, "survey", _SURVEYING)
        crowded = judge_survey(survey, kinds["judged crowded"]) if "judged crowded" in kinds else {}
        return {**judge_survey(survey, kinds["judged"]), **{f"{name}, crowded": n for name, n in crowded.items()}}

    def decisions(self, model: GlimpseEvidence) -> list[str]:
        """Fit the decisions of searches: the probability of presence, and the thresholds."""
        config = self.config
        prepare_worker()
        torch.manual_seed(config.seed)
        searches = {
            use: Searches.join(
                [
                    picture_searches(model, self.pictures[kind], self.opened(kind), config, f"searching, {kind}")
                    for kind in kinds
                ]
            )
            for use, kinds in self._searched().items()
        }
        fit_judge(model, searches["searched"], config.judging)
        rows = judge_searches(model, searches["judged"], config)
        assert model.thresholds is not None
        self._told(model, "decision", _DECIDING)
        fitted, held_out = (len(searches[kind].there) for kind in ("searched", "judged"))
        return [
            f"The probability that a picture contains the target was fitted on {fitted} searches, about half of them "
            f"for absent classes, and evaluated on {held_out} searches in pictures of held-out photographs.",
            "",
            *rows,
            "",
            f"Thresholds: a target counts as found from a probability of {model.thresholds.confirm:.2f} on. The search "
            f"gives up when the best remaining look has a value below {model.thresholds.give_up:g}.",
            "",
        ]

    def verification(self, model: GlimpseEvidence, prior: Verification | None = None) -> list[str]:
        """Fit the probabilities after closer looks, with decisions that were fitted, and a prior."""
        prepare_worker()
        searched = {
            use: [(self.pictures[kind], self.opened(kind)) for kind in kinds] for use, kinds in self._searched().items()
        }
        text = fit_closer(model, searched, self.config, prior)
        if model.verification is not None:
            self._told(model, "verification", _VERIFYING)
        return ["Closer looks:", "", text]

    def certainty(self, model: GlimpseEvidence) -> list[str]:
        """Fit the probability that an object is there, and the spread of expected numbers."""
        prepare_worker()
        training, held_out = self._explored()
        lines = certainty_again(model, training, held_out, passes=self.config.passes)
        self._told(model, "certainty", _COUNTING)
        return lines

    def spread(self, model: GlimpseEvidence) -> list[str]:
        """Fit the spread of expected numbers alone."""
        prepare_worker()
        lines = spread_again(model, self._explored()[0], passes=self.config.passes)
        self._told(model, "spread", _COUNTING)
        return lines

    def _explored(self) -> list[dict[str, tuple[Scenes, list[StoredGlances]]]]:
        """Pictures to fit the certainty on, and to evaluate it on, by kind, with their looks."""
        fitted, judged = self._searched().values()
        some = _some_explored(self.config.searched)
        return [
            {kind: (self.pictures[kind], self.opened(kind)[: some.get(kind)]) for kind in dict.fromkeys(kinds)}
            for kinds in ((*fitted, *some), judged)
        ]

    def _searched(self) -> dict[str, tuple[str, ...]]:
        """Kinds of pictures to fit decisions on, and to choose thresholds on."""
        kinds = self.config.kinds
        return {"searched": ("searched", *kinds), "judged": ("judged", *(f"judged {kind}" for kind in kinds))}

    def _told(self, model: GlimpseEvidence, part: str, settings: Sequence[str]) -> None:
        """Note in the model the settings that a part depends on."""
        model.metadata[part] = {name: getattr(self.config, name) for name in settings}


def _some_explored(searched: int) -> dict[str, int]:
    """Number of explored mosaics that have three and nine times as many photographs, for so many others."""
    return {"far": max(1, searched // 5), "small": max(1, searched // 10)}


@torch.no_grad()
def judge_windows(model: GlimpseEvidence, examples: list[ZoomExample]) -> tuple[str, str]:
    """Evaluate the model on held-out mosaics."""
    windows = pair_windows(examples)
    first, later = (windows.before < 0).nonzero()[:, 0], (windows.before >= 0).nonzero()[:, 0]
    figures: dict[str, float] = {"cross-entropy, overview": float(presence_loss(model, windows, first))}
    if len(later):
        figures["cross-entropy, closer looks"] = float(presence_loss(model, windows, later))
        figures["the same windows by the overview"] = float(presence_loss(model, windows, windows.before[later]))
    slots = first[windows.slot[first]]
    odds, presence = presence_log_odds(model, windows, slots), windows.presence[slots]
    passes: dict[str, list[int]] = defaultdict(list)
    for mosaic in windows.mosaic[slots].unique():
        here = windows.mosaic[slots] == mosaic
        for target in presence[here].any(0).nonzero()[:, 0].tolist():
            hits = presence[here, target]
            for name, value in (("evidence", odds), ("raw score", windows.scores[slots])):
                order = value[here, target].argsort(descending=True, stable=True)
                passes[name].append(2 + int(hits[order].int().argmax()))
    for name, counts in passes.items():
        figures[f"passes to the first hit, {name}"] = sum(counts) / len(counts)
    losses = torch.stack([rate_loss(model, example) for example in examples])
    figures["rates, mean negative log likelihood"] = float(losses.mean())
    lines = [f"Evaluation on {len(examples)} mosaics of held-out photographs:", ""]
    lines += [*measures_table(figures), ""]
    return "\n".join(lines), json.dumps(figures, indent=1)


def measures_table(figures: Mapping[str, float]) -> list[str]:
    """Write measures as a table in Markdown."""
    return table([["measure", "value"], *([name, f"{value:.4f}"] for name, value in figures.items())])


_ENOUGH = 16
"""Smallest number of held-out photographs, with which a mosaic shows none of them twice."""
_RECALL_PASSES = (4, 8, 16)
"""Passes of the detector after which recall is reported."""
_OF_INPUT = 1.15
"""Largest width of a photograph in a mosaic, in widths of the detector's input: as in the fits of shipped models."""
_FOR_MOSAICS = 360
"""The number of mosaics grows up to this number of photographs to learn from."""
_ALONE = 120
"""Largest number of photographs that are searched by themselves."""
_LOOK = 0.04
"""Estimate of the seconds of a pass of the detector."""

_Way = Callable[[Glances], Iterator[WindowStep[Any]]]
"""A way of looking for all objects of a picture."""


@dataclass(frozen=True)
class _LeftOut:
    """Settings of evidence that is not fitted."""

    why: str


class WindowsFit(PartFit):
    """Fit evidence by magnification on mosaics of the photographs, with its decisions."""

    name: ClassVar[str] = "windows"

    def __init__(self, inputs: PartInputs) -> None:
        super().__init__(inputs)
        photographs, held_out = len(self.run.scenes), len(inputs.held_out)
        why = None
        if not self.config.windows:
            why = "not fitted, since the setting `windows` is false"
        elif held_out < _ENOUGH:
            why = (
                f"not fitted, since mosaics need at least {_ENOUGH} held-out photographs, and {held_out} of the "
                f"{photographs} photographs are held out"
            )
        self.settings: FitZoomConfig | _LeftOut
        if why is not None:
            self.settings, self.tasks = _LeftOut(why), {}
            return
        self.settings = config = self.mosaics(photographs)
        sets = {"searched": config.searched, "judged": config.judged}
        self.tasks = {
            "looking": 60 * _LOOK * (config.mosaics + config.crowded + config.judged + 4 * config.far),
            "learning what closer looks show": 0.1 * config.steps,
            "learning the expected number of objects": 0.2 * config.steps,
            "learning the survey": 0.4 * config.survey_steps,
            **{f"searching, {kind}": 4 * count for kind, count in sets.items()},
            "fitting decisions": 0.01 * config.judging,
            "looking closely": 4 * config.searched,
            "looking closely at held-out pictures": 4 * config.judged,
            "looking at photographs": 25 * _LOOK * config.photographs,
            **{f"exploring, {kind}": 2 * count for kind, count in (sets | _some_explored(config.searched)).items()},
        }

    def mosaics(self, photographs: int) -> FitZoomConfig:
        """Return the settings for so many photographs; each to learn from is in about four mosaics, unless many are."""
        own, held_out = self.config, -(-photographs // (self.config.holdout or 5))
        training = min(photographs - held_out, _FOR_MOSAICS)
        # The photographs are not enlarged.
        sizes = [self.run.scenes.annotation(index).size for index in range(len(self.run.scenes))]
        width = min(
            median(max(width, height * 4 / 3) for width, height in sizes),
            _OF_INPUT * self.run.eye.detector.input_size[0],
        )
        return self.inputs.settings(
            FitZoomConfig,
            sensor=SensorConfig(),
            mosaics=max(1, training // 5),
            far=max(1, training // 60),
            crowded=max(1, training // 10),
            judged=max(8, min(held_out // 3, 30)),
            judged_far=1,
            kinds=(),
            searched=max(8, training // 12),
            sought=3,
            passes=16,
            photographs=min(photographs, _ALONE),
            tile=max(16, round(width)),
            steps=own.window_steps,
            survey_steps=own.window_steps,
        )

    def fit(self) -> PartResult:
        """Fit, and compare the objects found with those of slices in the order of the overview's scores."""
        config = self.settings
        if isinstance(config, _LeftOut):
            return PartResult(Part(None, None, False, config.why), f"{config.why.capitalize()}.")
        with one_thread():
            return self._fit(config)

    def _fit(self, config: FitZoomConfig) -> PartResult:
        fit = MosaicFit(config, WindowEye(self.run.eye.detector).eval().requires_grad_(False))
        model, figures = _fit_mosaics(fit)
        judged, opened = fit.mosaics["judged"], fit.opened("judged")
        curves = {
            "fitted": _photograph_recalls(judged, opened, lambda glances: find_everything(glances, model)),
            "raw": _photograph_recalls(judged, opened, _in_raw_order),
        }
        gain = Difference.of(curves["fitted"].mean(1), curves["raw"].mean(1))
        at = _RECALL_PASSES[-1] - 1
        why = (
            f"{100 * curves['fitted'][:, at].mean():.1f} % of the objects are found in {_RECALL_PASSES[-1]} passes, "
            f"{100 * curves['raw'][:, at].mean():.1f} % in slices in the order of raw scores; on average over the "
            f"passes {in_words(gain, 'points gained', 100)}"
        )
        rows = [["looks", *(f"after {n} passes" for n in _RECALL_PASSES), "mean"]]
        rows += [
            [name, *(mean_percent(curve[:, n - 1]) for n in _RECALL_PASSES), mean_percent(curve.mean(1))]
            for name, curve in curves.items()
        ]
        text = section(
            f"Objects found in {len(judged)} mosaics of {len(judged.tiles(0))} held-out photographs, in % of the "
            f"objects of each photograph, and the mean over 1 to {_RECALL_PASSES[-1]} passes. `raw` looks at slices in "
            "the order of the sums of the overview's raw scores, as the agent does without this part.",
            rows,
        )
        return PartResult(self.write(model, gain.better, why), "\n".join([text, figures]))


def _fit_mosaics(fit: MosaicFit) -> tuple[GlimpseEvidence, str]:
    """Look at the mosaics, and fit the evidence, its decisions, closer looks and expected numbers."""
    examples = fit.look(("near", "far", "crowded", "judged"))
    model = fit.closer(examples)
    fit.survey(model, examples)
    lines = [judge_windows(model, examples["judged"])[0], *fit.decisions(model)]
    shipped = [
        GlimpseEvidence.from_pretrained(file.stem) for file in sorted(GlimpseEvidence.shipped.glob("*.safetensors"))
    ]
    lines += fit.verification(model, mean_of([each.verification for each in shipped if each.verification is not None]))
    lines += fit.certainty(model)
    alone = [each.photograph.verification for each in shipped if each.photograph is not None]
    scenes = make_scenes(fit.config.data, fit.eye.detector.classes)
    lines += ["Photographs:", "", fit_photographs(model, scenes, fit.eye, fit.config, mean_of(alone))]
    return model, "\n".join(lines)


def _in_raw_order(glances: Glances) -> Iterator[WindowStep[Any]]:
    """Look at slices in the order of the overview's scores, as an agent without evidence does."""
    return look_by_look(glances, ranked(usual_slices(glances.lattice)), None)


@torch.inference_mode()
def _photograph_recalls(mosaics: Mosaics, opened: Sequence[StoredGlances], way: _Way) -> FloatArray:
    """Measure the recall in each photograph of some mosaics after each pass; → `(P, 16)`."""
    hits, there = np.zeros((len(mosaics.scenes), _RECALL_PASSES[-1])), np.zeros(len(mosaics.scenes))
    for index, glances in enumerate(opened):
        tiles, annotation = mosaics.tiles(index), mosaics.annotation(index)
        photograph = np.repeat(
            [tile.scene for tile in tiles], [len(mosaics.scenes.annotation(tile.scene).boxes) for tile in tiles]
        )
        np.add.at(there, photograph, 1)
        history: list[Glance] = []
        turns = way(glances)
        for number in range(_RECALL_PASSES[-1]):
            turn = next(turns, None)
            if turn is not None:
                history.append(turn.glance)
            np.add.at(hits[:, number], photograph, found_in(history, annotation).numpy())
        glances.save()
    return hits[there > 0] / there[there > 0, None]
