"""Verification of the target by closer looks, before a search decides."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Generic, NamedTuple

import torch
from torch import Tensor

from semfov.belief.target_evidence import Thresholds
from semfov.belief.verification import Verification, follow_target
from semfov.data.inputs import FRAME
from semfov.decision.candidates import SAME, CandidatePlace, CandidatePlaces, LookAt, LookType
from semfov.decision.rule import OUTCOMES, CloseUp, Decision, verified
from semfov.episode import Step
from semfov.errors import check, check_whole
from semfov.motion import Motion
from semfov.observation.matching import box_iou

MOST_CLOSER = 2
"""Number of closer looks after which a place is found that is probable enough; by default a search makes no more."""

_SPANS = 2  # spans of `Forgetting` after which nothing is left of a verdict: a quarter of its evidence
_FLOOR = 1e-6


class _Verdict(NamedTuple):
    """A closer look at a place, and the seconds since then."""

    look: CloseUp
    age: float = 0


class Verifier(Generic[LookType]):
    r"""Decides one search, with closer looks at the places that seem to hold the target; close_up `(4,)`.

    After each look the verifier names the place that is to be looked at closely (`candidate`), the most evident one, if
    it is probable enough. The search ends at once with a place that is sure, after `MOST_CLOSER` closer looks with one
    that is probable enough, and with the best one when no look is worth a pass, or `most` closer looks were made
    (`verified`). In a photograph that is looked at by windows no place ends it (`by_worth`), as the next may be surer.

    Closer looks may follow a look at once (`look_closely`), or take frames of their own in a stream (`look`). Their
    probabilities then fade towards the belief. With the rate r of the candidates' `Forgetting`, after a seconds

    .. math:: \operatorname{logit} P_a = e^{-ra} \operatorname{logit} P_0 + (1 - e^{-ra}) \operatorname{logit} B

    where B is the present probability by the belief: of the target in the cell of the place, or in the image. That of a
    place never rises above :math:`P_0`. After :math:`\ln 2 / r` seconds the place may be examined again, and after
    twice as many the verdict is forgotten. If r is not 0, the boxes of the verdicts follow the detections of each look.
    """

    def __init__(
        self,
        model: Verification,
        places: CandidatePlaces[LookType],
        close_up: LookAt,
        thresholds: Thresholds | None = None,
        most: int = MOST_CLOSER,
    ) -> None:
        thresholds = model.thresholds if thresholds is None else thresholds
        check(thresholds is not None, "thresholds", "thresholds, since the model has none", None)
        assert thresholds is not None
        check_whole(most, "most", 1, 100)
        self.model, self.places, self.close_up = model, places, close_up
        self.thresholds, self.most = thresholds, most
        self.criterion = f"a closer look gives p {thresholds.confirm:g} there"
        """What the decision `found` needs, in words."""
        self.verdicts: list[_Verdict] = []
        self.candidate: CandidatePlace | None = None
        self._last = False

    @property
    def looks(self) -> list[CloseUp]:
        return [verdict.look for verdict in self.verdicts]

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass. In a stream, call it before every frame."""
        self.places.wait(passed)
        aged = (verdict._replace(age=verdict.age + passed) for verdict in self.verdicts)
        self.verdicts = [verdict for verdict in aged if verdict.age <= _SPANS * self.places.forgetting.span]

    def follow(self, motion: Motion | None) -> None:
        """Carry examined places along with the camera, or forget them where a frame fits none before."""
        self.candidate = None
        self.places.follow(motion)
        if motion is None:
            self.verdicts = []
            return
        for number, verdict in enumerate(self.verdicts):
            moved = replace(verdict.look, box=motion.boxes(verdict.look.box))
            self.verdicts[number] = verdict._replace(look=moved)

    def see(self, look: LookType, *, last: bool = False) -> None:
        """Take in a look of the search, and choose the place that is to be looked at closely."""
        self.places.see(look)
        if self.places.forgetting.rate:
            for number, verdict in enumerate(self.verdicts):
                box = follow_target(verdict.look.box, self.places.detections, verdict.look.target)
                if box is not verdict.look.box:
                    moved = replace(verdict.look, box=box, cell=self.places.cell(box))
                    self.verdicts[number] = verdict._replace(look=moved)
        self._choose(last=last)

    def look(self) -> CloseUp:
        """Look closely at the candidate, and choose the next one."""
        assert self.candidate is not None
        features, box = self.places.examine(self.candidate, self.close_up)
        with torch.no_grad():
            fitted_place, fitted_presence = self.model(features.to(self.model.linear.weight)).sigmoid().tolist()
        prior = self.places.prior
        look = self.places.record(box, prior.place(fitted_place, fitted_presence), prior(fitted_presence))
        # A place that was free to be examined again has a new verdict now.
        self.verdicts = [
            old
            for old in self.verdicts
            if old.age <= self.places.forgetting.span
            or (old.look.cell != look.cell and float(box_iou(old.look.box[None], look.box[None])) < SAME)
        ]
        self.verdicts.append(_Verdict(look))
        self._choose(last=self._last)
        return look

    def look_closely(self, room: float = math.inf) -> list[CandidatePlace]:
        """Make all closer looks that are due; returns the places that took a pass."""
        examined: list[CandidatePlace] = []
        while self.candidate is not None and len(examined) < room:
            if not self.places.seen(self.candidate):
                examined.append(self.candidate)
            self.look()
        return examined

    def __call__(self: "Verifier[Step]", step: Step) -> Tensor:
        """Decide whether a search ends with a step `(1,)`, after the closer looks, once for every step in order."""
        self.see(step)
        self.look_closely()
        return torch.full_like(step.cell, self.outcome())

    @property
    def over(self) -> bool:
        """Whether no look of the search is worth a pass, or all closer looks were made."""
        return self.places.left < self.thresholds.give_up or len(self._recent) >= self.most

    def outcome(self) -> int:
        """Decide whether the search ends."""
        return self._verified([self._chance(each) for each in self.verdicts], over=self.over)

    def conclude(self, room: float = math.inf) -> Decision:
        """Make the decision of a search that is over."""
        if not self.outcome():
            self._choose(last=True)
            self.look_closely(room)
        return self.decision(over=True)

    def decision(self, *, over: bool | None = None) -> Decision:
        """Make the decision as it stands after the last look."""
        over = self.candidate is None and self.over if over is None else over
        chances, presence = [self._chance(each) for each in self.verdicts], self.presence
        outcome = OUTCOMES[verified(chances, presence, self.thresholds.confirm, over=True)]
        if outcome != "found":
            return Decision(outcome if over else "undecided", presence)
        place, best = max(chances), self.best
        return Decision("found", max(presence, place), best.cell, best.box, place)

    @property
    def presence(self) -> float:
        """Probability that the picture holds the target: after the closer looks, or that without them."""
        without = self.places.presence
        recent = sorted(self._recent, key=self._chance)[-1:] if self.places.by_worth else self._recent
        return max((self._faded(each.look.presence, without, each.age) for each in recent), default=without)

    @property
    def best(self) -> CloseUp:
        """The closer look with the largest probability of the place; there must be one."""
        return max(self.verdicts, key=self._chance).look

    def _choose(self, *, last: bool) -> None:
        """Choose the place that is to be looked at closely."""
        self._last = last
        recent = self._recent
        sure = self._verified([self._chance(each) for each in recent], over=False) > 0
        last = last or self.places.left < self.thresholds.give_up
        enough = len(recent) >= self.most or sure
        self.candidate = None if enough else self.places.due(self.thresholds.place, last=last)

    def _verified(self, chances: Sequence[float], *, over: bool) -> int:
        """The outcome by the probabilities of some places (`verified`)."""
        if self.places.by_worth and not over:
            return 0
        enough = len(self._recent) >= MOST_CLOSER
        outcome = verified(chances, self.presence, self.thresholds.confirm, over=over or enough)
        return outcome if over or OUTCOMES[outcome] == "found" else 0

    @property
    def _recent(self) -> list[_Verdict]:
        """The closer looks of which at least half of the evidence is left."""
        return [verdict for verdict in self.verdicts if verdict.age <= self.places.forgetting.span]

    def _chance(self, verdict: _Verdict) -> float:
        """Probability that the target is still at the place of a closer look."""
        look, keep = verdict.look, self.places.forgetting.keep
        if keep**verdict.age == 1:
            return look.place
        return min(look.place, self._faded(look.place, self.places.probability(look), verdict.age))

    def _faded(self, before: float, now: float, age: float) -> float:
        """A probability that fades towards that of the belief."""
        weight = self.places.forgetting.keep**age
        if weight == 1:
            return before
        odds, present = (math.log(p / (1 - p)) for p in (min(max(p, _FLOOR), 1 - _FLOOR) for p in (before, now)))
        return 1 / (1 + math.exp(-(weight * odds + (1 - weight) * present)))
