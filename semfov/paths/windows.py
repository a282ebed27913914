"""The records of looks at windows: of a search or an exploration of a picture, and of a frame of a stream."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import ClassVar

import torch
from torch import Tensor

from semfov.attribute_words import MOMENT
from semfov.data.classes import amount, plural
from semfov.detection import Objects
from semfov.detection.objects import FAINTEST, NO_TRACK
from semfov.errors import check
from semfov.io.schema import Array, Field, Flag, Json, Maybe, Number, Object
from semfov.kinds import WINDOWS
from semfov.paths.base import Moment, Record
from semfov.paths.conversion import Values
from semfov.paths.files import FARTHEST, POSITIVE, WHOLE, Format, SharedFields
from semfov.paths.late import MadeWhenRead
from semfov.paths.look import Box, RecordedLook, finite_or_none
from semfov.paths.words import MomentWords, Words, number_with_error
from semfov.tracking import Tracks
from semfov.tracking.files import TRACK_FIELDS, track_tensors, tracks_of
from semfov.zoom.certainty import SEVERAL, SPREAD, number_of, number_of_faint, reacts
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import Window, WindowLook
from semfov.zoom.objects import merge

_WINDOW_VALUES = {
    "fixation": Array((Number(), Number(), POSITIVE)),
    "level": WHOLE,
    "cells": Array(Number(whole=True), 4),
    "within": Maybe(Array(Number(), 4)),
}
_WINDOW = Object(_WINDOW_VALUES, None, tuple(_WINDOW_VALUES))  # a window in a file

_LATTICE = {
    "size": Array(Number(low=1, whole=True), 2),
    "canvas": Array(Number(low=1, whole=True), 2),
    "magnifications": Array(POSITIVE, least=1, ascending=True),
}
_LEAST_SAID = 0.5  # expected number from which on it is said of a class without a listed object
_CLEAR = 0.7  # score from which on an object of any class is clear
_OBJECTS = ("boxes", "scores", "labels", "passes")

# Of n looks with M boxes in all, C classes with the background, and P objects.
_TENSORS = {
    "values": Field(("n",), mixed=True, finite=False),  # infinite for the overview
    "cut": Field(("M",), dtype=torch.bool),
    "show": Field(("n", "C-1"), mixed=True),
    "object_boxes": Field(("P", 4), mixed=True, low=-FARTHEST, high=FARTHEST),
    "object_scores": Field(("P",), mixed=True),
    "object_labels": Field(("P",), dtype=torch.int64, low=1),
    "object_passes": Field(("P",), dtype=torch.int64, low=-1),
    "object_track_ids": Field(("P",), dtype=torch.int64, low=NO_TRACK, optional=True),
}
"""Tensors of the files of looks at windows."""

_VALUES: dict[str, Json] = {
    "lattice": Object(_LATTICE, None, tuple(_LATTICE)),
    "windows": Array(_WINDOW, "n"),
    "unseen": Maybe(Array(Number(low=0), 2)),
    "spread": Maybe(Number(low=0)),
    "seconds": Array(Number(low=0)),
}
"""JSON values of the files of looks at windows."""


class WindowWords(Words):
    """Words for a search or an exploration with windows."""

    record: "ZoomPath"

    _sentences: ClassVar[Mapping[str, str]] = {
        "min_gain": "No remaining look is expected to show enough new objects.",
        "seconds": "The time was over.",
        "stopped": "It was stopped.",
        "windows": "No window is left that can show more.",
        "detection": "A detection shows the target.",
        "found": "The probability is high enough, and a detection shows the target.",
        "absent": "No remaining look is worth a pass.",
        "undecided": "No remaining look is worth a pass, but the target is too probable to call it absent.",
        "unseen": "No look shows anything like it; what is left is the chance that the detector missed it.",
        "first found": "The first look shows the target closely enough.",
        "closer found": "A closer look confirmed the target.",
        "closer absent": "No closer look was sure enough.",
        "closer undecided": "The target is too probable to call it absent.",
    }

    @property
    def decided_by(self) -> str:
        """Kind of number of the decision: a `probability`, or without fitted models the best `score`."""
        return "probability" if self.record.closer or self.record.ending == "decision" else self.measure

    def describe(self) -> str:
        """Describe the result in one line."""
        record = self.record
        looks = amount(record.passes, "look")
        if record.decision is not None and record.target_name is not None:
            certainty = f"there with probability {record.decision.probability:.2f}"
            return f"{self.verdict(record.target_name, ':')} ({certainty}) in {looks}"
        return f"{self.objects}. {looks}"

    def why_it_ended(self) -> str:
        """Explain in one sentence why the episode ended, or what a decision without candidates means."""
        return self._sentences["unseen"] if self._lacked_candidates() else super().why_it_ended()

    def _lacked_candidates(self) -> bool:
        """Tell whether a search of a photograph decided although no look shows a place that may hold the target."""
        record = self.record
        is_photograph = record.lattice.levels == 1
        has_decided = record.ending == "decision" and not record.closer
        if record.target is None or not is_photograph or not has_decided:
            return False
        chances = [float(look.show[record.target - 1]) for look in record.window_looks]
        return all(chance < FAINTEST for chance in chances)

    @property
    def objects(self) -> str:
        """Number of the objects, by class where classes were searched for, and how many to expect in all.

        For example `36 people found; expect 45 ± 9 in all` or `No cup found`; if the detector hardly reacts to the
        class, `2 people found; expect at a guess 9.0 ± 9.9 in all`. If no class was named there is no total, since the
        small expectations of all classes add up to many.
        """
        record = self.record
        # Of one class the name stands before, with the objects that are listed.
        are_several = len(record.sought) > 1
        expected = []
        for label in record.sought:
            number = self._expected(label)
            if number:
                expected.append(f"{number} {plural(record.classes[label])}" if are_several else number)
        text = self._listed
        return f"{text}; expect {', '.join(expected)} in all" if expected else text

    @property
    def _listed(self) -> str:
        """Number of the objects that are listed, by class."""
        return super().objects

    def _number_in_all(self, label: int) -> str:
        """Say in brackets how many objects of a class to expect, such as ` (45 ± 9 in all)`; empty if not known."""
        number = self._expected(label)
        return f" ({number} in all)" if number else ""

    def _expected(self, label: int) -> str:
        """Say the expected number of objects of a class and its standard deviation, such as `45 ± 9` or `0.8 ± 1.9`.

        Empty where no number is estimated, and where none is listed and less than one half is expected.
        """
        record = self.record
        if record.unseen is None:
            return ""
        mean, variance = record._numbers().get(label, (math.nan, math.nan))
        if not record._is_said(label, mean):
            return ""
        guess = "" if record._reacts_to(label) else "at a guess "
        return f"{guess}{number_with_error(mean, variance**0.5)}"

    @property
    def _ending(self) -> str:
        """End of the summary's first sentence; the number of looks stands before it."""
        return " (the limit of passes=)." if self.record.ending == "passes" else super()._ending

    @property
    def value(self) -> str:
        """What the values of looks mean (`semfov.zoom.policy`); for slices they are scores (`semfov.zoom.slices`)."""
        # Without learned evidence looks are chosen by scores, and slices of photographs always are.
        scores = "the sum of the scores that the first look has in it"
        if self.record.decision is not None:
            chance = "the probability that it finds the target, also by looks at smaller windows in it"
            return scores if self.decided_by == "score" else chance
        is_photograph = self.record.lattice.levels == 1
        if is_photograph or self.measure == "score":
            return scores
        return "the expected number of new objects in it, with a share of those that smaller windows in it would show"

    @property
    def sensor(self) -> str:
        """The windows of the lattice and of the closer looks."""
        lattice = self.record.lattice
        width, height = lattice.canvas
        # Closer looks need not be windows of the lattice.
        closer_ones = {look.window.fixation[2] for look in self.record.window_looks}
        magnifications = sorted({*lattice.magnifications, *closer_ones})
        # Magnifications that read the same are named once.
        names = list(dict.fromkeys(f"{magnification:.2g}" for magnification in magnifications))
        listed = ", ".join(names) if len(names) <= 6 else f"from {names[0]} to {names[-1]}"
        noun = "magnification" if len(names) == 1 else "magnifications"
        return f"windows of {width} × {height} px at {noun} {listed}"

    @property
    def lines(self) -> list[str]:
        """The fixations and magnifications of the looks, the first and the last of many."""
        looks = []
        for look in self.record:
            x, y = look.fixation
            looks.append(f"({x:z.0f}, {y:z.0f}) × {look.more['magnification']:.2f}")
        path = looks if len(looks) <= 6 else [*looks[:4], "…", looks[-1]]
        width, height = self.record.size
        return [f"looks at (x, y) × magnification: {', '.join(path)} of {width} × {height} px"]


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class LookAtWindow(RecordedLook):
    """One look at a window of a picture, or of a frame of a stream.

    Attributes:
        shown: what the look shows: window, detections and highest scores. One from a file has no gist.
    """

    shown: WindowLook


