"""Decisions of a search by windows: the facts about its looks, and the outcome after each and after closer looks."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.prior import Prior, check_prior
from semfov.belief.target_evidence import Thresholds
from semfov.decision import OUTCOMES, CandidatePlace, CloseUp, Decision, Verifier, settle
from semfov.decision.candidates import LookAt
from semfov.episode import Forgetting
from semfov.motion import Motion
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH, CandidateBoxes, PhotographPlaces, SearchLook
from semfov.zoom.episode import WindowStep
from semfov.zoom.evidence import GlimpseEvidence, PhotographEvidence
from semfov.zoom.hint_maps import features
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.lattice import CELLS
from semfov.zoom.looks import WindowLook


class _LookFacts(NamedTuple):
    """What one look of a search shows of the target; box `(4,)`."""

    score: float
    closest: float
    named: float
    found: float
    box: Tensor | None


class SearchFacts:
    """What looks have shown of the target: the highest score, its `box` `(4,)`, and whether a detection shows it."""

    best: float
    box: Tensor | None
    detected: bool

    def __init__(self, belief: ZoomBelief) -> None:
        self.belief = belief
        self.looks: list[_LookFacts] = []

    def see(self, looks: Sequence[WindowLook]) -> None:
        """Take the looks that count after another look; those of earlier ones that are missing were forgotten."""
        if len(looks) != len(self.looks) + 1:
            self.looks = []
        for look in looks[len(self.looks) :]:
            self.add(look)

    def add(self, window_look: WindowLook) -> None:
        target, detections = self.belief.target, window_look.detections
        score, named, found, box = float(window_look.show[target - 1]), 0.0, 0.0, None
        closest = score if window_look.window.level == self.belief.lattice.levels - 1 else 0.0
        scores = detections.scores[0, :, target].detach().float().numpy()
        if len(scores):
            named = float(scores[detections.labels[0].numpy() == target].max(initial=0))
            found, box = float(scores.max()), detections.boxes[0, int(scores.argmax())]
        self.looks.append(_LookFacts(score, closest, named, found, box))
        self.best = max(look.score for look in self.looks)
        shown = max(self.looks, key=lambda look: look.found)
        self.box, self.detected = shown.box if shown.found > 0 else None, shown.found >= DETECTION_SCORE

    def case(self, ahead: float) -> Tensor:
        """Facts `(10,)` for `GlimpseEvidence.anywhere`: six scores, what is left to see, and numbers of looks."""
        looks = self.looks
        best, second, *_ = sorted([*(look.score for look in looks), 0.0], reverse=True)
        closest, named = max(look.closest for look in looks), max(look.named for look in looks)
        hints = features(torch.tensor([best, second, closest, looks[0].score, named, ahead], dtype=torch.float32))
        last = self.belief.lattice.levels - 1
        # Number of looks of the last level that are expected to show the target. Windows start at every cell: this is
        # the mean over all ways to lay them side by side.
        showing = float(self.belief.chances(last).sum()) / CELLS**2 if last else 0.0
        share = float(self.belief.unexplored.sum() / self.belief.visible.sum().clamp(1))
        left = [math.log(showing + 1e-3) / 4, share]
        counts = [math.log1p(sum(look.score >= DETECTION_SCORE for look in looks)) / 2, math.log(len(looks)) / 2]
        return torch.cat([hints, torch.tensor([*left, *counts])])

    @torch.no_grad()
    def presence(self, ahead: float) -> float:
        """Predict whether the picture holds the target, by the prior of the fit."""
        photograph, target = self.belief.photograph, torch.tensor(self.belief.target)
        if photograph is not None:
            return float(photograph.presence(torch.tensor(self.best), target).sigmoid())
        odds = self.belief.evidence.anywhere(torch.tensor(self.best), self.case(ahead))
        return float(odds.sigmoid())


CLOSER = 100  # largest number of closer looks in a large picture: as many as there are passes for
_DEFAULTS = Thresholds(0.9, 0.005)  # thresholds of searches whose evidence has none


class WindowDecisions:
    """Decides one search by windows, look by look, with closer looks where the evidence has fitted verification."""

    def __init__(
        self,
        evidence: GlimpseEvidence,
        target: int,
        close_up: LookAt,
        *,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int | None = None,
        forgetting: Forgetting | None = None,
        prior: float | None = None,
    ) -> None:
        check_prior(prior)
        self._share, self.prior = prior, Prior()
        self.evidence, self.target, self._close_up = evidence, target, close_up
        self._given, self._most, self._forgetting = (confirm, give_up), closer, forgetting
        self.thresholds = _DEFAULTS
        self.verifier: Verifier[SearchLook] | None = None
        self.criterion: str | None = None
        """What the decision `found` needs, in words, after the first look."""
        self.outcome = 0
        self._facts: SearchFacts | None = None
        self._ahead = 0.0
        self._presence: float | None = None

    def _begin(self, belief: ZoomBelief) -> SearchFacts:
        """Choose thresholds and closer looks by the kind of picture."""
        (confirm, give_up), evidence = self._given, self.evidence
        photograph = belief.photograph
        at = evidence.thresholds if photograph is None else photograph.verification.thresholds
        model = evidence.verification if photograph is None else photograph.verification
        self.prior = self._prior_in(photograph)
        self.thresholds = (at or _DEFAULTS).changed(give_up=give_up)
        usual = CLOSER if photograph is None else MOST_IN_PHOTOGRAPH
        most = usual if self._most is None else self._most
        if most and model is not None and model.thresholds is not None:
            worth = self.thresholds.give_up
            at = model.thresholds.changed(confirm, worth)
            places: CandidateBoxes
            if photograph is None:
                places = CandidateBoxes(self.target, self.thresholds.confirm, self._forgetting, self.prior)
            else:
                places = PhotographPlaces(self.target, belief.lattice, self._forgetting, photograph.window, self.prior)
                at = at.changed(place=worth)  # all further looks are closer ones
            self.verifier = Verifier(model, places, self._close_up, at, most)
            self.criterion = self.verifier.criterion
        else:
            self.thresholds = self.thresholds.changed(confirm)
            self.criterion = f"p is {self.thresholds.confirm:g} and a detection shows the target"
        return SearchFacts(belief)

    def _prior_in(self, photograph: PhotographEvidence | None) -> Prior:
        """Compare the share that was given with that of the fit, which for large pictures is one half."""
        if self._share is None or photograph is None:
            # `GlimpseEvidence.anywhere` does not know the class, so that all classes have the mean share.
            return Prior() if self._share is None else Prior(self._share)
        return Prior.of(self._share, photograph.shares, self.target)

    def wait(self, passed: float) -> None:
        """Let seconds pass. In a stream, call it before every frame."""
        if self.verifier is not None:
            self.verifier.wait(passed)

    def follow(self, motion: Motion | None) -> None:
        """Carry examined places along with the camera, or forget them where a frame fits none before."""
        if self.verifier is not None:
            self.verifier.follow(motion)

    def see(self, step: WindowStep[ZoomBelief], number: int, *, last: bool) -> None:
        """Take in a look, and choose the place that is to be looked at closely."""
        self._facts = self._facts or self._begin(step.belief)
        self._facts.see(step.looks)
        self._ahead, self._presence = step.ahead, None
        facts, self.outcome = self._facts, 0
        large = step.belief.photograph is None
        if large and not facts.detected and not self.looks and self._left() >= self.thresholds.give_up:
            return  # no probability ends the search
        presence = self._fitted_presence()
        if self.verifier is None:
            there, looked = torch.tensor([self.prior(presence)]), torch.tensor([facts.detected])
            self.outcome = int(settle(there, looked, torch.tensor([self._left()]), self.thresholds))
            return
        look = SearchLook(step.look.candidates, number, presence, facts.best, self._ahead)
        self.verifier.see(look, last=last)
        self._settle(self.verifier)

    def _fitted_presence(self) -> float:
        """Probability that the picture holds the target after the last look, by the prior of the fit."""
        assert self._facts is not None
        if self._presence is None:
            self._presence = self._facts.presence(self._ahead)
        return self._presence

    def _left(self) -> float:
        """Value of the best look that is left."""
        if self.prior.changes_nothing:
            return self._ahead  # without the presence, which takes time
        return self.prior.place(self._ahead, self._fitted_presence())

    @property
    def candidate(self) -> CandidatePlace | None:
        """The place that is to be looked at closely now; None if there is none."""
        return None if self.verifier is None else self.verifier.candidate

    @property
    def looks(self) -> list[CloseUp]:
        return [] if self.verifier is None else self.verifier.looks

    def look(self) -> CloseUp:
        """Look closely at the candidate, and choose the next one."""
        assert self.verifier is not None
        look = self.verifier.look()
        self._settle(self.verifier)
        return look

    def _settle(self, verifier: Verifier[SearchLook]) -> None:
        """Examine the places that need no pass, and decide."""
        while verifier.candidate is not None and verifier.places.seen(verifier.candidate):
            verifier.look()
        self.outcome = verifier.outcome()

    def decision(self, *, over: bool | None = None) -> Decision:
        assert self._facts is not None
        if self.verifier is not None and self.verifier.looks:
            return self.verifier.decision(over=over)
        outcome = OUTCOMES[self.outcome]
        box = self._facts.box if outcome == "found" else None
        return Decision(outcome, self.prior(self._fitted_presence()), None, box)
