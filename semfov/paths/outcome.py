"""What the looks of a record found: its objects, which of them were confirmed, and its decision."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import isnan, nan
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import torch
from torch import Tensor

from semfov.belief.prior import Prior, check_share
from semfov.data.classes import known_class
from semfov.decision import CloseUp, Decision
from semfov.detection.detections import Detections
from semfov.detection.objects import NO_TRACK, SCORE_THRESHOLD, Objects
from semfov.errors import InputError, check_whole
from semfov.kinds import LookKind
from semfov.observation.matching import SAME_OBJECT_IOU, box_iou, share_inside
from semfov.paths.files import Ending
from semfov.paths.look import RecordedLook
from semfov.paths.merging import FixationBoxes, distances_to, merge_fixations

_DOUBTFUL = 0.1  # probability from which on an absent target is only probably absent
_PART = 0.8  # share of a box in that of a listed object from which on it is a part of it
_CONFIRMING = 0.5  # probability from which on a closer look confirms that the target is there


def sought_classes(target: int | None, targets: tuple[int, ...]) -> tuple[int, ...]:
    """List the classes that are searched for: several, or the target; an empty list stands for all.

    >>> sought_classes(3, ()), sought_classes(None, (3, 5)), sought_classes(None, ())
    ((3,), (3, 5), ())
    """
    if target is None or targets:
        return targets
    return (target,)


class NumberByClass(dict[str, float]):
    """Numbers by the name of their class; as for targets, plurals and other spellings are understood."""

    def __missing__(self, name: str) -> float:
        """Return the number of the class that a name means."""
        names = list(self)
        return self[known_class(name, names, "expected")]

    def __contains__(self, name: object) -> bool:
        """Tell whether there is a number of the class that a name means."""
        return self.get(name) is not None

    def get(self, name: object, default: Any = None) -> Any:
        """Return the number for the class that a name means, or the default if there is none."""
        try:
            return self[str(name)]
        except InputError:
            return default

    if not TYPE_CHECKING:  # to which any name would be an attribute

        def __getattr__(self, name: str) -> object:
            remedy = f"use expected[{name!r}] for that of a class, and sum(expected.values()) for all"
            raise AttributeError(f"expected has no attribute {name!r}; {remedy}")


class _ConfirmedPlace(NamedTuple):
    """Place `(4,)` at which a closer look or the decision confirmed a class, and the number of the look."""

    box: Tensor
    label: int
    probability: float
    look: int


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class Outcome(ABC):
    """The looks of a record, what they found, and what was decided (`semfov.paths.Record`)."""

    classes: tuple[str, ...]
    target: int | None
    looks: tuple[RecordedLook, ...]
    found: bool = False
    closer: tuple[CloseUp, ...] = ()
    ending: Ending | None = None
    decision: Decision | None = None
    prior: float | None = None
    assumed: float | None = None
    targets: tuple[int, ...] = ()
    score_threshold: float = SCORE_THRESHOLD
    unseen: tuple[float, float] | None = None
    photograph: Tensor | None = None
    source: str | None = None
    shown: Mapping[str, Any] | None = None
    detector: str | None = None

    kind: ClassVar[LookKind]
    """Kind of look: of a fovea, at windows, or of a head that turns."""

    _goes_on: ClassVar[bool] = False
    """Whether further looks may follow, as after each frame of a stream, so that no decision is the last one."""

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture in pixels."""

    @property
    def how(self) -> str:
        """Name of the kind of look: `fovea`, `windows` or `head`."""
        return self.kind.name

    @property
    def fixated(self) -> tuple[RecordedLook, ...]:
        """The looks that move the gaze: with a fovea all but closer looks, otherwise all."""
        return self.looks

    @property
    def detections(self) -> tuple[Detections, ...]:
        """Detections of each look, batches of one."""
        return tuple(look.detections for look in self.looks)

    @property
    def seconds(self) -> tuple[Any, ...]:
        """Time at the end of each look, on the clock of the episode; empty if the times are not known."""
        times = tuple(look.seconds for look in self.looks)
        return () if None in times else times

    def __iter__(self) -> Iterator[RecordedLook]:
        """Go through the looks in their order."""
        return iter(self.looks)

    def __len__(self) -> int:
        """Return the number of looks, the first included."""
        return len(self.looks)

    def __getitem__(self, index: int) -> RecordedLook:
        """Return a look by its place, from 0; -1 is the last one."""
        if isinstance(index, slice) or hasattr(index, "__index__"):
            return self.looks[index]
        remedy = ""
        if isinstance(index, str):
            remedy = f"; its objects of a class are record.objects.of({index!r})"
            if hasattr(type(self), index) or index in vars(self):
                remedy = f"; it is record.{index}"
        raise InputError(f"record: expected the place of a look, from 0, got {index!r}{remedy}")

    def _place(self, index: int, argument: str = "index") -> int:
        """Count a look from the start; refuse one that the record has not."""
        count = len(self)
        check_whole(index, argument, -count, count - 1)
        return index % count

    @property
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""
        # A closer look that is no look of the record had a pass of its own.
        return len(self) + sum(look.index is None for look in self.closer)

    @property
    def target_name(self) -> str | None:
        """Name of the class that was searched for; None for all classes."""
        return None if self.target is None else self.classes[self.target]

    def probability_at(self, prior: float) -> float:
        r"""Return the probability of the decision for another share of pictures that hold the target.

        .. math:: \operatorname{logit} P' = \operatorname{logit} P + \operatorname{logit} \pi
                  - \operatorname{logit} \pi_{\mathrm{assumed}}

        (`semfov.belief.prior.with_prior`). This assumes the same looks; a search with this `prior` may take others. For
        a head, whose probability is that of its most probable cell, the change is an upper bound.

        Args:
            prior: share of the pictures that hold the target, above 0 and below 1.

        Returns:
            The probability that the picture holds the target.

        Raises:
            InputError: the share is no probability between 0 and 1, or the record has no decision, or it is not known
                what its probability assumes.

        Example::

            record = agent.search("kitchen.jpg", "chair")
            print(record.decision.probability, record.assumed, record.probability_at(0.15))
        """
        check_share(prior)
        decision = self.decision
        if decision is None or self.assumed is None:
            expected = "a search by models with the shares of their fit"
            raise InputError(f"record: expected {expected}, got one whose assumed share is not known")
        return Prior(prior, self.assumed)(decision.probability)

    @property
    def found_at(self) -> tuple[float, float] | None:
        """`(x, y)` in picture pixels of the found target: the middle of its box, or else of its cell; None for none."""
        if self._find is None or self._find.box is None:
            return None
        x1, y1, x2, y2 = self._find.box.tolist()
        return (x1 + x2) / 2, (y1 + y2) / 2

    @property
    def verdict(self) -> str:
        """Decision of a search: `found`, `absent` or `undecided`; empty without a decision."""
        return "" if self.decision is None else self.decision.outcome

    @property
    def _find(self) -> Decision | None:
        """The decision of a search that has found its target; None for others."""
        return self.decision if self.verdict == "found" else None

    @property
    def image(self) -> Tensor | None:
        """The reduced picture, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None if self.photograph is None else self.photograph.float() / 255

    def is_whole(self, region: Sequence[float]) -> bool:
        """Tell whether a region `(x1, y1, x2, y2)` is the whole picture, up to a pixel."""
        x1, y1, x2, y2 = region
        width, height = self.size
        return x2 - x1 > width - 1 and y2 - y1 > height - 1

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, from score 0.05 on: the box of the nearest fixation of each.

        A closer look is nearer still; its score is the probability that the target is there.
        """
        fixations = []
        for look in self.fixated:
            point = torch.tensor(look.fixation, dtype=torch.float64)
            distances = distances_to(look.detections.boxes[0], point)
            fixations.append(FixationBoxes(look.detections, distances, look.index))
        return merge_fixations(fixations, self.closer)

    @property
    def objects(self) -> Objects:
        """The candidates of the target classes with at least the score `score_threshold`, and confirmed ones.

        A confirmed object has the box of the look that confirmed it, unless this box shows only a part, and its
        probability if scores are not probabilities and it is higher. A search that did not find its target lists no
        objects: `best_place` is where the target is most likely.
        """
        return self._outcome[0]

    @property
    def confirmed(self) -> Tensor:
        """Which of the objects a closer look or the decision confirmed, `(M,)` boolean; none if no target was found."""
        return self._outcome[1]

    @property
    def confirmable(self) -> bool:
        """Whether objects can be confirmed: by a decision or by closer looks."""
        return self.decision is not None or len(self.closer) > 0

    @property
    def refuted(self) -> list[CloseUp]:
        """The closer looks that did not confirm that the target is there."""
        confirmed = [place.box for place in self._confirmed_places]
        return [look for look in self.closer if not any(map(look.box.equal, confirmed))]

    @property
    def expected(self) -> dict[str, float]:
        """Expected number of objects by the name of their class; NaN (in files null) if it is not known.

        It is the sum of the probabilities of all candidates, plus the class's share of the objects that further looks
        are expected to show (without this term in a search, or if several classes were asked for). It is not known if
        scores are not probabilities, as with a fovea or a head. If the detector hardly reacts to the class
        (`semfov.paths.ZoomPath.reacts`), it is twice the sum (`semfov.zoom.certainty.number_of_faint`), and not known
        in a large picture in which no other class is clear. For the target of a search it is at least the probability
        of the decision.
        """
        return NumberByClass({name: mean for name, (mean, _) in self._claimed().items()})

    @property
    def expected_error(self) -> dict[str, float]:
        r"""Standard deviation of the expected number of objects by the name of their class; NaN if it is not known.

        Its variance has three terms: that of independent candidates, times a factor φ
        (`semfov.zoom.certainty.DISPERSION`); that of the n objects that no look has shown; and, because the model suits
        some pictures better than others, a share :math:`\tau` (`spread`) of the expected number E, squared:

        .. math:: \sigma^2 = \varphi \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2
        """
        return NumberByClass({name: variance**0.5 for name, (_, variance) in self._claimed().items()})

    @property
    def expected_guessed(self) -> dict[str, bool | None]:
        """Whether the expected number of objects is a guess, by the name of their class; None if it is not known.

        It is a guess if the detector hardly reacts to the class (`semfov.paths.ZoomPath.reacts`). The words of the
        record then say `at a guess`, if an object of the class is listed or at least one half is expected.
        """
        return {name: None if isnan(mean) else False for name, (mean, _) in self._claimed().items()}

    def _claimed(self) -> dict[str, tuple[float, float]]:
        """Estimate mean and variance of the number of objects of each class; NaN for those without one."""
        labels = self.sought or tuple(Counter(self.objects.labels.tolist()))
        return {self.classes[label]: (nan, nan) for label in labels}

    @property
    def sought(self) -> tuple[int, ...]:
        """Classes that were searched for; empty if for all."""
        return sought_classes(self.target, self.targets)

    @property
    def place_probability(self) -> float | None:
        """Probability that the target is at the place that the search reports, found or most likely.

        None if the search reports no place, or has only a score. (The probability of the decision is that the picture
        holds the target anywhere.)
        """
        best = self.best_place
        if best is not None:
            is_probability = len(self.closer) > 0 or self.unseen is not None
            return best[1] if is_probability else None
        return None if self._find is None else self._find.place

    @property
    def is_doubtful(self) -> bool:
        """Whether the search leaves open if the target is present: it is undecided, or only probably absent."""
        decision = self.decision
        if decision is None or decision.outcome == "found":
            return False
        said = round(decision.probability, 2)  # as the sentences have it
        return decision.outcome == "undecided" or said >= _DOUBTFUL

    @property
    def best_place(self) -> tuple[Tensor, float] | None:
        """The most likely place of a target that was not found: a box `(4,)`, and its probability or score.

        None if the target was found or is surely absent (a probability below 0.1), or if nothing looks like it.
        """
        decision = self.decision
        if decision is None or not self.is_doubtful:
            return None
        places = [(look.box, look.place) for look in self.closer]
        # A score does not compare with the probability of a place that was looked at closely.
        if not places or self.unseen is not None:
            others = self._candidates_not_examined()
            # No place is more probable than the picture; a rare target makes both improbable.
            most = decision.probability if self.unseen is not None else 1.0
            places += zip(others.boxes, others.scores.clamp(max=most).tolist(), strict=True)
        return max(places, key=lambda place: place[1], default=None)

    def _candidates_not_examined(self) -> Objects:
        """Select the candidates of the targets at which no closer look was made."""
        candidates = self.candidates.of(self.sought)
        if not self.closer:
            return candidates
        examined = torch.stack([look.box for look in self.closer]).to(candidates.boxes)
        return candidates[(box_iou(candidates.boxes, examined) < SAME_OBJECT_IOU).all(1)]

    @property
    def _confirmed_places(self) -> list[_ConfirmedPlace]:
        """The places that closer looks confirmed, and last the one of the decision."""
        found_place = self._found_place
        places = []
        for look in self.closer:
            # The box of the decision is often that of a closer look, and is listed once.
            is_found_place = found_place is not None and look.box.equal(found_place.box)
            if look.place >= _CONFIRMING and not is_found_place:
                places.append(_ConfirmedPlace(look.box, look.target, look.place, look.index_of_look))
        return places if found_place is None else [*places, found_place]

    @property
    def _found_place(self) -> _ConfirmedPlace | None:
        """The place where the decision found the target; None if it did not, or shows no box."""
        find = self._find
        if find is None or find.box is None or self.target is None:
            return None
        probability = find.probability if find.place is None else find.place
        close_ups = [close_up for close_up in self.closer if close_up.box.equal(find.box)]
        # A box of no closer look is of the look by which the search decided, its last one.
        look = close_ups[0].index_of_look if close_ups else len(self) - 1
        return _ConfirmedPlace(find.box, self.target, probability, look)

    @cached_property
    def _outcome(self) -> tuple[Objects, Tensor]:
        """The objects, and which of them were confirmed; none of a search that is over without a find."""
        objects, confirmed = self._shown_objects
        has_ended_without_find = self.verdict in ("absent", "undecided") and not self._goes_on
        return (objects[:0], confirmed[:0]) if has_ended_without_find else (objects, confirmed)

    @cached_property
    def _shown_objects(self) -> tuple[Objects, Tensor]:
        """The objects that the looks show, whatever was decided, and which of them were confirmed."""
        candidates = self.candidates.of(self.sought)
        listing = _Listing(candidates, self.score_threshold, are_probable=self.unseen is not None)
        for place in self._confirmed_places:
            listing.confirm(place)
        objects, confirmed = listing.result()
        if self.verdict in ("absent", "undecided"):
            # No closer look was as sure as the search asks for, so what it shows counts by its probability alone.
            objects = objects[~confirmed | (objects.scores >= self.score_threshold)]
            confirmed = torch.zeros(len(objects), dtype=torch.bool)
        return replace(objects, classes=self.classes), confirmed