def look_at_window(
    shown: WindowLook,
    lattice: Lattice,
    number: int,
    seconds: float | None,
    value: float,
) -> LookAtWindow:
    """Make the complete look at a window.

    Args:
        shown: what the look shows.
        lattice: lattice of the picture.
        number: number of the look.
        seconds: time at its end, on the clock of the episode; None if it is not known.
        value: value for which it was chosen; infinite for the overview.
    """
    window = shown.window
    return LookAtWindow(
        index=number,
        fixation=window.centre(lattice),
        region=window.region(lattice),
        detections=shown.detections,
        seconds=seconds,
        value=finite_or_none(value),
        more={"magnification": window.fixation[2], "level": window.level},
        shown=shown,
    )


def looks_at_windows(
    shown: Sequence[WindowLook], lattice: Lattice, values: Sequence[float], seconds: Sequence[float] = ()
) -> tuple[LookAtWindow, ...]:
    """Make the looks at windows from their columns (`look_at_window`); without `seconds` their times are not known."""
    times: Sequence[float | None] = seconds or [None] * len(shown)
    looks = []
    for number, (window_look, time, value) in enumerate(zip(shown, times, values, strict=True)):
        looks.append(look_at_window(window_look, lattice, number, time, value))
    return tuple(looks)


def _has_found(record: "ZoomPath") -> bool:
    """Tell whether the decision, or without one the objects say that a target was found."""
    if record.verdict:
        return record.verdict == "found"
    return bool(record.sought) and len(record.objects) > 0


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class ZoomPath(Record):
    """The record of a search or an exploration of a large picture.

    In a notebook it shows the windows that were looked at; `plot` draws them on the picture.

    Beside the attributes of `semfov.paths.Record` it has those of its looks.

    Attributes:
        lattice: lattice of the picture.
        looks: looks in their order, the overview first. The value of a closer look is the probability that the target
            is at the place.
        candidates: objects merged from all looks (`semfov.zoom.merge`). With a fitted certainty their scores are the
            probabilities that box and class are right.
        spread: standard deviation of the relative error of the expected number, because models suit pictures more or
            less (`semfov.zoom.certainty`).
        found: whether the decision is `found`; without a decision, whether there are objects of the target classes.
        closer: closer looks of a search, in their order; they are among the `looks`, each with its `number`.

    >>> nothing = Objects(torch.zeros(0, 4), torch.zeros(0), torch.zeros(0).long(), torch.zeros(0).long())
    >>> lattice = Lattice.over((2560, 1920), (416, 416))
    >>> path = ZoomPath(
    ...     lattice=lattice, classes=("background", "cup"), target=1, looks=(), candidates=nothing
    ... )
    >>> path.describe()
    'No cup found. 0 looks'
    """

    lattice: Lattice
    looks: tuple[LookAtWindow, ...]
    candidates: Objects = MadeWhenRead()  # type: ignore[assignment]
    unseen: tuple[float, float] | None = MadeWhenRead(None)  # type: ignore[assignment]
    spread: float = SPREAD
    # Without a decision it rests on the objects, and is made as late as they are.
    found: bool = field(init=False, default=cached_property(_has_found))  # type: ignore[assignment]

    kind = WINDOWS
    _words = WindowWords
    _format = Format("zoom path", _TENSORS, _VALUES)

    @property
    def window_looks(self) -> tuple[WindowLook, ...]:
        """The results of all looks; in a path from a file they have no gist."""
        return tuple(look.shown for look in self.looks)

    @property
    def values(self) -> tuple[float, ...]:
        """Value of each look when it was chosen; that of the overview is infinite."""
        return tuple(math.inf if look.value is None else look.value for look in self.looks)

    @property
    def reacts(self) -> bool:
        """Whether the detector reacts clearly to at least one class, so that the expected number is more than a guess.

        It does if five or more listed objects have a probability of at least one half, or if such objects make up three
        fifths of the sum of all probabilities.
        """
        return any(map(self._reacts_to, self.sought or self.candidates.labels.unique().tolist()))

    def _reacts_to(self, label: int) -> bool:
        return len(self._shown_objects[0].of([label])) > 0 and reacts(self.candidates.of([label]).scores)

    @property
    def expected_guessed(self) -> dict[str, bool | None]:
        """Whether the expected number of objects is a guess, by the name of their class (`semfov.paths.Record`)."""
        if self.unseen is None:
            return super().expected_guessed
        guessed: dict[str, bool | None] = {}
        for label, (mean, _) in self._numbers().items():
            guessed[self.classes[label]] = None if math.isnan(mean) else not self._reacts_to(label)
        return guessed

    def _is_said(self, label: int, mean: float) -> bool:
        """Tell whether the words say the expected number of a class: one is listed, or half of one expected."""
        are_listed = len(self.objects.of([label])) > 0
        return mean >= (0.0 if are_listed else _LEAST_SAID)  # never of NaN

    def _claimed(self) -> dict[str, tuple[float, float]]:
        """Mean and variance of the number of objects of each class; NaN where none is estimated."""
        if self.unseen is None:
            return super()._claimed()
        return {self.classes[label]: number for label, number in self._numbers().items()}

    def _numbers(self) -> dict[int, tuple[float, float]]:
        """Mean and variance of the number of objects of each class; NaN where none is estimated.

        The objects that no look has shown are shared among the classes by the sums of their probabilities. That of the
        target of a search is no less than the probability that the picture holds it: E[N] ≥ P(N ≥ 1).
        """
        labels = self.sought or tuple(self.candidates.labels.unique().tolist())
        sums = {}  # of the probabilities of each class
        for label in labels:
            probabilities = self.candidates.of([label]).scores.double()
            sums[label] = float(probabilities.sum()) + 1e-9  # not 0, to divide by it
        total = sum(sums.values())
        numbers = {label: self._number(label, sums[label] / total) for label in labels}
        if self.decision is not None and self.target in numbers:
            mean, variance = numbers[self.target]
            # The decision knows the prior and the closer looks, which the candidates do not.
            numbers[self.target] = (max(mean, self.decision.probability), variance)  # NaN stays
        return numbers

    def _number(self, label: int, share: float) -> tuple[float, float]:
        """Mean and variance of the number of objects of a class; NaN where none is estimated.

        Args:
            label: the class.
            share: its share of the objects that no look has shown.
        """
        scores = self.candidates.of([label]).scores  # (N,)
        if self._reacts_to(label):
            mean_unseen, variance_unseen = self.unseen or (0.0, 0.0)
            return number_of(scores, (share * mean_unseen, share * variance_unseen), self.spread)
        if label in self._countable_if_faint:
            return number_of_faint(scores)
        return math.nan, math.nan

    @cached_property
    def _countable_if_faint(self) -> set[int]:
        """Classes that have a number where the detector hardly reacts to them: in pictures like those of the fit."""
        return {*self.sought, *self.objects.labels.tolist()} if self._familiar else set()

    @cached_property
    def _familiar(self) -> bool:
        """Whether the picture is like those of the fit: a photograph, or one in which objects of any class are clear.

        In 12 pictures of airports from above, of whose airplanes the detector shows next to nothing, at most three
        objects of any class have the score `_CLEAR`; in sheets of photographs and in frames of a street nine or more.
        """
        return self.lattice.levels == 1 or len(merge(self.window_looks, score=_CLEAR)) >= SEVERAL

    @property
    def size(self) -> tuple[int, int]:
        """`(width, height)` of the picture in pixels."""
        return self.lattice.size

    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        looks = self.window_looks
        tensors = {f"object_{name}": getattr(self.candidates, name) for name in (*_OBJECTS, "track_ids")}
        tensors["values"] = torch.tensor(self.values, dtype=torch.float64)
        tensors["cut"] = torch.cat([look.cut for look in looks])  # (M,), which `lengths` separates again
        tensors["show"] = torch.stack([look.show for look in looks])  # (n, K)
        record = {
            "lattice": {name: getattr(self.lattice, name) for name in _LATTICE},
            "windows": [_values_of(look.window) for look in looks],
            "unseen": None if self.unseen is None else list(self.unseen),
            "spread": self.spread,
            "seconds": list(self.seconds),
        }
        return tensors, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        lattice = Lattice(**{name: tuple(value) for name, value in record["lattice"].items()})
        detections = shared["detections"]
        seconds = record["seconds"]
        check(len(seconds) in (0, len(detections)), "seconds", f"{len(detections)} times, or none", seconds)
        _check_below("object_labels", tensors, len(shared["classes"]))
        _check_below("object_passes", tensors, len(detections))
        windows = [_window_from(values, lattice) for values in record["windows"]]
        cuts = tensors["cut"].split(record["lengths"])
        columns = zip(windows, detections, cuts, tensors["show"], strict=True)
        shown = [WindowLook(*column, gist=None) for column in columns]
        boxes, scores, labels, passes = (tensors[f"object_{name}"] for name in _OBJECTS)
        unseen = record.get("unseen")
        spread = record.get("spread")
        return {
            "lattice": lattice,
            "looks": looks_at_windows(shown, lattice, tensors["values"].tolist(), seconds),
            "candidates": Objects(boxes, scores, labels, passes, track_ids=tensors.get("object_track_ids")),
            "unseen": None if unseen is None else tuple(unseen),
            "spread": SPREAD if spread is None else spread,
        }


