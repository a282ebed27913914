"""Fit evidence by magnification on mosaics of photographs, and on other kinds of large pictures."""

import math
import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from functools import partial
from itertools import islice
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.mosaics import Mosaics
from semfov.data.scene import Annotation, ChosenScenes, Scenes
from semfov.decision import OUTCOMES, SAME, settle
from semfov.errors import check
from semfov.fit.evidence import choose_thresholds
from semfov.fit.searches import TargetSearch
from semfov.fit.training import descend, training_of
from semfov.fit.verification import choose_confirm, examine, fit, verification_report, verify
from semfov.fit.windows_certainty import certainty_again
from semfov.fit.windows_evidence import SurveyExample, ZoomExample, fit_presence, fit_rates, fit_survey, pair_windows
from semfov.fit.windows_settings import FitMosaicsConfig
from semfov.io.files import json_sha256
from semfov.io.storage import pack_tensors, unpack_tensors
from semfov.metrics.calibration import BinarySums
from semfov.metrics.episodes import area_under_roc
from semfov.observation.matching import box_iou
from semfov.runs.progress import track
from semfov.runs.protocols import choose_classes
from semfov.runs.scene_run import store_folder
from semfov.runs.setup import make_detector, split_photographs
from semfov.runs.tables import table
from semfov.runs.workers import prepare_worker, run_tasks
from semfov.runs.zoom_store import StoredWindowLooks, WindowLookStore
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.closer import CandidateBoxes, SearchLook, look_closely
from semfov.zoom.decision import SearchFacts
from semfov.zoom.episode import WindowStep, look_for
from semfov.zoom.evidence import GlimpseEvidence, Survey
from semfov.zoom.eye import WindowEye
from semfov.zoom.looks import WindowLook

_JUDGED = (1, 4, 8, 16)  # numbers of looks after which the probability of presence is evaluated


class _Searches(NamedTuple):
    """E searches of n looks; one that ends early is padded with its last values, and with 0 for `left`."""

    best: Tensor  # (E, n)
    case: Tensor  # (E, n, 10)
    looked: Tensor  # (E, n)
    left: Tensor  # (E, n)
    there: Tensor  # (E,)


@torch.inference_mode()
def _searches_of(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredWindowLooks], config: FitMosaicsConfig, title: str
) -> Iterator[tuple[int, Annotation, int, Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]]]:
    """Search every picture for some present classes and for as many absent ones, without decisions."""
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        for target in choose_classes(pictures, index, annotation, config.sought, 1.0, config.seed):
            steps = islice(look_for(looks, model, target), config.passes)
            yield index, annotation, target, _with_facts(steps)
        looks.save()


def _with_facts(steps: Iterable[WindowStep[ZoomBelief]]) -> Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]:
    """The turns of a search, each with the facts about the search after it."""
    facts: SearchFacts | None = None
    for step in steps:
        facts = facts or SearchFacts(step.belief)
        facts.add(step.look)
        yield step, facts


@torch.inference_mode()
def _picture_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredWindowLooks], config: FitMosaicsConfig, title: str
) -> _Searches:
    """Run all searches of `_searches_of`, and collect them."""
    rows: list[list[Tensor]] = []
    for _, annotation, target, window_steps in _searches_of(model, pictures, opened, config, title):
        steps = [(facts.best, facts.case(step.ahead), facts.detected, step.ahead) for step, facts in window_steps]
        steps += [(*steps[-1][:3], 0.0)] * (config.passes - len(steps))
        best, case, looked, left = zip(*steps, strict=True)
        there = torch.tensor(bool((annotation.labels == target).any()))
        rows.append([torch.tensor(best), torch.stack(case), torch.tensor(looked), torch.tensor(left), there])
    return _Searches(*(torch.stack(column) for column in zip(*rows, strict=True)))


