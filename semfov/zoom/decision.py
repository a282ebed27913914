"""Decisions of a search by windows: the facts about its looks, and the outcome after each and after closer looks."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

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
    Judgement,
    PlaceVerifier,
    Verifier,
    settle,
)
from semfov.decision.rule import EVEN_CHANCE
from semfov.decision.state import DecisionState
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.episode import Forgetting
from semfov.motion import CameraStep
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou, inside_frame
from semfov.observation.presence import EVEN
from semfov.observation.thresholds import Thresholds
from semfov.settings import DecisionSettings
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.certainty import BY_SCORE, Certainty
from semfov.zoom.closer import MOST_IN_PHOTOGRAPH, CandidateBoxes, PhotographPlaces, TargetFacts
from semfov.zoom.episode import KeptLook, WindowStep
from semfov.zoom.evidence import PhotographEvidence
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge_with_facts


class _LookFacts(NamedTuple):
    """What one look of a search shows of the target.

    Attributes:
        look: the look.
        score: highest score of the target, hints included.
        found: highest score of a detection.
        box: box `(4,)` of that detection; None without a detection.
    """

    look: WindowLook
    score: float
    found: float
    box: Tensor | None


class SearchFacts:
    """What the looks of a search have shown of the target.

    Attributes:
        belief: the belief of the search.
        latest: whether later looks replace what earlier ones showed, as in a stream that forgets.
        looks: what each look that counts shows.
        best: highest score of the target in all looks.
        box: box `(4,)` of the detection with the highest score; None without a detection.
        detected: whether a detection shows the target.

    Invariant: `best`, `box` and `detected` sum up `looks`, of which there is at least one after `see` and `add`.
    `_objects` are those of `looks`, or None; what changes these clears it.
    """

    def __init__(self, belief: ZoomBelief, *, latest: bool = False) -> None:
        self.belief = belief
        self.latest = latest
        self.looks: list[_LookFacts] = []
        self.best = 0.0
        self.box: Tensor | None = None
        self.detected = False
        self._objects: tuple[Objects, Tensor] | None = None  # once they were asked for

    def see(self, looks: Sequence[WindowLook]) -> None:
        """Take the looks that count now; those that were carried along are others, and show what is in view."""
        # By identity, since looks hold tensors, which have no one truth.
        known = {id(facts.look): facts for facts in self.looks}
        self.looks = [known.get(id(look)) or self._facts_of(look) for look in looks]
        self._sum_up()

    def add(self, look: WindowLook) -> None:
        """Take in one look."""
        self.looks.append(self._facts_of(look))
        self._sum_up()

    def _sum_up(self) -> None:
        """Find what all looks have shown; there must be one."""
        self.best = max(facts.score for facts in self.looks)
        surest = max(self.looks, key=lambda facts: facts.found)
        self.box = surest.box if surest.found > 0 else None
        self.detected = surest.found >= DETECTION_SCORE
        self._objects = None

    def _facts_of(self, look: WindowLook) -> _LookFacts:
        """Read from a look what it shows of the target."""
        target = self.belief.target
        score = float(look.show[target - 1])
        scores = look.detections.scores[0, :, target].detach().float().numpy()
        if not len(scores):
            return _LookFacts(look, score, found=0.0, box=None)
        best = int(scores.argmax())
        return _LookFacts(look, score, float(scores[best]), look.detections.boxes[0, best])

    @property
    def _certainty(self) -> Certainty:
        return self.belief.evidence.certainty_in(self.belief.lattice) or BY_SCORE

    @torch.no_grad()
    def objects(self) -> tuple[Objects, Tensor]:
        """List the objects of the target that looks show, with the probability `(M,)` that each is there."""
        if self._objects is None:
            looks = [facts.look for facts in self.looks]
            belief = self.belief
            objects, facts = merge_with_facts(looks, belief.lattice, belief.target, latest=self.latest)
            self._objects = objects, self._certainty.probability(facts)
        return self._objects

    @torch.no_grad()
    def expected(self) -> float:
        """Estimate how many objects of the target there are: those that looks show, and those that looks would find."""
        _, chances = self.objects()
        unseen, _ = self._certainty.unseen(self.belief.remaining(), promised=0.0, discoveries=0.0)
        return float(chances.sum()) + unseen

    @torch.no_grad()
    def presence(self) -> float:
        """Predict whether the picture holds the target, by the prior of the fit."""
        best = torch.tensor(self.best)
        photograph = self.belief.photograph
        if photograph is not None:
            return float(photograph.presence(best, torch.tensor(self.belief.target)).sigmoid())
        return float(self.belief.evidence.presence(best, torch.tensor(self.expected())).sigmoid())


_NOTHING = 1e-3  # probability of a place where looks show no object of the target


class ObjectVerifier(PlaceVerifier[TargetFacts]):
    """Decides a search of a large picture: a place is as probable as the object of the target there.

    A closer look is one more look at the picture, which `facts` have before it is judged (`SearchFacts.add`). The place
    has the probability of the surest object whose box overlaps that of the candidate, and its box. The probability of
    the picture is that after all looks, and no smaller than that of the place.

    In a stream a place fades towards the object that the looks show there now, and the picture's probability does not
    fade.

    Attributes:
        facts: what the looks of the search have shown.
    """

    def __init__(self, facts: SearchFacts, places: CandidateBoxes, thresholds: Thresholds, most: int) -> None:
        super().__init__(places, thresholds, most)
        self.facts = facts

    def _judge(self, candidate: CandidatePlace, detections: Detections) -> Judgement:
        self.places.telling(candidate, detections)
        place, box = self._object_at(candidate.box)
        presence = self.facts.presence()
        self.places.dismiss(candidate, box)
        prior = self.places.prior
        self.places.presence = prior(presence)
        at_least = max(presence, place)
        return Judgement(prior.at_place(place, at_least), prior(at_least), box)

    @property
    def presence(self) -> float:
        """Probability that the picture holds the target: that after all looks, closer ones too, or the surest place."""
        return max([self.places.presence, *(judged.probability for judged in self._judged_places)])

    def _believed(self, look: CloseUp) -> float:
        # Scores of candidates would be compared with that of the closer look itself.
        place, _ = self._object_at(look.box)
        prior = self.places.prior
        return prior.at_place(place, max(prior.inverse(self.places.presence), place))

    def _object_at(self, box: Tensor) -> tuple[float, Tensor]:
        """Find the surest object at a box `(4,)`: its probability and its box; `_NOTHING` and the same box for none."""
        objects, chances = self.facts.objects()
        overlaps = box_iou(objects.boxes, box[None].to(objects.boxes))[:, 0]
        chances_there = chances * (overlaps >= SAME_OBJECT_IOU)
        if not bool((chances_there > 0).any()):
            return _NOTHING, box
        surest = int(chances_there.argmax())
        return float(chances_there[surest]), objects.boxes[surest]


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

    def examine(self, look: WindowLook) -> None:
        """Judge the candidate by a closer look, and choose the next one."""

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
    rather holds the target, or the camera has lost the scene.
    """

    def __init__(self, forgetting: Forgetting | None) -> None:
        fades = forgetting is not None and forgetting.rate > 0
        self._longest = forgetting.span if forgetting is not None and fades else 0.0
        self._age = math.inf  # seconds since the target was absent

    def wait(self, passed: float) -> None:
        """Let seconds pass."""
        self._age += passed

    def end(self) -> None:
        """Let it end, as the scene is another one."""
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

    The probability that the picture holds the target takes time, and is computed where it can matter.

    Invariant: `_presence` is that of the present `_facts`, or None; what changes these clears it.
    """

    def __init__(
        self, facts: SearchFacts, thresholds: Thresholds, prior: Prior, forgetting: Forgetting | None = None
    ) -> None:
        self._absence = LastingAbsence(forgetting)
        self.thresholds = thresholds
        self.prior = prior
        self.criterion = f"p is {thresholds.confirm:g} and a detection shows the target"
        self._facts = facts
        self._is_large = facts.belief.photograph is None
        self._fitted_chance = 0.0  # chance of a hit after the last look, by the prior of the fit
        self._presence: float | None = None  # that after the last look, once it was asked for
        self._step: WindowStep[ZoomBelief | None] | None = None  # the last one

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        self._step = step
        self._facts.see(self._telling(step, kept))
        self._fitted_chance = step.next_value
        self._presence = None
        self.outcome = GO_ON
        if not self._goes_on():
            # With one pass left no other look follows a closer one, so that less probable places are due, too.
            self._judge(step, number, last=step.next_value == 0 or room <= 1)
        if self._facts.latest:
            self._absence.see(self._latest_decision)

    def _telling(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook]) -> list[WindowLook]:
        """List the looks that tell of the picture; a closer look at a photograph tells of its place alone."""
        return [look.current for look in kept] if self._is_large else step.looks

    def _goes_on(self) -> bool:
        """Whether the search goes on, whatever the presence is: nothing was found, and a look is worth a pass."""
        if not self._is_large or self._facts.detected or self.looks:
            return False
        return self._hit_chance() >= self.thresholds.stop_below

    def _judge(self, step: WindowStep[ZoomBelief | None], number: int, *, last: bool) -> None:
        """Decide after a step."""
        presence = torch.tensor([self.prior(self._fitted_presence())])
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
        return Decision(outcome, self.prior(self._fitted_presence()), None, box, confirm=self.thresholds.confirm)

    def wait(self, passed: float) -> None:
        self._absence.wait(passed)

    def follow(self, camera: CameraStep, kept: Sequence[KeptLook]) -> None:
        if camera.motion is None:
            self._absence.end()
        looks = [] if camera.motion is None or self._step is None else self._telling(self._step, kept)
        if looks:
            self._facts.see(looks)
            self._presence = None

    def _fitted_presence(self) -> float:
        """Probability that the picture holds the target after the last look, by the prior of the fit."""
        if self._presence is None:
            self._presence = self._facts.presence()
        return self._presence

    def _hit_chance(self) -> float:
        """Chance that the best remaining window shows the target."""
        if self.prior.changes_nothing:
            return self._fitted_chance  # without the presence, which takes time
        return self.prior.at_place(self._fitted_chance, self._fitted_presence())


class DecisionsByCloserLooks(DecisionsByPresence):
    """Decisions of a search by closer looks at the places that seem to hold the target: by certainty, or verified."""

    def __init__(
        self, facts: SearchFacts, prior: Prior, verifier: PlaceVerifier[TargetFacts], places: CandidateBoxes
    ) -> None:
        super().__init__(facts, verifier.thresholds, prior, places.forgetting)
        self.frame = facts.belief.lattice.size
        self.verifier = verifier
        self.places = places  # those of the verifier
        self.criterion = verifier.criterion

    def see(self, step: WindowStep[ZoomBelief | None], kept: Sequence[KeptLook], number: int, room: float) -> None:
        if step.look.window.is_overview:
            self.places.keep_whole(number - 1, step.look.candidates)
        super().see(step, kept, number, room)

    def _judge(self, step: WindowStep[ZoomBelief | None], number: int, *, last: bool) -> None:
        """Choose the place of the next closer look, and decide."""
        candidates = step.look.candidates
        presence = self._fitted_presence()
        look = TargetFacts(candidates, number, presence, self._facts.best, self._fitted_chance, step.look.window)
        self.verifier.see(look, last=last)
        self._examine_shown()

    @property
    def candidate(self) -> CandidatePlace | None:
        return self.verifier.candidate

    @property
    def looks(self) -> list[CloseUp]:
        return self.verifier.looks

    def examine(self, look: WindowLook) -> None:
        if self._is_large:
            self._facts.add(look)
            self._presence = None
        self.verifier.examine(look.candidates)
        self._examine_shown()

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
        if camera.motion is None:
            self._absence.end()
        candidate = self.candidate
        if candidate is not None and not bool(inside_frame(candidate.box, self.frame)):
            self.verifier.candidate = None  # a closer look would show another place
        if self.candidate is None:
            return  # the look that follows has facts of its own
        super().follow(camera, kept)
        if self._facts.looks:
            self.verifier.places.presence = self.prior(self._fitted_presence())


def decisions_of(
    belief: ZoomBelief, settings: DecisionSettings, forgetting: Forgetting | None = None
) -> WindowDecisions:
    """Make the decisions of a search with evidence, by the kind of picture and the settings.

    Evidence for large pictures has two sets of fitted thresholds, that for photographs one:

        `GlimpseEvidence.thresholds`   of presence: its `stop_below` ends searches, and a box is looked at closely from
                                       its `confirm` on, which the setting does not change
        `GlimpseEvidence.places`       of places after closer looks: its `confirm` finds. None for no closer looks

    The setting `stop_below` replaces that of presence. The setting `confirm` replaces that of places, and where no
    closer look is made that of presence. In files of models `stop_below` is named `give_up`.

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
        fitted = of_places = photograph.verification.thresholds
        most = MOST_IN_PHOTOGRAPH
    if settings.closer is not None:
        most = settings.closer
    thresholds = (fitted or _DEFAULTS).changed(stop_below=settings.stop_below)
    if not most or of_places is None:
        return DecisionsByPresence(facts, thresholds.changed(settings.confirm), prior, forgetting)
    of_places = of_places.changed(settings.confirm, thresholds.stop_below)
    places: CandidateBoxes
    verifier: PlaceVerifier[TargetFacts]
    if photograph is None:
        places = CandidateBoxes(belief.target, thresholds.confirm, belief.lattice, forgetting, prior)
        verifier = ObjectVerifier(facts, places, of_places, most)
    else:
        places = PhotographPlaces(belief.target, belief.lattice, forgetting, photograph.window, prior)
        verifier = Verifier(photograph.verification, places, of_places, most)
    return DecisionsByCloserLooks(facts, prior, verifier, places)


def _prior_of(prior: PriorLike, photograph: PhotographEvidence | None, target: int) -> Prior:
    """Compare the share that was given with that of the fit, which for large pictures is one half."""
    if photograph is None:
        # `GlimpseEvidence.presence` takes a target in half of the searches, for all classes.
        return Prior.of(prior, EVEN)
    shares = photograph.shares
    return Prior.of(prior, None if shares is None else float(shares[target - 1]))