def _check_below(name: str, tensors: Mapping[str, Tensor], limit: int) -> None:
    """Raise `InputError` unless all numbers of a tensor of a file are below a limit."""
    numbers = tensors[name]
    is_below = not len(numbers) or int(numbers.max()) < limit
    check(is_below, name, f"numbers below {limit}", numbers.tolist())


def _values_of(window: Window) -> Values:
    """Describe a window by the JSON values from which `_window_from` makes it again."""
    return {name: getattr(window, name) for name in _WINDOW_VALUES}


class WindowMomentWords(WindowWords, MomentWords):
    """Words for one frame whose windows are looked at."""

    record: "WindowMoment"

    def describe(self) -> str:
        """Describe objects or decision at the frame in a few words."""
        text = self.decision or self.objects
        return f"{text}; the camera lost the scene" if self.record.lost else text

    @property
    def _listed(self) -> str:
        """Number of the objects that are listed, by class, with a word of doubt where fewer are expected.

        A stream lists objects of low probabilities, too, so that it may list more of them than there are.
        """
        are_doubtful = any(map(self._exceeds_expected, self.record.sought))
        return f"{super()._listed}, some of them doubtful" if are_doubtful else super()._listed

    def _exceeds_expected(self, label: int) -> bool:
        """Tell whether more objects of a class are listed than the words say to expect."""
        record = self.record
        if not self._expected(label):
            return False
        return len(record.objects.of([label])) > round(record.expected[record.classes[label]])

    @property
    def lines(self) -> list[str]:
        """The frame, and the looks that count at it."""
        return [f"frame {self.record.number}", *super().lines]