def _fit_judge(model: GlimpseEvidence, searches: _Searches, steps: int, batch: int = 4096) -> None:
    """Fit the probability that a picture contains the target, by the cross-entropy after all looks of all searches."""
    best, case = searches.best.flatten(), searches.case.flatten(0, 1)
    there = searches.there[:, None].expand_as(searches.best).flatten().float()

    def loss_of(_: int) -> Tensor:
        rows = torch.randint(len(best), (min(batch, len(best)),))
        return F.binary_cross_entropy_with_logits(model.anywhere(best[rows], case[rows]), there[rows])

    model.judge.requires_grad_(True)
    descend(model.judge.parameters(), loss_of, steps, 1e-2, decay=1.0, title="fitting decisions")
    model.judge.requires_grad_(False)


@torch.no_grad()
def _judge_searches(model: GlimpseEvidence, searches: _Searches, bounds: Any) -> list[str]:
    """Evaluate the probability of presence on held-out searches, and set the model's thresholds by them."""
    anywhere = model.anywhere(searches.best, searches.case).sigmoid()
    there = searches.there
    chosen = choose_thresholds(bounds, anywhere.mT, searches.looked.mT.to(anywhere), searches.left.mT, there)
    # The place is known as soon as a detection shows the target; there is no probability to put a threshold on.
    model.thresholds = chosen.changed(place=0.0)
    rows = [["looks", "area under ROC", "NLL", "Brier", "ECE", "ECE of the highest score"]]
    last = anywhere.shape[1]
    for number in sorted({last, *(each for each in _JUDGED if each < last)}):
        presence = BinarySums.of(anywhere[:, number - 1], there)
        raw = BinarySums.of(searches.best[:, number - 1], there)
        area = area_under_roc(anywhere[:, number - 1], there) if bool(there.any() and not there.all()) else float("nan")
        measures = (presence.nll, presence.brier, presence.ece, raw.ece)
        rows.append([str(number), f"{area:.3f}", *(f"{measure:.3f}" for measure in measures)])
    return table(rows)


