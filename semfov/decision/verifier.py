"""Verification of the target by closer looks, before a search decides."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Generic, NamedTuple

import torch

from semfov.belief.verification import Verification, follow_target
from semfov.data.inputs import FRAME
from semfov.decision.candidates import CandidatePlace, CandidatePlaces, LookAt, LookType
from semfov.decision.rule import (
    FOUND,
    GO_ON,
    MOST_CLOSER,
    OUTCOMES,
    CloseUp,
    Decision,
    final_outcome,
    found_at_once,
)
from semfov.detection.detections import Detections
from semfov.errors import check, check_whole
from semfov.motion import CameraStep, LostScene, Motion
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou, inside_frame
from semfov.observation.thresholds import Thresholds

_SPANS = 2  # spans of `Forgetting` after which nothing is left of a verdict: a quarter of its evidence
_FLOOR = 1e-6


class _Verdict(NamedTuple):
    """A closer look at a place, and what became of it since.

    Attributes:
        look: the closer look, where the place is in the present frame.
        magnification: canvas pixels of the look for a pixel of the present frame.
        age: seconds since the look.
        in_view: whether the present frame shows the place.
    """

    look: CloseUp
    magnification: float
    age: float = 0
    in_view: bool = True


class _JudgedPlace(NamedTuple):
    """A closer look, and the present probability that the target is at its place."""

    verdict: _Verdict
    probability: float


class Judgement(NamedTuple):
    """Result of a closer look: probabilities of the target at the place and in the picture, and its box `(4,)`."""

    place: float
    presence: float
    box: torch.Tensor


class PlaceVerifier(ABC, Generic[LookType]):
    r"""Base of classes that decide a search by closer looks at places that seem to hold the target.

    It makes no look itself. After each look (`see`) it names the most evident place for a closer look (`candidate`), if
    it is probable enough; `examine` tells it what the closer look shows. The search ends at once with a place that is
    sure, after `MOST_CLOSER` closer looks with one from `confirm` on, and with the best one when it is over: when no
    look is worth a pass, or `most` closer looks were made (the table in `semfov.decision`).

    Closer looks may follow a look at once (`look_closely`), or take frames of their own in a stream. Their
    probabilities then fade towards the belief. With the rate r of the candidates' `Forgetting`, after a seconds

    .. math:: \operatorname{logit} P_a = e^{-ra} \operatorname{logit} P_0 + (1 - e^{-ra}) \operatorname{logit} B

    where B is the present probability by the belief: of the target in the cell of the place, or in the image. That of a
    place never rises above :math:`P_0`. After :math:`\ln 2 / r` seconds the place may be examined again, and after
    twice as many the verdict is forgotten. If r is not 0, the boxes of the verdicts follow the detections of each look.

    Attributes:
        places: the places that closer looks are chosen from.
        thresholds: `confirm` for places, `place` and `stop_below` for candidates.
        most: largest number of closer looks that count at one time.
        criterion: what the decision `found` needs, in words.
        verdicts: the closer looks that are not forgotten, in order, each with its age. Only those whose place is in
            view count.
        candidate: the place that is to be looked at closely now; None if there is none, and before the first look.
    """

    def __init__(self, places: CandidatePlaces[LookType], thresholds: Thresholds, most: int = MOST_CLOSER) -> None:
        check_whole(most, "most", 1, 100)
        self.places = places
        self.thresholds = thresholds
        self.most = most
        self.criterion = f"a closer look gives p {thresholds.confirm:g} there"
        self.verdicts: list[_Verdict] = []
        self._lost: LostScene[_Verdict] = LostScene()
        self.candidate: CandidatePlace | None = None
        self._is_last = False  # whether no look of the search follows the last one
        self._judged: list[_JudgedPlace] | None = None  # computed when it is asked for after a change

    @property
    def looks(self) -> list[CloseUp]:
        return [verdict.look for verdict in self.verdicts if verdict.in_view]

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass. In a stream, call it before every frame."""
        self._judged = None
        self.places.wait(passed)
        self.verdicts = self._aged(self.verdicts, passed)
        # Time passes for a lost scene, too, so that old verdicts do not come back with it.
        if self._lost.things is not None:
            self._lost.things = self._aged(self._lost.things, passed)

    def _aged(self, verdicts: list[_Verdict], passed: float) -> list[_Verdict]:
        """Let seconds pass since the verdicts, without those that are forgotten."""
        aged = (verdict._replace(age=verdict.age + passed) for verdict in verdicts)
        return [verdict for verdict in aged if verdict.age <= _SPANS * self.places.forgetting.span]

    def follow(self, camera: CameraStep, size: tuple[int, int]) -> None:
        """Carry the candidate and examined places along.

        Those that are behind the camera now are forgotten. Where a frame fits none before, no place is a candidate, and
        examined places are set aside, until the scene is found again or given up (`semfov.motion.LostScene`). What has
        left the frame is no reason for a decision until it comes back.

        Args:
            camera: how the camera moved.
            size: `(width, height)` of the frames.
        """
        self._judged = None
        self.places.follow(camera)
        self.candidate = None if camera.motion is None else self._moved_candidate(camera.motion)
        self.verdicts = self._lost.follow(self.verdicts, camera, partial(_moved_verdicts, size=size))

    def _moved_candidate(self, motion: Motion) -> CandidatePlace | None:
        """Move the candidate with the camera; None if it is behind the camera now, or there is none."""
        candidate = self.candidate
        if candidate is None:
            return None
        # The closer look that is due is made in the next frame, wherever the camera has turned.
        moved_box, is_ahead = motion.boxes_ahead(candidate.box)
        return candidate._replace(box=moved_box) if bool(is_ahead) else None

    def see(self, look: LookType, *, last: bool = False) -> None:
        """Update with a look of the search, and choose the place of the next closer look."""
        self._judged = None
        self.places.see(look)
        if self.places.forgetting.rate:  # in a stream, in which objects move
            self.verdicts = [self._followed(verdict) for verdict in self.verdicts]
        self._is_last = last
        self._choose()

    def _followed(self, verdict: _Verdict) -> _Verdict:
        """Move the place of a verdict to the detection of the last look that shows its target; it is in view then."""
        box = follow_target(verdict.look.box, self.places.detections, verdict.look.target)
        if box is verdict.look.box:  # no detection shows it
            return verdict
        fits = float(box_iou(box[None], verdict.look.box[None])) >= SAME_OBJECT_IOU
        if fits and not self.places.places_exactly(verdict.look.box, verdict.magnification):
            return verdict._replace(in_view=True)  # else the box would jump to and fro though its object stands
        look = replace(verdict.look, box=box, cell=self.places.cell(box))
        return verdict._replace(look=look, in_view=True)

    @property
    def shown(self) -> Detections | None:
        """What an earlier look shows of the candidate as closely; None where that takes a pass, and without one."""
        return None if self.candidate is None else self.places.shown_at(self.candidate)

    def examine(self, detections: Detections) -> CloseUp:
        """Judge the candidate by what a look shows closely, and choose the next one.

        Args:
            detections: detections of the closer look, a batch of one, or those that are `shown`.

        Returns:
            The closer look, with its probabilities.
        """
        candidate = self.candidate
        assert candidate is not None
        judgement = self._judge(candidate, detections)
        look = self.places.record(judgement.box, judgement.place, judgement.presence)
        # A place that was free to be examined again has a new verdict now.
        self.verdicts = [verdict for verdict in self.verdicts if not self._is_replaced(verdict, look)]
        self.verdicts.append(_Verdict(look, self.places.closer_magnification(candidate)))
        self._judged = None
        self._choose()
        return look

    @abstractmethod
    def _judge(self, candidate: CandidatePlace, detections: Detections) -> Judgement:
        """Judge a candidate by what a look shows closely, with the prior of the places, and dismiss it."""

    def look_closely(self, close_up: LookAt) -> list[CandidatePlace]:
        """Make all closer looks that are due.

        Args:
            close_up: looks closely at a box.

        Returns:
            The places that took a pass.
        """
        examined: list[CandidatePlace] = []
        while self.candidate is not None:
            detections = self.shown
            if detections is None:
                examined.append(self.candidate)
                detections = close_up(self.candidate.box)
            self.examine(detections)
        return examined

    def end(self) -> None:
        """Let no look of the search follow: closer looks come due that are worth a pass at the end."""
        if self.outcome() == GO_ON:
            self._is_last = True
            self._choose()

    @property
    def is_over(self) -> bool:
        """Whether no look of the search is worth a pass, or all closer looks were made."""
        return self._gives_up or len(self._recent) >= self.most

    def outcome(self) -> int:
        """Decide whether the search ends with the last look: a number of `OUTCOMES`, or `GO_ON`."""
        if self.is_over:
            return self._final_outcome()
        return FOUND if self._is_found_at_once(self._judged_places) else GO_ON

    def decision(self) -> Decision:
        """Make the decision as it stands. As long as the search goes on, it is `found` or `undecided`."""
        return self._decision(is_over=self.candidate is None and self.is_over)

    def decision_if_ended_now(self) -> Decision:
        """Make the decision of a search that ends as it is, also if a closer look is due."""
        return self._decision(is_over=self.is_over)

    def final_decision(self) -> Decision:
        """Make the decision as if no look were worth a pass."""
        return self._decision(is_over=True)

    @property
    @abstractmethod
    def presence(self) -> float:
        """Probability that the picture holds the target: after the closer looks, or that without them."""

    @property
    def best(self) -> CloseUp:
        """The closer look with the largest probability of the place; there must be one."""
        return max(self._judged_places, key=_probability).verdict.look

    def _decision(self, *, is_over: bool) -> Decision:
        """Make the decision; a place from `confirm` on is found at any time, the rest is decided when it is over."""
        presence = self.presence
        outcome = OUTCOMES[self._final_outcome()]
        if outcome != "found":
            return Decision(outcome if is_over else "undecided", presence, confirm=self.thresholds.confirm)
        best, place = max(self._judged_places, key=_probability)
        probability = max(presence, place)
        return Decision("found", probability, best.look.cell, best.look.box, place, self.thresholds.confirm)

    def _final_outcome(self) -> int:
        """Decide as if the search were over."""
        places = [judged.probability for judged in self._judged_places]
        return final_outcome(places, self.presence, self.thresholds.confirm)

    def _is_found_at_once(self, judged_places: Sequence[_JudgedPlace]) -> bool:
        """Whether one of the places ends the search, though it is not over."""
        places = [judged.probability for judged in judged_places]
        return found_at_once(places, self.thresholds.confirm, len(self._recent))

    def _choose(self) -> None:
        """Choose the place that is to be looked at closely."""
        recent = self._recent
        if len(recent) >= self.most or self._is_found_at_once(recent):
            self.candidate = None
        else:
            self.candidate = self.places.due(self.thresholds, last=self._is_last or self._gives_up)

    @property
    def _gives_up(self) -> bool:
        """Whether no look of the search is worth a pass."""
        return self.places.hit_chance < self.thresholds.stop_below

    @property
    def _judged_places(self) -> list[_JudgedPlace]:
        """The closer looks at places in view that are not forgotten, in order."""
        if self._judged is None:
            in_view = (verdict for verdict in self.verdicts if verdict.in_view)
            self._judged = [_JudgedPlace(verdict, self._place(verdict)) for verdict in in_view]
        return self._judged

    @property
    def _recent(self) -> list[_JudgedPlace]:
        """Those of which at least half of the evidence is left."""
        return [judged for judged in self._judged_places if judged.verdict.age <= self.places.forgetting.span]

    def _is_replaced(self, verdict: _Verdict, look: CloseUp) -> bool:
        """Whether a closer look has a new verdict on the place of an old one, of which less than half is left."""
        if verdict.age <= self.places.forgetting.span:
            return False
        in_its_cell = verdict.look.cell == look.cell
        overlap = box_iou(verdict.look.box[None], look.box[None])
        return in_its_cell or float(overlap) >= SAME_OBJECT_IOU

    def _place(self, verdict: _Verdict) -> float:
        """Probability that the target is still at the place of a closer look."""
        look = verdict.look
        if self.places.forgetting.share_left(verdict.age) == 1:
            return look.place
        faded = self._faded(look.place, self._believed(look), verdict.age)
        return min(look.place, faded)

    def _believed(self, look: CloseUp) -> float:
        """Present probability that the target is at the place of a closer look; that of the look fades towards it."""
        return self.places.probability(look)

    def _faded(self, fresh: float, without: float, age: float) -> float:
        """Let a probability after a closer look fade towards that without closer looks.

        Args:
            fresh: probability right after the look.
            without: present probability by the belief alone.
            age: seconds since the look.

        Returns:
            The probability whose log odds are the mean of both, weighted by the evidence that is left.
        """
        weight = self.places.forgetting.share_left(age)
        if weight == 1:
            return fresh
        logit = weight * _log_odds(fresh) + (1 - weight) * _log_odds(without)
        return 1 / (1 + math.exp(-logit))