@dataclass(frozen=True, kw_only=True, repr=False, eq=False)
class WindowMoment(ZoomPath, Moment):
    """The record of one frame of a stream with windows: the looks that count, and what they show.

    The last of these looks is at this frame. The objects are merged from all of them; those of earlier frames are where
    the camera shows their places now. Looks at places outside the frame are left out.

    Beside the attributes of `ZoomPath` and `Moment` it has what comes next.

    Attributes:
        tracks: the tracked objects of all frames so far, also those that are hidden or have left the frame.
        next_window: the window to look at in the next frame, unless the camera loses the scene, or finds it again.
        lost: whether the scene is lost: from a frame that fits none before it, as after a cut or in the dark, until the
            scene is found again or given up.

    Example::

        moment = agent.live("person", how="windows").step(frame)
        print(moment.window.fixation, moment.describe())
    """

    next_window: Window
    lost: bool = False
    tracks: Tracks = field(default_factory=Tracks.none)
    photograph: Tensor | None = MadeWhenRead(None)  # type: ignore[assignment]

    _other_words = MOMENT
    _words = WindowMomentWords
    _format = Format(
        "window moment",
        {**_TENSORS, **TRACK_FIELDS},
        {**_VALUES, "number": WHOLE, "next_window": _WINDOW, "lost": Flag()},
    )

    @property
    def next_point(self) -> tuple[float, float]:
        """`(x, y)` in pixels, the centre of what the next window shows."""
        return self.next_window.centre(self.lattice)

    @property
    def next_region(self) -> Box:
        """`(x1, y1, x2, y2)` in pixels, what the next window shows."""
        return self.next_window.region(self.lattice)

    @property
    def ways(self) -> dict[int, list[tuple[float, float]]]:
        """The paths of the objects in the last frames, by their numbers: points `(x, y)` in pixels of this frame."""
        numbers = self.objects.track_ids
        return {} if numbers is None else self.tracks.of_ids(numbers).ways()

    @property
    def window(self) -> Window:
        """The window that was looked at in this frame."""
        return self.window_looks[-1].window

    def to_mot(self) -> str:
        """Convert the objects of the frame to lines in the format of MOTChallenge.

        Each line has the frame, the number of the object, the left and upper edge, width and height of its box, its
        probability, and three times -1 for unknown values. Frames and pixels are counted from 1.

        Returns:
            The lines; empty without objects. The lines of all frames, joined, are the file of a film.

        Example::

            lines = [live.step(frame).to_mot() for frame in frames]
            Path("film.txt").write_text("".join(lines))
        """
        objects = self.objects
        if objects.track_ids is None:
            return ""
        columns = (objects.track_ids.tolist(), objects.boxes.tolist(), objects.scores.tolist())
        lines = []
        for number, (x1, y1, x2, y2), score in zip(*columns, strict=True):
            box = f"{x1 + 1:.2f},{y1 + 1:.2f},{x2 - x1:.2f},{y2 - y1:.2f}"
            lines.append(f"{self.number + 1},{number},{box},{score:.4f},-1,-1,-1\n")
        return "".join(lines)

    def _contents(self) -> tuple[dict[str, Tensor | None], Values]:
        tensors, record = super()._contents()
        record["number"] = self.number
        record["next_window"] = _values_of(self.next_window)
        record["lost"] = self.lost
        return {**tensors, **track_tensors(self.tracks)}, record

    @classmethod
    def _fields(cls, tensors: dict[str, Tensor], record: Values, shared: SharedFields) -> Values:
        fields = super()._fields(tensors, record, shared)
        return {
            **fields,
            "number": record["number"],
            "lost": record.get("lost", False),
            "tracks": tracks_of(tensors),
            "next_window": _window_from(record["next_window"], fields["lattice"]),
        }


def _window_from(values: Values, lattice: Lattice) -> Window:
    """Make the window with these JSON values; raise `InputError` where the picture has no such level."""
    level = values["level"]
    check(level < lattice.levels, "windows", f"levels below {lattice.levels}", level)
    within = None if values["within"] is None else tuple(values["within"])
    return Window(tuple(values["fixation"]), level, tuple(values["cells"]), within)