class _MosaicSearch(TargetSearch[SearchLook]):
    """A search of a mosaic; objects `(M, 4)`, boxes `(4,)`."""

    after = (1, 3, 5, 8, 12, 16, 24)

    def __init__(
        self,
        mosaic: int,
        looks: StoredWindowLooks,
        target: int,
        objects: Tensor,
        passes: int,
        likely: float,
        steps: Iterable[tuple[WindowStep[ZoomBelief], SearchFacts]],
    ) -> None:
        self.picture, self.target, self.present, self.passes = mosaic, target, len(objects) > 0, passes
        self.candidates = partial(CandidateBoxes, target, likely)
        self.close_up = lambda box: look_closely(looks, box).detections
        self.looks, self.objects, self.steps = looks, objects, list[SearchLook]()
        self.window_looks, self.boxes = list[WindowLook](), list[Tensor | None]()
        for number, (step, facts) in enumerate(steps, 1):
            presence = facts.presence(step.ahead)
            self.steps.append(SearchLook(step.look.detections, number, presence, facts.best, step.ahead))
            self.window_looks.append(step.look)
            self.boxes.append(facts.box if facts.detected else None)

    def look(self, index: int, number: int) -> SearchLook:
        """Return a look with the number of looks up to it."""
        return self.steps[index]._replace(number=number)

    def right(self, box: Tensor) -> bool:
        """Whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.objects).max()) >= SAME

    def decided(self, index: int, thresholds: Thresholds) -> tuple[int, bool | None]:
        """The outcome by the evidence alone; the place is that of the box with the highest score."""
        state, box = self.steps[index], self.boxes[index]
        presence, looked, left = (torch.tensor([each]) for each in (state.presence, box is not None, state.left))
        outcome = int(settle(presence, looked, left, thresholds))
        if OUTCOMES[outcome] != "found":
            return outcome, None
        assert box is not None
        return outcome, self.right(box)


@torch.inference_mode()
def _mosaic_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredWindowLooks], config: FitMosaicsConfig, title: str
) -> Iterator[_MosaicSearch]:
    """Search every picture, without closer looks (`_searches_of`)."""
    assert model.thresholds is not None
    for index, annotation, target, steps in _searches_of(model, pictures, opened, config, title):
        objects = annotation.boxes[annotation.labels == target]
        yield _MosaicSearch(index, opened[index], target, objects, config.passes, model.thresholds.confirm, steps)


def _fit_closer(
    model: GlimpseEvidence,
    pictures: Mapping[str, Sequence[tuple[Scenes, Sequence[StoredWindowLooks]]]],
    config: FitMosaicsConfig,
    prior: Verification | None = None,
) -> str:
    """Fit the verification on some pictures, choose its threshold on held-out ones, and add it to the model."""
    searches = {
        use: [
            search
            for scenes, opened in pictures[use]
            for search in _mosaic_searches(model, scenes, opened, config, title)
        ]
        for use, title in (("searched", "looking closely"), ("judged", "looking closely at held-out pictures"))
    }
    training, held_out = (examine(searches[use]) for use in ("searched", "judged"))
    looks_of = [looks for kinds in pictures.values() for _, opened in kinds for looks in opened]
    for looks in looks_of:
        looks.save()
    model.verification = None
    if training is None or held_out is None:
        return "None, since there are no places that hold the target, or none that do not.\n"
    fitted = fit(training, training.fold == 0, prior)
    assert model.thresholds is not None
    limits = Thresholds(1.0, model.thresholds.give_up, config.place)
    decisions = list(verify(searches["judged"], [fitted], limits, model.thresholds))
    confirm = choose_confirm(decisions, config.false_alarms, config.surest)
    fitted.thresholds = Thresholds(confirm, model.thresholds.give_up, config.place)
    model.verification = fitted
    for looks in looks_of:
        looks.save()
    how = f"The model was fitted to {len(training.fold)} closer looks at pictures of other photographs."
    judged = f"{sum(len(opened) for _, opened in pictures['judged'])} pictures of held-out photographs"
    return verification_report(fitted, [fitted], held_out, decisions, judged, how)[0]


def crowded(scenes: Scenes, share: float) -> ChosenScenes:
    """The given share of a set's scenes, those with the most objects; among equals the first scenes count."""
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
    source.see(ZoomExample.windows(pictures, index, source.lattice))
    source.save()
    kept = fit.store.read(pictures.digest(index))
    return b"" if kept is None else pack_tensors(kept)