class Verifier(PlaceVerifier[LookType]):
    """Decides one search by closer looks, which a fitted model of verification judges.

    Attributes:
        model: the model.
    """

    def __init__(
        self,
        model: Verification,
        places: CandidatePlaces[LookType],
        thresholds: Thresholds | None = None,
        most: int = MOST_CLOSER,
    ) -> None:
        thresholds = model.thresholds if thresholds is None else thresholds
        check(thresholds is not None, "thresholds", "thresholds, since the model has none", None)
        assert thresholds is not None
        super().__init__(places, thresholds, most)
        self.model = model

    @property
    def presence(self) -> float:
        without = self.places.presence
        looks = ((judged.verdict.look.presence, judged.verdict.age) for judged in self._recent)
        faded = (self._faded(presence, without, age) for presence, age in looks)
        return max(faded, default=without)

    @torch.no_grad()
    def _judge(self, candidate: CandidatePlace, detections: Detections) -> Judgement:
        features, box = self.places.examine(candidate, detections)
        fitted_place, fitted_presence = self.model(features.to(self.model.linear.weight)).sigmoid().tolist()
        prior = self.places.prior
        place = prior.at_place(fitted_place, fitted_presence)
        return Judgement(place, prior(fitted_presence), box)


def _moved_verdicts(verdicts: list[_Verdict], motion: Motion, size: tuple[int, int]) -> list[_Verdict]:
    """Move the places of verdicts with the camera, without those that are behind it now."""
    if not verdicts:
        return []
    boxes = torch.stack([verdict.look.box for verdict in verdicts])
    moved_boxes, boxes_ahead = motion.boxes_ahead(boxes)
    ahead = boxes_ahead.tolist()
    in_view = inside_frame(moved_boxes, size).tolist()
    scales = motion.scale_at((boxes[:, :2] + boxes[:, 2:]) / 2).tolist()
    moved_verdicts = []
    for number, verdict in enumerate(verdicts):
        if ahead[number]:
            look = replace(verdict.look, box=moved_boxes[number])
            magnification = verdict.magnification / scales[number]
            moved_verdicts.append(verdict._replace(look=look, magnification=magnification, in_view=in_view[number]))
    return moved_verdicts


def _probability(judged: _JudgedPlace) -> float:
    return judged.probability


def _log_odds(probability: float) -> float:
    """Log odds of a probability, kept off 0 and 1."""
    inside = min(max(probability, _FLOOR), 1 - _FLOOR)
    return math.log(inside / (1 - inside))
