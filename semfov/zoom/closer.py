"""Closer looks of a search by windows: the places of photographs, and the windows that show a place closely."""

import math
from functools import cached_property, reduce
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from semfov.belief.prior import Prior
from semfov.data.inputs import FRAME
from semfov.decision import CandidatePlace, CandidatePlaces, CloseUp
from semfov.detection.detections import Detections
from semfov.episode import Forgetting
from semfov.motion import CameraStep, LostScene, Motion
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou, inside_frame
from semfov.observation.thresholds import Thresholds
from semfov.sensor.glimpse import CONTEXT, window_around
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook, WindowLooks

# A smaller window shows the place equally well, but fewer other places.
USUAL_WINDOW = 0.6, 2.0
"""Least side of that window in a photograph, in longer sides of the photograph, and its side in those of the box."""

MOST_IN_PHOTOGRAPH = 3
"""Default for the largest number of closer looks in a photograph: more would go to the objects of a crowd."""

_WHOLE = 0.9  # share of a picture from which on a window shows no more than the look at the whole

_AS_CLOSE = 0.5  # share of the magnification of a closer look from which on a look places objects about as exactly
_SMALLEST = 1e-4  # probability below which, and below 1 less it, one counts as this in log odds


def closer_window(lattice: Lattice, box: Tensor, window: tuple[float, float] = USUAL_WINDOW) -> Window:
    """Choose the window of a closer look around a box.

    Args:
        lattice: windows of the picture.
        box: `(4,)` in picture pixels.
        window: least side and context of the window in a photograph (`USUAL_WINDOW`). In a larger picture it has three
            times the longer side of the box, and at least half of the closest window.

    Returns:
        The window.
    """
    least, context = window
    if lattice.levels > 1:
        context = CONTEXT
        # At most one octave beyond the last level: such windows told right places from wrong ones best.
        least = min(lattice.canvas) / (2 * lattice.magnifications[-1]) / max(lattice.size)
    x1, y1, x2, y2 = window_around(box.double(), lattice.size, context=context, least=least).tolist()
    return Window.around(lattice, (x1, y1, x2, y2))


def look_closely(source: WindowLooks, box: Tensor, window: tuple[float, float] = USUAL_WINDOW) -> WindowLook:
    """Look at the window that shows a box closely (`closer_window`).

    Args:
        source: looks at the picture.
        box: `(4,)` in picture pixels.
        window: size of the window in a photograph.

    Returns:
        The look.
    """
    return source.see([closer_window(source.lattice, box, window)])[0]


class TargetFacts(NamedTuple):
    """What is known of the target after one look of a search, by the prior of the fit, and what the look shows.

    Attributes:
        detections: what may hold the target (`WindowLook.candidates`).
        next_index: index of the next look of the path, from 0.
        presence: probability that the picture holds the target.
        best: highest score of the target in any look.
        hit_chance: chance that the best remaining window shows the target.
        window: that of the look; None if it does not matter.
    """

    detections: Detections
    next_index: int
    presence: float
    best: float
    hit_chance: float
    window: Window | None = None


class _Scored(NamedTuple):
    """Boxes `(M, 4)` of the target in several looks, the scores `(M,)`, and which the present frame shows `(M,)`."""

    boxes: Tensor
    scores: Tensor
    in_view: Tensor

    def joined(self, others: "_Scored") -> "_Scored":
        """Append the boxes of a later look."""
        return _Scored(*map(torch.cat, zip(self, others, strict=True))) if len(self.boxes) else others

    def last(self, count: int) -> "_Scored":
        """Take the last boxes."""
        first = len(self.boxes) - count
        return _Scored(*(column[first:] for column in self)) if first else self

    def moved(self, motion: Motion, size: tuple[int, int]) -> "_Scored":
        """Move the boxes with the camera; those that come to lie behind it count no more."""
        if not len(self.boxes):
            return self
        boxes, are_ahead = motion.boxes_ahead(self.boxes)
        return _Scored(boxes, self.scores * are_ahead.to(self.scores.device), inside_frame(boxes, size))


class _ShownWindow(NamedTuple):
    """A window that was looked at: the number of the look in the path, and what it shows."""

    number: int
    detections: Detections