class MosaicFit:
    """A fit of evidence part by part, with the mosaics, and the store of the looks at them."""

    kinds: tuple[str, ...] = ()
    """Kinds of pictures to fit on beside the mosaics."""

    def __init__(self, config: FitMosaicsConfig, eye: WindowEye | None = None) -> None:
        if eye is None:
            eye = WindowEye(make_detector(config.detector)).eval().requires_grad_(False)
        self.config, self.eye = config, eye
        self.training, self.held_out = split_photographs(config.data, eye.detector.classes, config.holdout)
        half = config.tile // 2, config.tile * 3 // 4 // 2
        self.mosaics = {
            "near": self.mosaic(self.training, 4, 4, config.mosaics, 0),
            "far": self.mosaic(self.training, 8, 6, config.far, 1),
            "small": Mosaics(self.training, 12, 12, tile=half, count=config.far, seed=config.seed + 7),
            "judged": self.mosaic(self.held_out, 4, 4, config.judged, 2),
            "searched": self.mosaic(self.training, 4, 4, config.searched, 4),
            "crowded": self.mosaic(crowded(self.training, 1 / 3), 4, 4, config.crowded, 5),
        }
        self.pictures: dict[str, Scenes] = {**self.mosaics}
        self.store = WindowLookStore(store_folder(config.cache) / "glances", eye.settings(), len(eye.detector.classes))

    def mosaic(self, scenes: Scenes, columns: int, rows: int, count: int, number: int) -> Mosaics:
        """Mosaics of photographs, with the seed of this number."""
        tile = self.config.tile, self.config.tile * 3 // 4
        return Mosaics(scenes, columns, rows, tile=tile, count=count, seed=self.config.seed + number)

    def opened(self, kind: str) -> list[StoredWindowLooks]:
        """The stored looks at each picture of a kind."""
        pictures = self.pictures[kind]
        return [StoredWindowLooks(self.eye, pictures, index, self.store) for index in range(len(pictures))]

    def look(self, kinds: Sequence[str]) -> dict[str, list[ZoomExample]]:
        """Look at all pictures of some kinds; returns the looks by kind, of pictures with closer looks."""
        todo = [(kind, n) for kind in dict.fromkeys(kinds) for n in range(len(self.pictures[kind]))]
        config, store = self.config, self.store
        done = run_tasks(
            _look, todo, where=config.where, make=type(self), settings=(config,),
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
                ZoomExample.of(self.pictures[kind], n, looks, least)
                for n, looks in enumerate(self.opened(kind))
                if looks.lattice.levels > 1
            ]
            for kind in kinds
        }

    def closer(self, examples: Mapping[str, list[ZoomExample]]) -> GlimpseEvidence:
        """Fit the prediction of closer looks, class by class."""
        config = self.config
        torch.manual_seed(config.seed)
        random.seed(config.seed)
        metadata = {**self.eye.settings(), **training_of(config, self.mosaics["near"], "judged")}
        model = GlimpseEvidence(len(self.eye.detector.classes), metadata=metadata)
        looks = [each for kind in ("near", "far", *self.kinds) for each in examples[kind]]
        fit_presence(model, pair_windows(looks), config.steps)
        fit_rates(model, looks, config.steps)
        return model.eval().requires_grad_(False)

    def survey(self, model: GlimpseEvidence, examples: Mapping[str, list[ZoomExample]]) -> None:
        config = self.config
        torch.manual_seed(config.seed)
        random.seed(config.seed)
        survey = Survey(model.classes, foresight=model.survey.foresight)
        looked = [SurveyExample.of(example) for kind in ("near", "far", "crowded") for example in examples[kind]]
        fit_survey(survey, looked, config.survey_steps)
        model.survey = survey.eval().requires_grad_(False)

    def decisions(self, model: GlimpseEvidence) -> list[str]:
        """Fit the decisions of searches: the probability of presence, and the thresholds."""
        config = self.config
        prepare_worker()
        torch.manual_seed(config.seed)
        searches = {}
        for use, kinds in self._searched().items():
            some = (
                _picture_searches(model, self.pictures[kind], self.opened(kind), config, f"searching, {kind}")
                for kind in kinds
            )
            searches[use] = _Searches(*map(torch.cat, zip(*some, strict=True)))
        _fit_judge(model, searches["searched"], config.judging)
        rows = _judge_searches(model, searches["judged"], config)
        assert model.thresholds is not None
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
        return ["Closer looks:", "", _fit_closer(model, searched, self.config, prior)]

    def certainty(self, model: GlimpseEvidence) -> list[str]:
        """Fit the probability that an object is there, and the spread of expected numbers."""
        prepare_worker()
        return certainty_again(model, *self.explored(), passes=self.config.passes)

    def explored(self) -> list[dict[str, tuple[Scenes, list[StoredWindowLooks]]]]:
        """Pictures to fit the certainty on, and to evaluate it on, by kind, with their looks."""
        fitted, judged = self._searched().values()
        some = self.config.some_explored
        return [
            {kind: (self.pictures[kind], self.opened(kind)[: some.get(kind)]) for kind in dict.fromkeys(kinds)}
            for kinds in ((*fitted, *some), judged)
        ]

    def _searched(self) -> dict[str, tuple[str, ...]]:
        """Kinds of pictures to fit decisions on, and to choose thresholds on."""
        judged = (f"judged {kind}" for kind in self.kinds)
        return {"searched": ("searched", *self.kinds), "judged": ("judged", *judged)}
