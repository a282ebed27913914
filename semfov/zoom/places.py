"""What the looks of a search show of the target, and its places: the objects that they show."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from semfov.belief.prior import Prior
from semfov.data.inputs import FRAME
from semfov.decision import CandidatePlace, CandidatePlaces, CloseUp, Judgement, PlaceVerifier
from semfov.detection.detections import Detections
from semfov.detection.objects import Objects
from semfov.episode import Forgetting
from semfov.motion import CameraStep
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou
from semfov.observation.thresholds import Thresholds
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.certainty import BY_SCORE, LIKELY, Certainty
from semfov.zoom.closer import USUAL_WINDOW, closer_window
from semfov.zoom.hints import DETECTION_SCORE
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.objects import merge_with_facts

_NOTHING = 1e-3  # certainty of an object that looks do not show, and chance of a hit that is none
_NONE_LEFT = -1.0  # chance of a hit where no look is left, below a `stop_below` of 0, too: the search is over
_WHOLE = 0.9  # share of a picture from which on a window shows no more than the look at the whole
_AS_CLOSE = 0.5  # share of the magnification of a closer look from which on a look places objects about as exactly


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
    def places(self) -> tuple[Objects, Tensor]:
        """List the objects of the target, with the probability `(M,)` that a search finds it where each is."""
        objects, chances = self.objects()
        return objects, self.at_place(chances)

    @torch.no_grad()
    def at_place(self, certainty: Tensor) -> Tensor:
        """Compute the probability that a search finds the target where an object is.

        Args:
            certainty: `(...)`, probabilities of objects.

        Returns:
            `(...)`; in a large picture they are the same.
        """
        photograph = self.belief.photograph
        return certainty if photograph is None else photograph.at_place(certainty).sigmoid()

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


class TargetFacts(NamedTuple):
    """What is known of the target after one look of a search, by the prior of the fit, and what the look shows.

    Attributes:
        detections: what the look shows (`WindowLook.detections`).
        next_index: index of the next look of the path, from 0.
        presence: probability that the picture holds the target.
        hit_chance: chance that the best remaining window shows the target.
        window: that of the look; None if it does not matter.
    """

    detections: Detections
    next_index: int
    presence: float
    hit_chance: float
    window: Window | None = None


class _WholeLook(NamedTuple):
    """The look at the whole of the present frame: its number in the path, and what it shows."""

    number: int
    detections: Detections


class ObjectPlaces(CandidatePlaces[TargetFacts]):
    """Objects of the target, each with the probability that it is there, by all looks that count.

    This one number tells which place is looked at closely next, and how probable a place is after a closer look, which
    is one more look. With another prior than that of the fit a place keeps its share of the picture's probability
    (`semfov.belief.prior.Prior`). In a stream the objects are those in the present frame. An object that fills the
    picture needs no closer look: the look at the whole shows it as closely.

    Attributes:
        facts: what the looks of the search have shown.

    Private attributes: `_look` is the last look of the search. `_whole` is the look at the whole of the present
    picture; None before it, and where other frames or a motion of the camera have followed. `_latest_showing` has the
    box of the place that was asked for last, and its window.
    """

    _look: TargetFacts

    def __init__(self, facts: SearchFacts, forgetting: Forgetting | None = None, prior: Prior | None = None) -> None:
        super().__init__(forgetting, prior)
        photograph = facts.belief.photograph
        self.facts = facts
        self.target = facts.belief.target
        self._lattice = facts.belief.lattice
        self._is_large = photograph is None
        self._window = USUAL_WINDOW if photograph is None else photograph.window
        self._whole: _WholeLook | None = None
        self._latest_showing: tuple[Tensor, Window] | None = None

    def see(self, look: TargetFacts) -> None:
        """Take in a look of the search. Looks before the first one that shows the target may be left out."""
        self._look = look
        self._next = look.next_index
        self.detections = look.detections
        self.presence = self.prior(look.presence)

    @property
    def hit_chance(self) -> float:
        """Chance that the best window that was not looked at shows the target; below 0 if none is left.

        In a photograph only closer looks are left after the whole: it is that of the next one.
        """
        if not self._is_large:
            _, worth = self._surest()
            return worth
        if self._look.hit_chance == 0:
            return _NONE_LEFT
        return self.prior.at_place(self._look.hit_chance, self._look.presence)

    def due(self, thresholds: Thresholds, *, last: bool) -> CandidatePlace | None:
        """Take the surest object that was not examined, if it is likely, or at the end as probable as `place`."""
        surest, worth = self._surest()
        return surest if worth >= (thresholds.place if last else LIKELY) else None

    def _surest(self) -> tuple[CandidatePlace | None, float]:
        """Find the surest object that was not examined, if any, and the chance of a hit for which it is looked at.

        In a photograph this chance is no larger than that by the prior of the fit: of fainter objects the fit knows
        nothing, however frequent the target is.
        """
        objects, chances = self.facts.places()
        chances = chances.masked_fill(self._are_examined(objects.boxes), 0)
        if not bool((chances > 0).any()):
            return None, _NONE_LEFT
        surest = int(chances.argmax())
        fitted = float(chances[surest])
        probability = self._with_prior(fitted)
        worth = probability if self._is_large else min(fitted, probability)
        if worth < _NOTHING:
            return None, _NONE_LEFT
        return CandidatePlace(objects.boxes[surest], float(objects.scores[surest]), probability), worth

    def object_at(self, box: Tensor) -> tuple[float, Tensor]:
        """Find the surest object at a place.

        Args:
            box: `(4,)`.

        Returns:
            The probability that it is there, by the prior of the fit, and its box `(4,)`; for none that of an object
            that is hardly there, and the same box.
        """
        objects, chances = self.facts.places()
        overlaps = box_iou(objects.boxes, box[None].to(objects.boxes))[:, 0]
        chances_there = chances * (overlaps >= SAME_OBJECT_IOU)
        if not bool((chances_there > 0).any()):
            return float(self.facts.at_place(torch.tensor(_NOTHING))), box
        surest = int(chances_there.argmax())
        return float(chances_there[surest]), objects.boxes[surest]

    def probability(self, look: CloseUp) -> float:
        """Probability that the target is at the place of a closer look, by all looks that count now."""
        place, _ = self.object_at(look.box)
        return self._with_prior(place)

    def _with_prior(self, place: float) -> float:
        """Change the probability of a place from the prior of the fit."""
        return self.prior.at_place(place, self.facts.presence())

    def keep_whole(self, number: int, detections: Detections) -> None:
        """Keep what the look at the whole of the present frame shows: no closer look at what fills it is needed.

        Args:
            number: number of the look in the path, from 0.
            detections: what it shows, a batch of one.
        """
        self._whole = _WholeLook(number, detections)

    def shown_at(self, candidate: CandidatePlace) -> Detections | None:
        """Find what the look at the whole showed of a place, if it is as close; None elsewhere."""
        look = self._whole_showing(candidate)
        return None if look is None else look.detections

    def _whole_showing(self, candidate: CandidatePlace) -> _WholeLook | None:
        """Find the look at the whole, if it shows a place as closely as a closer look; None elsewhere."""
        return self._whole if self._showing(candidate).is_overview else None

    def closer_magnification(self, candidate: CandidatePlace) -> float:
        """Compute the magnification of the window of a closer look."""
        return self._showing(candidate).fixation[2]

    def places_exactly(self, box: Tensor, magnification: float) -> bool:
        """Tell whether the last look is about as close as a closer look, and its border does not cut a box."""
        window = self._look.window
        if window is None:
            return True
        left, top, right, bottom = window.region(self._lattice)
        width, height = self._lattice.size
        x1, y1, x2, y2 = box.tolist()
        is_inside_across = (x1 >= left or left <= 0) and (x2 <= right or right >= width)
        is_inside_down = (y1 >= top or top <= 0) and (y2 <= bottom or bottom >= height)
        return is_inside_across and is_inside_down and window.fixation[2] >= _AS_CLOSE * magnification

    def _showing(self, candidate: CandidatePlace) -> Window:
        """Find the window that shows a place closely, which is asked for several times in turn."""
        if self._latest_showing is None or self._latest_showing[0] is not candidate.box:
            self._latest_showing = candidate.box, self._window_showing(candidate)
        return self._latest_showing[1]

    def _window_showing(self, candidate: CandidatePlace) -> Window:
        """Choose the window of a closer look at a place, or the whole picture where it shows no more."""
        window = closer_window(self._lattice, candidate.box, self._window)
        x1, y1, x2, y2 = window.region(self._lattice)
        if (x2 - x1) * (y2 - y1) >= _WHOLE * math.prod(self._lattice.size):
            return Window.overview(self._lattice)
        return window

    def count_look(self, candidate: CandidatePlace) -> None:
        """Give the look the next number, or that of the look at the whole where it shows the place as closely."""
        whole = self._whole_showing(candidate)
        if whole is None:
            super().count_look(candidate)
        else:
            self._index = whole.number

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass."""
        super().wait(passed)
        # An earlier frame showed another scene.
        if self.forgetting.rate:
            self._whole = None

    def follow(self, camera: CameraStep) -> None:
        """Carry examined places along with the camera, whose frame shows others now."""
        self._whole = None
        super().follow(camera)


class ObjectVerifier(PlaceVerifier[TargetFacts]):
    """Decides a search by windows: a place is as probable as the object of the target there.

    A closer look is one more look at the picture, which `facts` have before it is judged. The place
    has the probability of the surest object whose box overlaps that of the candidate, and its box. The probability of
    the picture is that after all looks, and no smaller than that of the place.

    In a stream a place fades towards the object that the looks show there now, and the picture's probability does not
    fade.
    """

    places: ObjectPlaces

    def _judge(self, candidate: CandidatePlace, detections: Detections) -> Judgement:
        places = self.places
        places.count_look(candidate)
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
