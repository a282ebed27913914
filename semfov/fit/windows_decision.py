"""Fit the decisions of searches in large pictures: is the target found or absent, and do closer looks verify it?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.scene import Annotation, Scenes
from semfov.decision import OUTCOMES, SAME, settle
from semfov.fit.descent import descend
from semfov.fit.evidence import Bounds, choose_thresholds
from semfov.fit.searches import TargetSearch
from semfov.fit.verification import VerificationResult, choose_confirm, examine, fit, verification_report, verify
from semfov.fit.windows_settings import FitZoomConfig
from semfov.metrics.calibration import BinarySums
from semfov.metrics.presence import area_under_roc
from semfov.observation.matching import box_iou
from semfov.runs.progress import track
from semfov.runs.search_protocol import choose_classes
from semfov.runs.tables import table
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.closer import CandidateBoxes, WindowLook, look_closely
from semfov.zoom.decision import SearchFacts
from semfov.zoom.episode import WindowStep, look_for
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance

_JUDGED = (1, 4, 8, 16)
"""Numbers of looks after which the probability of presence is evaluated."""


class Searches(NamedTuple):
    """E searches of n looks. A search that ends early is padded with its last values, and with 0 for `left`.

    Shapes: best `(E, n)`, case `(E, n, 10)`, looked `(E, n)`, left `(E, n)`, there `(E,)`.
    """

    best: Tensor
    case: Tensor
    looked: Tensor
    left: Tensor
    there: Tensor

    @classmethod
    def join(cls, searches: Sequence[Searches]) -> Searches:
        """Join several sets of searches."""
        return cls(*map(torch.cat, zip(*searches, strict=True)))


@torch.inference_mode()
def _searches_of(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredGlances], config: FitZoomConfig, title: str
) -> Iterator[tuple[int, Annotation, int, Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]]]:
    """Search every picture for some present classes and for as many absent ones, without decisions."""
    for index, looks in enumerate(track(opened, title, "picture")):
        annotation = pictures.annotation(index)
        for target in choose_classes(pictures, index, annotation, config.sought, 1.0, config.seed):
            turns = islice(look_for(looks, model, target), config.passes)
            yield index, annotation, target, _with_facts(turns)
        looks.save()


def _with_facts(turns: Iterable[WindowStep[ZoomBelief]]) -> Iterator[tuple[WindowStep[ZoomBelief], SearchFacts]]:
    """The turns of a search, each with the facts about the search after it."""
    facts: SearchFacts | None = None
    for turn in turns:
        facts = facts or SearchFacts(turn.belief)
        facts.add(turn.glance)
        yield turn, facts


@torch.inference_mode()
def picture_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredGlances], config: FitZoomConfig, title: str
) -> Searches:
    """Run all searches of `_searches_of`, and collect them."""
    rows: list[list[Tensor]] = []
    for _, annotation, target, turns in _searches_of(model, pictures, opened, config, title):
        steps = [(facts.best, facts.case(turn.ahead), facts.detected, turn.ahead) for turn, facts in turns]
        steps += [(*steps[-1][:3], 0.0)] * (config.passes - len(steps))
        best, case, looked, left = zip(*steps, strict=True)
        there = torch.tensor(bool((annotation.labels == target).any()))
        rows.append([torch.tensor(best), torch.stack(case), torch.tensor(looked), torch.tensor(left), there])
    return Searches(*(torch.stack(column) for column in zip(*rows, strict=True)))


def fit_judge(model: GlimpseEvidence, searches: Searches, steps: int, batch: int = 4096) -> None:
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
def judge_searches(model: GlimpseEvidence, searches: Searches, bounds: Bounds) -> list[str]:
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


class _MosaicSearch(TargetSearch[WindowLook]):
    """A search of a mosaic; objects `(M, 4)`, boxes `(4,)`."""

    after = (1, 3, 5, 8, 12, 16, 24)

    def __init__(
        self,
        mosaic: int,
        looks: StoredGlances,
        target: int,
        objects: Tensor,
        passes: int,
        likely: float,
        glances: Sequence[Glance],
        states: Sequence[WindowLook],
        boxes: Sequence[Tensor | None],
    ) -> None:
        places = partial(CandidateBoxes, target, likely)
        super().__init__(
            mosaic,
            target,
            places,
            lambda box: look_closely(looks, box).detections,
            present=len(objects) > 0,
            passes=passes,
        )
        self.looks, self.objects, self.glances, self.states, self.boxes = looks, objects, glances, states, boxes

    def __len__(self) -> int:
        return len(self.states)

    def look(self, index: int, number: int) -> WindowLook:
        """Return a look with the number of looks up to it."""
        return self.states[index]._replace(number=number)

    def right(self, box: Tensor) -> bool:
        """Whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.objects).max()) >= SAME

    def decided(self, index: int, thresholds: Thresholds) -> tuple[int, bool | None]:
        """The outcome by the evidence alone; the place is that of the box with the highest score."""
        state, box = self.states[index], self.boxes[index]
        presence, looked, left = (torch.tensor([each]) for each in (state.presence, box is not None, state.left))
        outcome = int(settle(presence, looked, left, thresholds))
        if OUTCOMES[outcome] != "found":
            return outcome, None
        assert box is not None
        return outcome, self.right(box)


@torch.inference_mode()
def _mosaic_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredGlances], config: FitZoomConfig, title: str
) -> Iterator[_MosaicSearch]:
    """Search every picture, without closer looks (`_searches_of`)."""
    assert model.thresholds is not None
    for index, annotation, target, turns in _searches_of(model, pictures, opened, config, title):
        glances: list[Glance] = []
        states: list[WindowLook] = []
        boxes: list[Tensor | None] = []
        for number, (turn, facts) in enumerate(turns, 1):
            detections, presence = turn.glance.detections, facts.presence(turn.ahead)
            glances.append(turn.glance)
            states.append(WindowLook(detections, number, presence, facts.best, turn.ahead))
            boxes.append(facts.box if facts.detected else None)
        objects = annotation.boxes[annotation.labels == target]
        likely = model.thresholds.confirm
        yield _MosaicSearch(index, opened[index], target, objects, config.passes, likely, glances, states, boxes)


def fit_closer(
    model: GlimpseEvidence,
    pictures: Mapping[str, Sequence[tuple[Scenes, Sequence[StoredGlances]]]],
    config: FitZoomConfig,
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
    return verification_report(VerificationResult(fitted, [fitted], held_out, decisions), judged, how)[0]
