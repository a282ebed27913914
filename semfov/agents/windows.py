"""An agent for pictures larger than its detector's input."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.agents.limits import MOST_PASSES, EpisodeLimits, OnLook, on_cpu
from semfov.data.classes import class_index, class_numbers
from semfov.data.inputs import ImageLike
from semfov.data.large import LargePicture, picture_size
from semfov.decision import check_thresholds
from semfov.detection.detections import Detections
from semfov.detection.load import load_detector, loader_options
from semfov.detection.objects import LEAST, Objects
from semfov.errors import check, check_number, check_options, check_whole
from semfov.paths.endings import Ending
from semfov.paths.stimulus import reduced_copy
from semfov.paths.windows import ZoomPath
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.certainty import Certainty
from semfov.zoom.closer import candidates, look_closely
from semfov.zoom.decision import CLOSER, WindowDecisions, decide_by_score
from semfov.zoom.episode import WindowStep, find_everything, look_by_look, look_for
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import Cut, WindowEye
from semfov.zoom.glances import Glance, Glances, LiveGlances
from semfov.zoom.lattice import Lattice
from semfov.zoom.objects import merge, probable_objects
from semfov.zoom.slices import ranked, usual_slices

USUAL_PASSES = 24
"""Default for the largest number of passes of the detector."""

LIKELY = 0.5
"""Default for the least probability of the objects that a record counts."""

NEW_OBJECTS = 0.01
"""Default for the least number of new objects that a look must be expected to find."""

_Picture = LargePicture | ImageLike


class ZoomAgent(nn.Module):
    """Search and explore pictures that are larger than the detector's input.

    Each look is a window at a magnification and costs one pass of the detector. The agent looks where it expects to
    find most, as closely as it takes to find it. Without evidence it learns nothing: after the overview it looks at
    slices in the order of the overview's scores in them (`semfov.zoom.slices`). `semfov fit` makes evidence for a
    detector of your own, with which fewer passes find as much, and searches end early and can decide `absent`.

    Args:
        eye: resamples a window and detects in it.
        evidence: predicts from a look what closer looks will find; None for slices.

    Raises:
        InputError: the evidence was made for other classes, or for another detector.

    Example::

        agent = ZoomAgent.recommended("yolox-nano")
        path = agent.find_all("harbour.tif", "person", passes=16)
        print(path.objects.boxes, path.passes)
    """

    def __init__(self, eye: WindowEye, evidence: GlimpseEvidence | None = None) -> None:
        super().__init__()
        if evidence is not None:
            kinds = len(eye.detector.classes)
            check(evidence.classes == kinds, "evidence", f"one for the detector's {kinds} classes", evidence.classes)
            evidence.check_compatible(eye.settings())
        self.eye = eye
        self.evidence = evidence

    @classmethod
    def recommended(cls, name: str = "yolov3-tiny", *, finest: float = 1.0, cut: Cut = "keep", **options: Any) -> Self:
        """Create the agent with the evidence that is shipped for a detector.

        Args:
            name: name of the detector.
            finest: largest magnification, in canvas pixels per picture pixel.
            cut: treatment of boxes that the border of a window cuts (`WindowEye`).
            **options: options of `semfov.load_detector`.

        Returns:
            The agent, in evaluation mode and without gradients.

        Raises:
            InputError: no evidence is shipped for a detector of this name.
            DataError: the weights cannot be downloaded, or they are damaged.
        """
        check_options(options, ["finest", "cut", *loader_options()], "the agent or of semfov.load_detector")
        eye = WindowEye(load_detector(name, **options), finest=finest, cut=cut)
        evidence = GlimpseEvidence.from_pretrained(eye.detector.name)
        return cls(eye, evidence).eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.eye.detector.classes)

    def pays(self, picture: _Picture) -> bool:
        """Tell whether a picture is large enough for windows to pay.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.

        Returns:
            True where there are two octaves or more to zoom in: the longer side of the picture is at least four times
            that of the detector's input.
        """
        return pays(picture_size(picture), self.eye.detector.input_size)

    def search(
        self,
        picture: _Picture,
        target: str | int,
        *,
        passes: int | None = None,
        seconds: float | None = None,
        on_look: OnLook | None = None,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = CLOSER,
    ) -> ZoomPath:
        """Search for one object of a class and decide whether the picture holds one (`search_windows`).

        The recommended agent looks closely at places that seem to hold the class before it says `found`
        (`semfov.zoom.closer`).

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class.
            passes: largest number of passes of the detector, closer looks included; None takes 24.
            seconds: longest time in seconds on this machine.
            on_look: called after each look with the record so far; returning False ends the search.
            confirm: the class counts as found when the probability reaches this value: with closer looks, that it is at
                the place; otherwise, that the picture holds it. None takes the threshold of the evidence. Without
                evidence it is the least score of a detection; None takes 0.5.
            give_up: the search ends when no look shows the class with a probability of at least this value; None takes
                the threshold of the evidence.
            closer: largest number of closer looks, 0 to 100. 0 decides without them, as does evidence without fitted
                verification.

        Returns:
            The looks, the objects of the class, and the decision.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the file cannot be read.
        """
        limits = EpisodeLimits(USUAL_PASSES if passes is None else passes, seconds, on_look)
        check_thresholds(confirm, give_up)
        check_whole(closer, "closer", 0, 100)
        index = class_index(target, self.classes[1:], "target")
        glances, evidence = self._open(picture), self._evidence()
        with torch.inference_mode():
            if evidence is None:
                return _search_slices(glances, self.classes, index, limits, confirm)
            return search_windows(
                glances, evidence, self.classes, index, limits, confirm=confirm, give_up=give_up, closer=closer
            )

    def find_all(
        self,
        picture: _Picture,
        target: str | int | Sequence[str | int] | None = None,
        *,
        passes: int | None = None,
        seconds: float | None = None,
        on_look: OnLook | None = None,
        batch: int = 1,
        worth: float = NEW_OBJECTS,
        least: float | None = None,
    ) -> ZoomPath:
        """Find all objects of a class, of several or of all classes.

        With fitted evidence the scores of objects are the probabilities that box and class are right
        (`semfov.zoom.certainty`).

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            target: name or index (1..K) of the class, several in a list, or None for all. Windows for several classes
                are chosen as for all classes.
            passes: largest number of passes of the detector; None takes 24.
            seconds: longest time in seconds on this machine.
            on_look: called after each look with the record so far; returning False ends the exploration.
            batch: number of windows that are chosen jointly and pass the detector together.
            worth: the exploration ends when no look is expected to find more new objects than this.
            least: probability from which on objects count; None takes 0.5. Without evidence it is their score, and None
                takes 0.3.

        Returns:
            The looks and the objects.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the file cannot be read.
        """
        targets = class_numbers(target, self.classes[1:], "target")
        limits = EpisodeLimits(USUAL_PASSES if passes is None else passes, seconds, on_look)
        check_whole(batch, "batch", 1, MOST_PASSES)
        check_number(worth, "worth", 0, float("inf"))
        if least is not None:
            check_number(least, "least", 0, 1)
        glances, evidence = self._open(picture), self._evidence()
        one = targets[0] if len(targets) == 1 else None
        turns: Iterator[WindowStep[Any]]
        slicing = evidence is None or glances.lattice.levels == 1
        if evidence is None or slicing:
            turns = look_by_look(glances, ranked(usual_slices(glances.lattice), targets), None)
        else:
            turns = find_everything(glances, evidence, one, batch=batch, worth=worth)
        path = _Windows(glances, self.classes, one, targets if len(targets) > 1 else (), evidence, least)
        ending: Ending | None = None
        with torch.inference_mode():
            for turn in turns:
                path.add(turn)
                ending = limits.reached(len(path.looks), path.record)
                if ending is not None:
                    break
        return path.record(ending or ("windows" if slicing else "worth"))

    def explore(self, picture: _Picture, **options: Any) -> ZoomPath:
        """Find all objects of all classes.

        Args:
            picture: a file, another picture of any common kind (`semfov.as_image`), or a `LargePicture`.
            options: arguments of `find_all`, except for the target.

        Returns:
            The looks and the objects.

        Raises:
            InputError: an argument does not fit.
            DataError: the file cannot be read.
        """
        return self.find_all(picture, None, **options)

    def _evidence(self) -> GlimpseEvidence | None:
        """The evidence on the CPU, where the looks are that it reads."""
        return None if self.evidence is None else on_cpu(self.evidence)

    def _open(self, picture: _Picture) -> LiveGlances:
        return LiveGlances(self.eye, self.eye.open(picture))


def pays(size: tuple[int, int], canvas: tuple[int, int]) -> bool:
    """Tell whether a picture is large enough for windows to pay.

    >>> pays((3840, 2160), (416, 416)), pays((640, 480), (416, 416))
    (True, False)

    Shapes: size `(width, height)`, canvas `(width, height)`.
    """
    return Lattice.over(size, canvas).levels >= 3


def search_windows(
    glances: Glances,
    evidence: GlimpseEvidence,
    classes: tuple[str, ...],
    target: int,
    limits: EpisodeLimits,
    *,
    confirm: float | None = None,
    give_up: float | None = None,
    closer: int = CLOSER,
) -> ZoomPath:
    """Search a picture for one object of a class and decide whether it is there.

    Places that seem to hold the target are looked at closely, and the target is `found` when it is probable enough at
    such a place (`semfov.decision.Verifier`). The search goes on as long as no place is. Without closer looks it is
    `found` when the picture holds it with a probability of at least `confirm` and a detection shows it
    (`semfov.decision.settle`).

    When the value of every look that is left is below `give_up`, or all closer looks were made, the target is `absent`
    if its probability is below one half, and the search is `undecided` otherwise. It is also `undecided` when the
    passes are used up.
    """
    path = _Windows(glances, classes, target, (), evidence)
    looks, values = path.looks, path.values

    def close_up(box: Tensor) -> Detections:
        looks.append(look_closely(glances, box))
        return candidates(looks[-1])

    deciding = WindowDecisions(evidence, target, close_up, confirm=confirm, give_up=give_up, closer=closer)
    ending: Ending | None = None
    for turn in look_for(glances, evidence, target, confirm=float("inf")):
        path.add(turn, counting=False)
        ending = limits.reached(len(looks), path.record)
        deciding.see(turn, len(looks), last=turn.ahead == 0 or limits.room(len(looks)) <= 1)
        while ending is None and deciding.candidate is not None:
            values.append(deciding.candidate.probability)
            deciding.look()
            ending = limits.reached(len(looks), path.record)
        if deciding.outcome or ending is not None:
            break
    decision = deciding.decision(over=deciding.outcome > 0)
    if deciding.outcome or decision.outcome == "found":
        ending = "decision"
    return replace(path.record(ending or "windows"), decision=decision, closer=tuple(deciding.looks))


def _search_slices(
    glances: Glances, classes: tuple[str, ...], target: int, limits: EpisodeLimits, confirm: float | None = None
) -> ZoomPath:
    """Search a picture by slices, in the order of the overview's scores; nothing is learned, so nothing is `absent`."""
    path = _Windows(glances, classes, target)
    ending: Ending | None = None
    for turn in look_by_look(glances, ranked(usual_slices(glances.lattice), [target]), None):
        path.add(turn)
        ending = limits.reached(len(path.looks), path.record)
        decision = decide_by_score(path.looks, target, confirm)
        if decision.outcome == "found":
            ending = "detection"
        if ending is not None:
            break
    return replace(path.record(ending or "windows"), decision=decision)


