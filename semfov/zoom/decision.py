"""Decisions of a search by windows: the outcome after each look, and after closer looks."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import torch
from torch import Tensor

from semfov.belief.prior import Prior, PriorLike
from semfov.decision import (
    FOUND,
    GO_ON,
    OUTCOMES,
    CandidatePlace,
    CloseUp,
    Decision,
    settle,
)
from semfov.decision.rule import EVEN_CHANCE
from semfov.decision.state import DecisionState
from semfov.episode import Forgetting
from semfov.motion import CameraStep
from semfov.observation.matching import inside_frame
from semfov.observation.presence import EVEN
from semfov.observation.thresholds import Thresholds
from semfov.settings import DecisionSettings
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH
from semfov.zoom.episode import KeptLook, WindowStep
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.looks import WindowLook
from semfov.zoom.places import ObjectPlaces, ObjectVerifier, SearchFacts, TargetFacts

CLOSER = 100  # largest number of closer looks in a large picture: as many as there are passes for
_DEFAULTS = Thresholds(0.9, 0.005)  # thresholds of searches whose evidence has none
_LEAST_SCORE = 0.5  # default for the score from which on a search without evidence has found its target


class WindowDecisions(DecisionState):
    """What is decided after each look at windows (the table in `semfov.decision`); the base decides nothing.

    Attributes:
        ending: reason for an end that it makes.
        prior: the share of pictures with the target that the probabilities assume, and that of the fit.
    """

    ending: Literal["decision", "detection"] = "decision"
    prior = Prior(known=False)

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        """Take in a step, and choose the place that is to be looked at closely.

        Args:
            step: the step.
            kept: the looks that count and show some of the present frame, closer looks included.
            number: number of looks up to it, closer looks included.
            room: number of passes that remain.
        """

    def decision_if_ended_now(self) -> Decision | None:
        """Make the decision of a search that ends as it is, also if a closer look is due."""
        return self.decision

    def examine(self, look: WindowLook, kept: Sequence[KeptLook]) -> None:
        """Judge the candidate by a closer look, and choose the next one.

        Args:
            look: the closer look.
            kept: the looks that count and show some of the picture, this one included.
        """

    def wait(self, passed: float) -> None:
        """Let seconds pass. In a stream, call it before every frame."""

    def follow(self, camera: CameraStep, kept: Sequence[KeptLook]) -> None:
        """Carry examined places along with the camera, or set them aside where a frame fits none before.

        Args:
            camera: how the camera moved.
            kept: the looks that count and show some of the next frame, closer looks included.
        """


class DecisionsByScore(WindowDecisions):
    """Decisions of a search without evidence: a detection with a score from `confirm` on is the target."""

    ending = "detection"

    def __init__(self, target: int, confirm: float | None = None) -> None:
        self._target = target
        self._confirm = _LEAST_SCORE if confirm is None else confirm
        self._decision: Decision | None = None
        self.criterion = f"a detection scores {self._confirm:g}"

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        score, box = self._best(step.looks)
        if score >= self._confirm:
            self.outcome = FOUND
            self._decision = Decision("found", score, None, box, confirm=self._confirm)
        else:
            self.outcome = GO_ON
            self._decision = Decision("undecided", score, confirm=self._confirm)

    @property
    def decision(self) -> Decision | None:
        """`found` with the best detection, or `undecided` with its score."""
        return self._decision

    def _best(self, looks: Sequence[WindowLook]) -> tuple[float, Tensor | None]:
        """Find score and box `(4,)` of the best detection of the target in the looks that count."""
        highest = 0.0
        box = None
        for look in looks:
            scores = look.detections.class_scores[0, :, self._target - 1]
            if len(scores) and float(scores.max()) > highest:
                highest = float(scores.max())
                box = look.detections.boxes[0, scores.argmax()]
        return highest, box


class LastingAbsence:
    """Keeps a stream's decision `absent` while the windows that have shown nothing are looked at anew.

    A window is free for another look when half of what it showed is left, so that the search goes on, and `absent`
    would come and go before a scene in which nothing changes. It stays for as long as a look counts, unless the picture
    rather holds the target, or the camera shows another scene.
    """

    def __init__(self, forgetting: Forgetting | None) -> None:
        fades = forgetting is not None and forgetting.rate > 0
        self._longest = forgetting.span if forgetting is not None and fades else 0.0
        self._age = math.inf  # seconds since the target was absent

    def wait(self, passed: float) -> None:
        """Let seconds pass."""
        self._age += passed

    def follow(self, camera: CameraStep, kept: Sequence[KeptLook]) -> None:
        """Let it end where the scene is another one: the camera has lost it, or nothing that was seen is in view."""
        if camera.motion is None or not kept:
            self._age = math.inf

    def see(self, decision: Decision | None) -> None:
        """Take the decision after a look."""
        if decision is None or decision.outcome == "found" or decision.probability >= EVEN_CHANCE:
            self._age = math.inf
        elif decision.outcome == "absent":
            self._age = 0.0

    def kept(self, decision: Decision) -> Decision:
        """Make a decision that is open `absent` where it was so a short time ago."""
        is_open = decision.outcome == "undecided" and decision.probability < EVEN_CHANCE
        return replace(decision, outcome="absent") if is_open and self._age < self._longest else decision


class DecisionsByPresence(WindowDecisions):
    """Decisions of a search by its evidence, without closer looks (`semfov.decision.settle`).

    The probability that the picture holds the target takes time, and is asked for where it can matter.
    """

    def __init__(
        self, facts: SearchFacts, thresholds: Thresholds, prior: Prior, forgetting: Forgetting | None = None
    ) -> None:
        self._absence = LastingAbsence(forgetting)
        self.thresholds = thresholds
        self.prior = prior
        self.criterion = f"p is {thresholds.confirm:g} and a detection shows the target"
        self._facts = facts
        self._fitted_chance = 0.0  # chance of a hit after the last look, by the prior of the fit
        self._has_looked = False

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        self._has_looked = True
        self._facts.see([look.current for look in kept])
        self._fitted_chance = step.next_value
        self.outcome = GO_ON
        if not self._goes_on():
            # With one pass left no other look follows a closer one, so that less probable places are due, too.
            self._judge(step, number, last=step.next_value == 0 or room <= 1)
        if self._facts.latest:
            self._absence.see(self._latest_decision)

    def _goes_on(self) -> bool:
        """Whether the search goes on, whatever the presence is: nothing was found, and a look is worth a pass."""
        # In a photograph no window is left after the whole, and its chance of a hit is 0.
        if self._facts.detected or self.looks or self._fitted_chance == 0:
            return False
        return self._hit_chance() >= self.thresholds.stop_below

    def _judge(self, step: WindowStep[ZoomBelief | None], number: int, *, last: bool) -> None:
        """Decide after a step."""
        presence = torch.tensor([self.prior(self._facts.presence())])
        located = torch.tensor([self._facts.detected])
        hit_chance = torch.tensor([self._hit_chance()])
        self.outcome = int(settle(presence, located, hit_chance, self.thresholds))

    @property
    def decision(self) -> Decision | None:
        decision = self._latest_decision
        return None if decision is None else self._absence.kept(decision)

    @property
    def _latest_decision(self) -> Decision | None:
        """The decision by the looks that count now."""
        if not self._facts.looks:
            return None
        outcome = OUTCOMES[self.outcome]
        box = self._facts.box if outcome == "found" else None
        return Decision(outcome, self.prior(self._facts.presence()), None, box, confirm=self.thresholds.confirm)

    def wait(self, passed: float) -> None:
        self._absence.wait(passed)

    def follow(self, camera: CameraStep, kept: Sequence[KeptLook]) -> None:
        self._absence.follow(camera, kept)
        if camera.motion is not None and self._has_looked and kept:
            self._facts.see([look.current for look in kept])

    def _hit_chance(self) -> float:
        """Chance that the best remaining window shows the target."""
        if self.prior.changes_nothing:
            return self._fitted_chance  # without the presence, which takes time
        return self.prior.at_place(self._fitted_chance, self._facts.presence())


class DecisionsByCloserLooks(DecisionsByPresence):
    """Decisions of a search by closer looks at the objects that may be the target."""

    def __init__(self, facts: SearchFacts, verifier: ObjectVerifier) -> None:
        self.places = verifier.places
        super().__init__(facts, verifier.thresholds, self.places.prior, self.places.forgetting)
        self.frame = facts.belief.lattice.size
        self.verifier = verifier
        self.criterion = verifier.criterion

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        if step.look.window.is_overview:
            self.places.keep_whole(number - 1, step.look.detections)
        super().see(step, kept, number, room)

    def _judge(self, step: WindowStep[ZoomBelief | None], number: int, *, last: bool) -> None:
        """Choose the place of the next closer look, and decide."""
        shown = step.look.detections
        look = TargetFacts(shown, number, self._facts.presence(), self._fitted_chance, step.look.window)
        self.verifier.see(look, last=last)
        self._examine_shown()

    @property
    def candidate(self) -> CandidatePlace | None:
        return self.verifier.candidate

    @property
    def looks(self) -> list[CloseUp]:
        return self.verifier.looks

    def examine(self, look: WindowLook, kept: Sequence[KeptLook]) -> None:
        self._facts.see([of_picture.current for of_picture in kept])
        self.verifier.examine(look.detections)
        self._examine_shown()
        if self._facts.latest:
            self._absence.see(self._latest_decision)

    def _examine_shown(self) -> None:
        """Examine the places that need no pass, and decide."""
        while (shown := self.verifier.shown) is not None:
            self.verifier.examine(shown)
        self.outcome = self.verifier.outcome()

    @property
    def _latest_decision(self) -> Decision | None:
        return self.verifier.decision() if self.looks else super()._latest_decision

    def decision_if_ended_now(self) -> Decision | None:
        return self.verifier.decision_if_ended_now() if self.looks else super().decision_if_ended_now()

    def wait(self, passed: float) -> None:
        super().wait(passed)
        self.verifier.wait(passed)

    def follow(self, camera: CameraStep, kept: Sequence[KeptLook]) -> None:
        self.verifier.follow(camera, self.frame)
        candidate = self.candidate
        if candidate is not None and not bool(inside_frame(candidate.box, self.frame)):
            self.verifier.candidate = None  # a closer look would show another place
        if self.candidate is None:
            self._absence.follow(camera, kept)
            return  # the look that follows has facts of its own
        super().follow(camera, kept)
        if self._facts.looks:
            self.verifier.places.presence = self.prior(self._facts.presence())


def decisions_of(
    belief: ZoomBelief, settings: DecisionSettings, forgetting: Forgetting | None = None
) -> WindowDecisions:
    """Make the decisions of a search with evidence, by the kind of picture and the settings.

    Evidence for large pictures has two sets of fitted thresholds. That for photographs has one, which serves as both:

        thresholds   of presence: its `stop_below` ends searches, and its `confirm` finds where no closer look is made
        places       of places after closer looks: its `confirm` finds. None for no closer looks

    Places take the `stop_below` of presence, too, which the setting replaces. The setting `confirm` replaces the
    threshold of places, or without closer looks the threshold of presence. In files of models `stop_below` is named
    `give_up`.

    Args:
        belief: the belief of the search, before the first look.
        settings: thresholds, number of closer looks, and prior; None takes what was fitted.
        forgetting: how evidence fades in a stream.

    Returns:
        The decisions: by closer looks where their thresholds are fitted, unless the settings ask for none.
    """
    photograph = belief.photograph
    fades = forgetting is not None and forgetting.rate > 0
    prior = _prior_of(settings.prior, photograph, belief.target)
    facts = SearchFacts(belief, latest=fades)
    if photograph is None:
        fitted = belief.evidence.thresholds
        of_places = belief.evidence.places
        most = CLOSER
    else:
        fitted = of_places = photograph.thresholds
        most = MOST_IN_PHOTOGRAPH
    if settings.closer is not None:
        most = settings.closer
    thresholds = (fitted or _DEFAULTS).changed(stop_below=settings.stop_below)
    if not most or of_places is None:
        return DecisionsByPresence(facts, thresholds.changed(settings.confirm), prior, forgetting)
    of_places = of_places.changed(settings.confirm, thresholds.stop_below)
    if photograph is not None:
        # After the look at the whole only closer looks are left, each worth a pass by the probability of its place.
        of_places = of_places.changed(place=thresholds.stop_below)
    return DecisionsByCloserLooks(facts, ObjectVerifier(ObjectPlaces(facts, forgetting, prior), of_places, most))


def _prior_of(prior: PriorLike, photograph: PhotographEvidence | None, target: int) -> Prior:
    """Compare the share that was given with that of the fit, which for large pictures is one half."""
    if photograph is None:
        # `GlimpseEvidence.presence` takes a target in half of the searches, for all classes.
        return Prior.of(prior, EVEN)
    shares = photograph.shares
    return Prior.of(prior, None if shares is None else float(shares[target - 1]))
