"""What the looks of a record found: its objects, its decision, and the words for both."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import nan
from typing import Any, ClassVar, Literal

import torch
from torch import Tensor

from semfov.belief.grid import Grid
from semfov.data.classes import class_index, counted
from semfov.decision import SAME, CloseUp, Decision
from semfov.detection.detections import Detections
from semfov.detection.objects import LEAST, Objects, box_text
from semfov.errors import check
from semfov.observation.matching import box_iou
from semfov.paths.files import Ending
from semfov.paths.look import RecordedLook
from semfov.paths.merging import distances_to, merge_fixations


class NumberByClass(dict[str, float]):
    """Numbers by the name of their class, which may be in the plural or another spelling, as that of a target may."""

    def __missing__(self, name: str) -> float:
        names = list(self)
        return self[names[class_index(name, names, "expected") - 1]]


@dataclass(frozen=True, kw_only=True, repr=False)
class Outcome(ABC):
    """The looks of a record, what they found, and what was decided (`semfov.paths.Record`)."""

    classes: tuple[str, ...]
    target: int | None
    detections: tuple[Detections, ...]
    found: bool = False
    closer: tuple[CloseUp, ...] = ()
    ending: Ending | None = None
    seconds: tuple[Any, ...] = ()
    decision: Decision | None = None
    targets: tuple[int, ...] = ()
    least: float = LEAST
    unseen: tuple[float, float] | None = None
    photograph: Tensor | None = None
    source: str | None = None
    shown: Mapping[str, Any] | None = None
    detector: str | None = None

    how: ClassVar[Literal["fovea", "windows", "head"]]
    """Kind of look: of a fovea, at windows, or of a head that turns."""

    _sentences: ClassVar[Mapping[str, str]] = {
        "box": "The gaze is on a box of the target.",
        "detection": "A detection shows the target at the gaze.",
        "worth": "No look is expected to classify enough more cells correctly.",
        "cells": "Every cell was fixated.",
        "duration": "The next look would end after the time limit of the scene.",
        "seconds": "The time was over.",
        "stopped": "It was stopped.",
        "found": "The target is probable enough, and was looked at closely enough.",
        "absent": "No remaining cell is worth a look, and the target is probably absent.",
        "undecided": "No remaining cell is worth a look, but the target is too probable to call it absent.",
        "closer found": "A closer look confirmed the target.",
        "closer undecided": "No closer look was sure enough, but the target is too probable to call it absent.",
    }
    """Why it ended, by the ending, or by the outcome of the decision that ended the search."""

    @abstractmethod
    def _looks(self) -> Iterator[RecordedLook]:
        """The looks in their order, made anew."""

    @abstractmethod
    def describe(self) -> str:
        """Describe the outcome in one line."""

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture in pixels."""

    @cached_property
    def looks(self) -> tuple[RecordedLook, ...]:
        return tuple(self._looks())

    def __iter__(self) -> Iterator[RecordedLook]:
        return iter(self.looks)

    def __len__(self) -> int:
        """Number of looks, the first included."""
        return len(self.detections)

    def __getitem__(self, number: int) -> RecordedLook:
        """The look of a number, as iteration gives it; -1 is the last one."""
        remedy = f"; its objects of a class are record.objects.of({number!r})"
        check(not isinstance(number, str), "record", "the number of a look", f"{number!r}{remedy}")
        return self.looks[number]

    @property
    def passes(self) -> int:
        """Number of passes of the detector, closer looks included."""
        return len(self) + sum(look.number is None for look in self.closer)

    @property
    def target_name(self) -> str | None:
        """Name of the class that was searched for; None for all classes."""
        return None if self.target is None else self.classes[self.target]

    @property
    def measure(self) -> str:
        """What the scores of objects are: `probability` with a fitted certainty, otherwise `score`."""
        return "score" if self.unseen is None else "probability"

    @property
    def threshold_in_words(self) -> str:
        """From what on objects count, such as `probability 0.5`."""
        return f"{self.measure} {self.least:g}"

    @property
    def decided_by(self) -> str:
        """What the number of the decision is: a `probability`, a `belief` without thresholds, or the best `score`."""
        return "probability"

    @property
    def found_at(self) -> tuple[float, float] | None:
        """`(x, y)` in picture pixels of the found target: the middle of its box, or else of its cell; None for none."""
        decision, grid = self.decision, getattr(self, "grid", None)
        if decision is not None and decision.outcome == "found" and decision.box is not None:
            x1, y1, x2, y2 = decision.box.tolist()
            return (x1 + x2) / 2, (y1 + y2) / 2
        if decision is None or decision.outcome != "found" or decision.cell is None or not isinstance(grid, Grid):
            return None
        return tuple(grid.centres[decision.cell].tolist())

    @property
    def image(self) -> Tensor | None:
        """The reduced picture, `(3, h, w)` in [0, 1]; None if it was not kept."""
        return None if self.photograph is None else self.photograph.float() / 255

    def is_whole(self, region: Sequence[float]) -> bool:
        """Whether a region `(x1, y1, x2, y2)` is the whole picture, up to a pixel."""
        (x1, y1, x2, y2), (width, height) = region, self.size
        return x2 - x1 > width - 1 and y2 - y1 > height - 1

    @cached_property
    def candidates(self) -> Objects:
        """Objects merged from the detections of all looks, from score 0.05 on: the box of the nearest fixation of each.

        A closer look is nearer still; its score is the probability that the target is there.
        """
        looks = [look.detections for look in self]
        distances = [
            distances_to(look.detections.boxes[0], torch.tensor(look.fixation, dtype=torch.float64)) for look in self
        ]
        return merge_fixations(looks, distances, self.closer)

    @property
    def objects(self) -> Objects:
        """The candidates of the targets that have at least the score `least`, or that were confirmed.

        One that was confirmed has the box that confirmed it, and that box's probability where it is higher.
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
        boxes = [box for box, *_ in self._confirmed_places]
        return [look for look in self.closer if not any(look.box.equal(box) for box in boxes)]

    @property
    def expected(self) -> dict[str, float]:
        """Expected number of objects by the name of their class; NaN, and null in files, where it is not known.

        It is the sum of the probabilities of all candidates, and of what further looks are expected to show, of which
        each class has its share of that sum. It is not known where scores are no probabilities, as in looks of a fovea
        or a head. Of a class to which the detector hardly reacts (`semfov.paths.ZoomPath.reacts`) it is twice the sum
        (`semfov.zoom.certainty.number_of_faint`), and not known in a large picture in which no other class is clear.
        """
        return NumberByClass({name: mean for name, (mean, _) in self._claimed().items()})

    @property
    def expected_error(self) -> dict[str, float]:
        r"""Standard deviation of the expected number of objects by the name of their class; NaN where it is not known.

        The candidates are independent (a Poisson-binomial distribution), and what no look has shown has the
        distribution of `semfov.zoom.certainty`. Pictures differ in how far the model suits them, by a share
        :math:`\tau` (`spread`) of the expected number E:

        .. math:: \sigma^2 = \sum_i p_i (1 - p_i) + \operatorname{Var}[n] + \tau^2 E^2
        """
        return NumberByClass({name: variance**0.5 for name, (_, variance) in self._claimed().items()})

    def _claimed(self) -> dict[str, tuple[float, float]]:
        """Mean and variance of the number of objects of each class; NaN for those without one."""
        return {self.classes[label]: (nan, nan) for label in self._sought or Counter(self.objects.labels.tolist())}

    @property
    def _sought(self) -> tuple[int, ...]:
        """Classes that were searched for; none stands for all."""
        return self.targets or (() if self.target is None else (self.target,))

    @property
    def _confirmed_places(self) -> list[tuple[Tensor, int, float, int]]:
        """Box, class, probability and look of the places that closer looks and the decision confirmed."""
        decision, closer = self.decision, self.closer
        box = decision.box if decision is not None and decision.outcome == "found" else None
        # From a probability of one half on a closer look confirms that the target is there.
        others = [look for look in closer if look.place >= 0.5 and (box is None or not look.box.equal(box))]
        places = [(look.box, look.target, look.place, look.of_look) for look in others]
        if box is not None and decision is not None and self.target is not None:
            number = next((look.of_look for look in closer if look.box.equal(box)), len(self) - 1)
            probability = decision.probability if decision.place is None else decision.place
            places.append((box, self.target, probability, number))
        return places

    @cached_property
    def _outcome(self) -> tuple[Objects, Tensor]:
        """The objects, and which of them were confirmed."""
        candidates = self.candidates.of(self._sought)
        boxes, scores, labels, looks = candidates.boxes, candidates.scores, candidates.labels, candidates.passes
        counts, sure = candidates.scores >= self.least, torch.zeros(len(candidates), dtype=torch.bool)
        for place, label, chance, look in self._confirmed_places:
            box, probability = place[None].to(boxes), scores.new_tensor([chance])
            overlap = box_iou(boxes, box)[:, 0].masked_fill(labels != label, 0)
            same = overlap.argmax()[None] if len(overlap) else overlap.long()
            if not bool((overlap[same] >= SAME).any()):
                same = torch.tensor([len(boxes)])
                boxes, scores = torch.cat([boxes, box]), torch.cat([scores, probability])
                labels = torch.cat([labels, labels.new_tensor([label])])
                looks = torch.cat([looks, looks.new_tensor([look])])
                sure, counts = (torch.cat([each, torch.tensor([False])]) for each in (sure, counts))
            boxes, scores = (
                boxes.index_copy(0, same, box),
                scores.index_copy(0, same, probability.maximum(scores[same])),
            )
            sure[same] = True
        order = scores.argsort(descending=True, stable=True)
        order = order[(counts | sure)[order]]
        objects, sure = Objects(boxes, scores, labels, looks)[order], sure[order]
        if self.decision is not None and self.decision.outcome != "found":
            # No closer look was as sure as the search asks for, so what it shows counts by its probability alone.
            objects = objects[~sure | (objects.scores >= self.least)]
            sure = torch.zeros(len(objects), dtype=torch.bool)
        return replace(objects, classes=self.classes), sure

    def objects_in_words(self) -> str:
        """Count the objects, by class where classes were searched for, such as `2 cups, no cat found`."""
        labels = self.objects.labels
        names = [counted(int((labels == label).sum()), self.classes[label]) for label in self._sought]
        text = f"{', '.join(names) or counted(len(labels), 'object')} found"
        return text[0].upper() + text[1:]

    def classes_in_words(self) -> str:
        """Count the objects by class, the most frequent first, and say how many of each to expect in all."""
        counts = Counter(self.objects.labels.tolist()).most_common()
        words = [f"{counted(count, self.classes[label])}{self._number_in_words(label)}" for label, count in counts]
        return ", ".join(words)

    def _number_in_words(self, label: int) -> str:
        """The expected number of objects of a class, in brackets; empty where it is not known."""
        return ""

    def why_it_ended(self) -> str:
        """Explain in one sentence why the search or the exploration ended.

        Returns:
            The sentence; empty if the reason is not known.
        """
        sentences, looks = self._sentences, self.passes
        if self.closer and self.found:
            # Windows as large as the picture: the first look is a closer look already.
            box = None if self.decision is None else self.decision.box
            showing = [look.number for look in self.closer if box is not None and look.box.equal(box)]
            found = sentences["closer found"]
            return sentences.get("first found", found) if showing == [0] else found
        if self.ending == "decision" and self.decision is not None:
            outcome, closer = self.decision.outcome, any(look.number != 0 for look in self.closer)
            return sentences.get(f"closer {outcome}" if closer else outcome, sentences[outcome])
        if self.ending == "shifts":
            return f"All {len(self) - 1} gaze shifts were made."
        if self.ending == "passes":
            return f"All {looks} passes were used." if looks != 1 else "The only pass was used."
        return sentences.get(self.ending or "", "")

    @property
    def best_place(self) -> tuple[Tensor, float] | None:
        """Where the target of an undecided search is most likely, a box `(4,)`, and its probability or score."""
        if self.decision is None or self.decision.outcome != "undecided":
            return None
        seen = self.candidates.of(self._sought)
        places = [(look.box, look.place) for look in self.closer]
        places = places or list(zip(seen.boxes, seen.scores.tolist(), strict=True))
        return max(places, key=lambda place: place[1], default=None)

    def best_place_in_words(self) -> str:
        """Name the most likely place of the target of an undecided search; empty for others and without one."""
        place, of = self.best_place, "probability" if self.closer else self.measure
        return "" if place is None else f"best place: box {box_text(place[0].tolist())}, {of} {place[1]:.2f}"

    def summary(self) -> str:
        """Describe the outcome, explain why the search or the exploration ended, and name the best place of doubt."""
        place = self.best_place_in_words().capitalize()
        limited = self.how == "windows" and self.ending == "passes"
        ending = " (the limit)." if limited else f". {self.why_it_ended()}".rstrip()
        return f"{self.describe()}{ending}{place and f' {place}.'}"