def least_of(certainty: Certainty | None) -> float:
    """The default of `least`: of probabilities where there is a certainty, else of scores."""
    return LEAST if certainty is None else LIKELY


def window_objects(
    glances: Sequence[Glance],
    lattice: Lattice,
    target: int | Sequence[int] | None,
    certainty: Certainty | None,
    belief: ZoomBelief | None,
    promised: float,
    *,
    latest: bool = False,
) -> tuple[Objects, tuple[float, float] | None]:
    """The objects of some looks, and the number of those that no look has shown, with its variance."""
    if certainty is None:
        return merge(glances, target), None
    # A belief about objects of any class says nothing about those of several.
    several = target is not None and not isinstance(target, int)
    remaining = (0.0, 0.0) if belief is None or several else belief.remaining()
    return probable_objects(glances, lattice, target, certainty, remaining=remaining, promised=promised, latest=latest)


class _Windows:
    """The looks of an episode so far, of which records are made."""

    def __init__(
        self,
        glances: Glances,
        classes: tuple[str, ...],
        target: int | None,
        targets: tuple[int, ...] = (),
        evidence: GlimpseEvidence | None = None,
        least: float | None = None,
    ) -> None:
        self.glances, self.classes, self.target, self.targets = glances, classes, target, targets
        self.certainty = None if evidence is None else evidence.certainty_in(glances.lattice)
        self.least = least_of(self.certainty) if least is None else least
        self.belief: ZoomBelief | None = None
        self.promised = 0.0
        self.looks: list[Glance] = []
        self.values: list[float] = []
        self.picture = glances.view.picture if isinstance(glances, LiveGlances) else None
        self.source = None if self.picture is None or self.picture.path is None else str(self.picture.path)

    @cached_property
    def photograph(self) -> Tensor | None:
        """A reduced copy of the picture; None for stored looks."""
        return None if self.picture is None else reduced_copy(self.picture)

    def add(self, turn: WindowStep[Any], *, counting: bool = True) -> None:
        """Add a look; `counting` in an exploration, in which the value of a look is a number of expected objects."""
        if counting:
            self.promised += turn.worth if self.looks else 0.0
            self.belief = turn.belief
        self.looks.append(turn.glance)
        self.values.append(turn.worth)

    def record(self, ending: Ending | None = None) -> ZoomPath:
        """The record so far."""
        objects, unseen = window_objects(
            self.looks, self.glances.lattice, self.targets or self.target, self.certainty, self.belief, self.promised
        )
        return ZoomPath(
            lattice=self.glances.lattice,
            classes=self.classes,
            target=self.target,
            targets=self.targets,
            glances=tuple(self.looks),
            values=tuple(self.values),
            candidates=objects,
            unseen=unseen,
            least=self.least,
            ending=ending,
            photograph=self.photograph,
            source=self.source,
        )
