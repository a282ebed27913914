"""What the looks of a search show of the target, and its places in a large picture: the objects that they show."""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.prior import Prior
from semfov.decision import CandidatePlace, CloseUp, Judgement, PlaceVerifier
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.episode import Forgetting
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.observation.thresholds import Thresholds
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.certainty import BY_SCORE, LIKELY, Certainty
from semfov.zoom.closer import TargetFacts, WindowPlaces
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.looks import WindowLook
from semfov.zoom.objects import merge_with_facts

_NOTHING = 1e-3  # probability of a place where looks show no object of the target


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
    `_objects` and `_presence` are those of `looks`, or None; what changes these clears both.
    """

    def __init__(self, belief: ZoomBelief, *, latest: bool = False) -> None:
        self.belief = belief
        self.latest = latest
        self.looks: list[_LookFacts] = []
        self.best = 0.0
        self.box: Tensor | None = None
        self.detected = False
        self._objects: tuple[Objects, Tensor] | None = None  # once they were asked for
        self._presence: float | None = None

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
        self._presence = None

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
        return float(chances.sum()) + float(unseen)

    def presence(self) -> float:
        """Predict whether the picture holds the target, by the prior of the fit."""
        if self._presence is None:
            self._presence = self._predicted_presence()
        return self._presence

    @torch.no_grad()
    def _predicted_presence(self) -> float:
        """Predict the presence by the evidence for a photograph, or for a larger picture."""
        best = torch.tensor(self.best)
        photograph = self.belief.photograph
        if photograph is not None:
            return float(photograph.presence(best, torch.tensor(self.belief.target)).sigmoid())
        return float(self.belief.evidence.presence(best, torch.tensor(self.expected())).sigmoid())


class ObjectPlaces(WindowPlaces):
    """Objects of the target in a large picture, each with the probability that it is there, by all looks that count.

    This one number tells which place is looked at closely next, and how probable a place is after a closer look, which
    is one more look. With another prior than that of the fit a place keeps its share of the picture's probability
    (`semfov.belief.prior.Prior`). In a stream the objects are those in the present frame.

    Attributes:
        facts: what the looks of the search have shown.
    """

    def __init__(self, facts: SearchFacts, forgetting: Forgetting | None = None, prior: Prior | None = None) -> None:
        super().__init__(facts.belief.target, facts.belief.lattice, forgetting, prior)
        self.facts = facts

    @property
    def hit_chance(self) -> float:
        """Chance that the best window that was not looked at shows the target."""
        return self.prior.at_place(self._look.hit_chance, self._look.presence)

    def due(self, thresholds: Thresholds, *, last: bool) -> CandidatePlace | None:
        """Take the surest object that was not examined, if it is likely, or at the end as probable as `place`."""
        objects, chances = self.facts.objects()
        chances = chances.masked_fill(self._are_examined(objects.boxes), 0)
        if not len(chances):
            return None
        surest = int(chances.argmax())
        probability = self._with_prior(float(chances[surest]))
        if probability < max(thresholds.place if last else LIKELY, _NOTHING):
            return None
        return CandidatePlace(objects.boxes[surest], float(objects.scores[surest]), probability)

    def object_at(self, box: Tensor) -> tuple[float, Tensor]:
        """Find the surest object at a place.

        Args:
            box: `(4,)`.

        Returns:
            The probability that it is there, by the prior of the fit, and its box `(4,)`; for none the least one, and
            the same box.
        """
        objects, chances = self.facts.objects()
        overlaps = box_iou(objects.boxes, box[None].to(objects.boxes))[:, 0]
        chances_there = chances * (overlaps >= SAME_OBJECT_IOU)
        if not bool((chances_there > 0).any()):
            return _NOTHING, box
        surest = int(chances_there.argmax())
        return float(chances_there[surest]), objects.boxes[surest]

    def probability(self, look: CloseUp) -> float:
        """Probability that the target is at the place of a closer look, by all looks that count now."""
        place, _ = self.object_at(look.box)
        return self._with_prior(place)

    def _with_prior(self, place: float) -> float:
        """Change the probability of a place from the prior of the fit."""
        return self.prior.at_place(place, self.facts.presence())


class ObjectVerifier(PlaceVerifier[TargetFacts]):
    """Decides a search of a large picture: a place is as probable as the object of the target there.

    A closer look is one more look at the picture, which `facts` have before it is judged. The place
    has the probability of the surest object whose box overlaps that of the candidate, and its box. The probability of
    the picture is that after all looks, and no smaller than that of the place.

    In a stream a place fades towards the object that the looks show there now, and the picture's probability does not
    fade.
    """

    places: ObjectPlaces

    def _judge(self, candidate: CandidatePlace, detections: Detections) -> Judgement:
        places = self.places
        places.telling(candidate, detections)
        place, box = places.object_at(candidate.box)
        places.dismiss(candidate, box)
        prior = places.prior
        presence = places.facts.presence()
        places.presence = prior(presence)
        return Judgement(prior.at_place(place, presence), prior(max(presence, place)), box)

    @property
    def presence(self) -> float:
        """Probability that the picture holds the target: that after all looks, closer ones too, or the surest place."""
        return max([self.places.presence, *(judged.probability for judged in self._judged_places)])
