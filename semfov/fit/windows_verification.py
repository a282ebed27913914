"""Fit the verification of targets in large pictures by closer looks, on searches of pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification
from semfov.data.scene import Scenes
from semfov.decision import SAME, settle
from semfov.detection.detections import Detections
from semfov.fit.searches import SearchLimits, TargetSearch
from semfov.fit.verification import (
    VerificationResult,
    choose_confirm,
    examine,
    fit,
    verification_report,
    verify,
)
from semfov.fit.windows_decision import searches_of
from semfov.observation.matching import box_iou
from semfov.runs.zoom_store import StoredGlances
from semfov.zoom.closer import CandidateBoxes, WindowLook, look_closely
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.glances import Glance


class _Limits(SearchLimits, Protocol):
    """Settings of the fit (see `FitZoomConfig`)."""

    @property
    def sought(self) -> int:
        """Number of present classes, and of absent classes, to search for in each mosaic."""
        ...

    @property
    def passes(self) -> int:
        """Maximum number of passes of the detector in a search."""
        ...

    @property
    def place(self) -> float:
        """Least probability of a place that is worth a closer look when no other look follows."""
        ...

    @property
    def false_alarms(self) -> float:
        """Maximum share of absent targets that may be reported as found."""
        ...


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
        super().__init__(mosaic, target, present=len(objects) > 0, passes=passes)
        self.looks, self.objects, self.likely = looks, objects, likely
        self.glances, self.states, self.boxes = glances, states, boxes

    def __len__(self) -> int:
        return len(self.states)

    def look(self, index: int, number: int) -> WindowLook:
        """Return a look with the number of looks up to it."""
        return self.states[index]._replace(number=number)

    def candidates(self) -> CandidateBoxes:
        """Make the source of boxes to look at closely."""
        return CandidateBoxes(self.target, self.likely)

    def close_up(self, box: Tensor) -> Detections:
        """Look closely at a box `(4,)`; returns the detections, a batch of one."""
        return look_closely(self.looks, box).detections

    def right(self, box: Tensor) -> bool:
        """Whether a box `(4,)` is that of an annotated object of the class."""
        return self.present and float(box_iou(box[None], self.objects).max()) >= SAME

    def last(self, index: int, room: float) -> bool:
        """Whether no pass is left after a closer look."""
        return room <= 1

    def outcome(self, index: int, thresholds: Thresholds) -> int:
        """Number of the outcome by the evidence alone."""
        state = self.states[index]
        looked = torch.tensor([self.boxes[index] is not None])
        return int(settle(torch.tensor([state.presence]), looked, torch.tensor([state.left]), thresholds))

    def found(self, index: int) -> bool:
        """Whether the box with the highest score is that of an annotated object of the class."""
        box = self.boxes[index]
        assert box is not None
        return self.right(box)


@torch.inference_mode()
def _mosaic_searches(
    model: GlimpseEvidence, pictures: Scenes, opened: Sequence[StoredGlances], config: _Limits, title: str
) -> Iterator[_MosaicSearch]:
    """Search every picture, without closer looks (`semfov.fit.windows_decision.searches_of`)."""
    assert model.thresholds is not None
    searches = searches_of(
        model, pictures, opened, classes=config.sought, passes=config.passes, seed=config.seed, title=title
    )
    for index, annotation, target, turns in searches:
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
    config: _Limits,
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