class WindowPlaces(CandidatePlaces[TargetFacts]):
    """Base of the places of a picture that is looked at by windows, and of the windows that show them closely.

    An object that fills the picture needs no closer look: the look at the whole shows it as closely.

    Private attributes: `_look` is the last look of the search. `_shown` has what windows of the present picture showed:
    that of the whole, unless other frames or a motion of the camera have followed. `_latest_showing` has the box of the
    place that was asked for last, and its window.
    """

    _look: TargetFacts

    def __init__(
        self,
        target: int,
        lattice: Lattice,
        forgetting: Forgetting | None = None,
        prior: Prior | None = None,
        window: tuple[float, float] = USUAL_WINDOW,
    ) -> None:
        super().__init__(forgetting, prior)
        self.target = target
        self._lattice = lattice
        self._window = window
        self._shown: dict[Window, _ShownWindow] = {}
        self._latest_showing: tuple[Tensor, Window] | None = None

    def see(self, look: TargetFacts) -> None:
        """Take in a look of the search. Looks before the first one that shows the target may be left out."""
        self._look = look
        self._next = look.next_index
        self.detections = look.detections
        self.presence = self.prior(look.presence)

    def keep_whole(self, number: int, detections: Detections) -> None:
        """Keep what the look at the whole of the present frame shows: no closer look at what fills it is needed.

        Args:
            number: number of the look in the path, from 0.
            detections: what it shows, a batch of one.
        """
        self._shown[Window.overview(self._lattice)] = _ShownWindow(number, detections)

    def shown_at(self, candidate: CandidatePlace) -> Detections | None:
        """Find what the look at the window of a place showed; None where there was none."""
        look = self._shown.get(self._showing(candidate))
        return None if look is None else look.detections

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

    def shows_nothing_new(self, candidate: CandidatePlace) -> bool:
        """Tell whether the look at the whole of this frame, which is kept, shows a candidate as closely as any look."""
        window = self._showing(candidate)
        return window == Window.overview(self._lattice) and window in self._shown

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

    def telling(self, candidate: CandidatePlace, detections: Detections) -> Detections:
        """Count the look, unless the look at the whole shows the place as closely."""
        shown = self._shown.get(self._showing(candidate))
        if shown is None:
            return super().telling(candidate, detections)
        self._index = shown.number
        return detections

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass."""
        super().wait(passed)
        self._forget_windows()

    def _forget_windows(self) -> None:
        """Forget what windows of earlier frames showed, where the scene changes."""
        if self.forgetting.rate:
            self._shown.clear()

    def follow(self, camera: CameraStep, size: tuple[int, int]) -> None:
        """Carry examined places along with the camera, whose windows show others now."""
        self._shown.clear()
        super().follow(camera, size)


class PhotographPlaces(WindowPlaces):
    r"""Boxes of a photograph that seem to hold the target: the highest score s that overlaps no examined place.

    .. math:: \operatorname{logit} p = \operatorname{logit} P + \operatorname{logit} s - \operatorname{logit} s^*

    with the highest score :math:`s^*` of the search, which gives the probability P of the picture, both by the prior of
    the fit; with another one a place keeps its share of P (`semfov.belief.prior.Prior`). All places, hints among them,
    are examined at which the chance of a hit is large enough. It is :math:`v = p \, (1 - \max_i p_i)`, with those of
    the closer looks so far. In a stream scores fade, and places are forgotten when half of the evidence is left
    (`semfov.episode.Forgetting`).

    The place of an object that fills the picture is judged, and the picture keeps its P, as the same look says nothing
    new of it.

    Private attributes: `_scored` has the boxes of the target that looks have shown, where they lie in the present
    frame, and `_looks` the time of each of these looks, with its number of boxes.

    Invariant: `_scored` has the boxes of `_looks`, in their order. `_most_evident`, once it was computed, is that of
    `_scored`, the examined places and the present time. What changes one of these calls `_change`.
    """

    # As faint as hints begin, where a head has no limit of its own (`semfov.detection.detector.FAINT`).
    least = 0.002
    """Score from which on a box seems to hold the target."""

    exhaustive = True

    def __init__(
        self,
        target: int,
        lattice: Lattice,
        forgetting: Forgetting | None = None,
        prior: Prior | None = None,
        window: tuple[float, float] = USUAL_WINDOW,
    ) -> None:
        super().__init__(target, lattice, forgetting, prior, window)
        self._scored = _Scored(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0).bool())
        self._lost_boxes: LostScene[_Scored] = LostScene()

    def see(self, look: TargetFacts) -> None:
        """Take in a look of the search. Looks before the first one that shows the target may be left out."""
        self._change()
        super().see(look)
        scores = look.detections.scores[0, :, self.target]
        of_target = look.detections.mask[0] & (scores >= self.least)
        if bool(of_target.any()):
            boxes = look.detections.boxes[0][of_target]
            in_view = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
            self._looks.append((self._now, len(boxes)))
            self._scored = self._scored.joined(_Scored(boxes, scores[of_target], in_view))

    @property
    def hit_chance(self) -> float:
        """Chance of a hit at the most evident place; below 0 if there is none."""
        place = self._most_evident
        # Below a `stop_below` of 0, too, so that a search without places is over.
        return -1.0 if place is None else self._hit_chance_at(place)

    def due(self, thresholds: Thresholds, *, last: bool) -> CandidatePlace | None:
        """Take the most evident place, if the chance of a hit there is worth a pass."""
        place = self._most_evident
        return None if place is None or self._hit_chance_at(place) < thresholds.stop_below else place

    def telling(self, candidate: CandidatePlace, detections: Detections) -> Detections:
        """Count the look, unless its window was looked at before; objects that were examined are left out."""
        window = self._showing(candidate)
        if window not in self._shown:
            super().telling(candidate, detections)
            self._shown[window] = _ShownWindow(self._next - 1, detections)
        self._index = self._shown[window].number
        others = detections.mask & ~self._are_examined(detections.boxes[0])
        # Not a copy with another mask, whose highest scores would be those of what was examined, too.
        return Detections(detections.boxes, detections.scores, others, detections.confidence * others)

    @cached_property
    def _most_evident(self) -> CandidatePlace | None:
        """The box with the highest faded score that is of no examined place; None if there is none.

        It is asked for several times after each look, and computed anew after what may change it.
        """
        boxes, scores = self._scored_boxes
        if self._examined:
            scores = scores.masked_fill(self._are_examined(boxes), 0)
        if not len(scores):
            return None
        best = int(scores.argmax())
        score = float(scores[best])
        return CandidatePlace(boxes[best], score, self._chance(score)) if score > 0 else None

    def _change(self) -> None:
        """Drop what was computed of the looks and the examined places, as these change."""
        self.__dict__.pop("_most_evident", None)
        self.__dict__.pop("_scored_boxes", None)

    def dismiss(self, candidate: CandidatePlace, box: Tensor) -> None:
        """Do not list a candidate again, nor others at its place."""
        self._change()
        super().dismiss(candidate, box)

    def wait(self, passed: float = FRAME) -> None:
        """Let seconds pass."""
        self._change()
        super().wait(passed)
        # The looks that are forgotten are the oldest.
        self._scored = self._scored.last(sum(count for _, count in self._looks))

    def _forget_windows(self) -> None:
        """Forget what closer looks at earlier frames showed; the look at the whole is made anew in each frame."""
        if self.forgetting.rate:
            self._shown = {window: shown for window, shown in self._shown.items() if window.within is None}

    def follow(self, camera: CameraStep, size: tuple[int, int]) -> None:
        """Carry the boxes of the target along, too."""
        self._change()
        super().follow(camera, size)
        scenes = self._lost_boxes.follow(
            [self._scored], camera, lambda scenes, motion: [boxes.moved(motion, size) for boxes in scenes]
        )
        self._scored = reduce(_Scored.joined, scenes, self._scored.last(0))

    def probability(self, look: CloseUp) -> float:
        """Compute the present probability that the target is at the place of a closer look.

        Args:
            look: the closer look.

        Returns:
            The probability, by the detections that overlap the place.
        """
        boxes, scores = self._scored_boxes
        if not len(scores):
            return self._chance(0.0)
        overlaps = box_iou(boxes, look.box[None])[:, 0] >= SAME_OBJECT_IOU
        return self._chance(float((scores * overlaps).max()))

    @cached_property
    def _scored_boxes(self) -> tuple[Tensor, Tensor]:
        """Boxes `(M, 4)` of the target in view that count, and their scores `(M,)`, faded."""
        boxes, scores, in_view = self._scored
        shares_left = [self.forgetting.share_left(self._now - time) for time, _ in self._looks]
        counts = np.array([count for _, count in self._looks], dtype=int)
        share_of_box = np.repeat(shares_left, counts)
        faded_scores = scores * torch.from_numpy(share_of_box).to(scores)
        return boxes[in_view], faded_scores[in_view]

    def _chance(self, score: float) -> float:
        """Probability that the target is where the highest score is this one (the formula of the class)."""
        presence = self._look.presence
        logits = torch.tensor([presence, score, self._look.best]).logit(_SMALLEST)
        of_picture, of_score, of_best_score = logits
        chance = float((of_picture + of_score - of_best_score).sigmoid())
        return self.prior.at_place(chance, presence)

    def _hit_chance_at(self, place: CandidatePlace) -> float:
        """Chance that a look at a place shows the target, if no closer look so far has."""
        surest = max((place.probability for place in self._places if place.in_view), default=0.0)
        return place.probability * (1 - surest)