class _Listing:
    """List of the objects of a record, in which confirmed places find or become objects.

    Row i of `boxes` `(M, 4)`, `scores`, `labels` and `looks` `(M,)` is a candidate, or a place without one.
    `counts[i]` tells whether its score alone suffices, and `confirmed[i]` whether a place confirmed it.

    Invariant: all columns have as many rows; rows are only added, at the end, so that a row keeps its number.

    Args:
        candidates: the candidates of the classes that were searched for.
        score_threshold: score from which on a candidate counts.
        are_probable: whether scores are probabilities by all looks, closer ones too, which no prior changes. An added
            place has the probability of its closer look.
    """

    def __init__(self, candidates: Objects, score_threshold: float, *, are_probable: bool) -> None:
        self.are_probable = are_probable
        self.boxes = candidates.boxes
        self.scores = candidates.scores
        self.labels = candidates.labels
        self.looks = candidates.passes
        self.track_ids = candidates.track_ids
        self.counts = candidates.scores >= score_threshold
        self.confirmed = torch.zeros(len(candidates), dtype=torch.bool)

    def confirm(self, place: _ConfirmedPlace) -> None:
        """Give the object at a confirmed place its box, and its probability in place of a lower score.

        Where the box is a part of a listed object, the object keeps its own box.
        """
        box = place.box[None].to(self.boxes)
        probability = self.scores.new_tensor([place.probability])
        row = self._row_at(box, place.label)
        if row is not None:
            self.boxes = self.boxes.index_copy(0, row, box)
        else:
            # The part of an object confirms the object, and says nothing of its box.
            row = self._row_around(box, place.label)
        if row is None:
            row = self._append(box, probability, place)
        if not self.are_probable:
            self.scores = self.scores.index_copy(0, row, probability.maximum(self.scores[row]))
        self.confirmed[row] = True

    def _row_at(self, box: Tensor, label: int) -> Tensor | None:
        """Find the row `(1,)` of the object of a class at a box `(1, 4)`; None if there is none."""
        if not len(self.boxes):
            return None
        overlap = box_iou(self.boxes, box)[:, 0].masked_fill(self.labels != label, 0)
        row = overlap.argmax()[None]
        return row if bool(overlap[row] >= SAME_OBJECT_IOU) else None

    def _row_around(self, box: Tensor, label: int) -> Tensor | None:
        """Find the row `(1,)` of the most probable listed object of a class that a box `(1, 4)` is a part of."""
        is_part = share_inside(box, self.boxes)[0] >= _PART
        rows = (is_part & (self.labels == label) & (self.counts | self.confirmed)).nonzero()[:, 0]
        return rows[self.scores[rows].argmax()][None] if len(rows) else None

    def _append(self, box: Tensor, probability: Tensor, place: _ConfirmedPlace) -> Tensor:
        """Add a place that no candidate has, and return its row `(1,)`."""
        row = torch.tensor([len(self.boxes)])
        self.boxes = torch.cat([self.boxes, box])
        self.scores = torch.cat([self.scores, probability])
        self.labels = torch.cat([self.labels, self.labels.new_tensor([place.label])])
        self.looks = torch.cat([self.looks, self.looks.new_tensor([place.look])])
        if self.track_ids is not None:
            self.track_ids = torch.cat([self.track_ids, torch.tensor([NO_TRACK])])
        self.counts = torch.cat([self.counts, torch.tensor([False])])
        self.confirmed = torch.cat([self.confirmed, torch.tensor([False])])
        return row

    def result(self) -> tuple[Objects, Tensor]:
        """Return the objects that count or were confirmed, most confident first, and which were confirmed, `(M,)`."""
        order = self.scores.argsort(descending=True, stable=True)
        order = order[(self.counts | self.confirmed)[order]]
        objects = Objects(self.boxes, self.scores, self.labels, self.looks, track_ids=self.track_ids)
        return objects[order], self.confirmed[order]
