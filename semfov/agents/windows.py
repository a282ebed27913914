"""Looks at windows of a picture larger than the detector's input, or of the frames of a stream."""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache, cached_property, partial
from math import isfinite
from time import perf_counter
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.agents.episode import MOST_PASSES, Episode, EpisodeLimits, OnLook, on_cpu
from semfov.belief.prior import Prior
from semfov.data.classes import class_index, class_numbers
from semfov.data.inputs import Color, ImageLike
from semfov.data.large import open_large
from semfov.data.windowed import LargePicture
from semfov.decision import Decision, check_thresholds
from semfov.detection import LEAST, Detections
from semfov.detection.load import load_detector, loader_options
from semfov.errors import InputError, check, check_number, check_options, check_whole
from semfov.motion import CameraMotion, CameraStep, KnownPoses
from semfov.paths import Ending, RecordedLook, WindowMoment, ZoomPath
from semfov.paths.stimulus import reduced_copy
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.blank import blank_cells
from semfov.zoom.carrying import inside_frame
from semfov.zoom.certainty import SPREAD
from semfov.zoom.closer import USUAL_WINDOW, closer_window, look_closely
from semfov.zoom.decision import WindowDecisions
from semfov.zoom.episode import KeptLook, WindowStep, find_everything, look_by_look, look_for
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import Cut, WindowEye, WindowView
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook, WindowLooks
from semfov.zoom.objects import merge, probable_objects
from semfov.zoom.slices import ranked, usual_slices

LIKELY = 0.5  # default for the least probability of the objects that a record counts
_NEW_OBJECTS = 0.01  # default for the least number of new objects that a look must be expected to find

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

    Attributes:
        classes: names of the classes, background first.

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
        self.eye, self.evidence = eye, evidence
        self.classes = ("background", *eye.detector.classes)

    @classmethod
    def recommended(cls, name: str = "yolox-nano", *, finest: float = 1.0, cut: Cut = "keep", **options: Any) -> Self:
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
        return cls(eye, GlimpseEvidence.from_pretrained(eye.detector.name)).eval().requires_grad_(False)

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
        closer: int | None = None,
        prior: float | None = None,
    ) -> ZoomPath:
        """Search for one object of a class and decide whether the picture holds one (`WindowEpisode`).

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
            closer: largest number of closer looks, 0 to 100; None takes 3 in a photograph, and in a larger picture as
                many as there are passes for. 0 decides without them, as does evidence without fitted verification.
            prior: how often the class is there, as a share of the pictures that are searched; None: in half of them.

        Returns:
            The looks, the objects of the class, and the decision.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the file cannot be read.
        """
        check_thresholds(confirm, give_up, closer)
        episode = self.episode(
            class_index(target, self.classes[1:], "target"),
            limits=EpisodeLimits(WindowEpisode.usual_passes if passes is None else passes, seconds, on_look),
            confirm=confirm, give_up=give_up, closer=closer, prior=prior,
        )  # fmt: skip
        return episode.open(LiveWindowLooks(self.eye, self.eye.open(picture))).run()

    def find_all(
        self,
        picture: _Picture,
        target: str | int | Sequence[str | int] | None = None,
        *,
        passes: int | None = None,
        seconds: float | None = None,
        on_look: OnLook | None = None,
        batch: int = 1,
        worth: float = _NEW_OBJECTS,
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
        limits = EpisodeLimits(WindowEpisode.usual_passes if passes is None else passes, seconds, on_look)
        check_whole(batch, "batch", 1, MOST_PASSES)
        check_number(worth, "worth", 0, float("inf"))
        if least is not None:
            check_number(least, "least", 0, 1)
        episode = self.episode(None, targets, limits=limits, batch=batch, worth=worth, least=least)
        return episode.open(LiveWindowLooks(self.eye, self.eye.open(picture))).run()

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

    def episode(self, target: int | None = None, targets: tuple[int, ...] = (), **settings: Any) -> "WindowEpisode":
        """The episode of a search or an exploration, which looks when it is asked to.

        Args:
            target: class 1..K to search for; None finds all objects.
            targets: classes 1..K whose objects are all to be found; none: of all classes.
            **settings: further arguments of `WindowEpisode`.

        Returns:
            The episode, to be opened with looks at a picture, or given frames.
        """
        # The evidence computes on the CPU, where the looks are that it reads.
        evidence = None if self.evidence is None else on_cpu(self.evidence)
        return WindowEpisode(self.classes, evidence, target, targets, eye=self.eye, **settings)


class WindowEpisode(Episode[ZoomPath]):
    r"""Looks at windows: of a picture, of the frames of a stream, or where it is told to.

    A search decides by closer looks (`semfov.decision.Verifier`), or without them by the probability of the picture and
    a detection that shows the target (`semfov.decision.settle`). Without evidence slices are looked at in the order of
    the overview's scores, and nothing is `absent`.

    In a stream a look counts for :math:`\ln 2 / r` seconds, with the rate r, or until the next look at the same window
    (`semfov.zoom.episode.look_by_look`), and what a later look has shown as closely replaces what earlier ones did.
    With rate 0 frames of a still picture give the looks and the objects of an episode of the picture up to its end.
    """

    usual_passes = 24
    """Default for the largest number of passes of the detector."""

    def __init__(
        self,
        classes: tuple[str, ...],
        evidence: GlimpseEvidence | None,
        target: int | None = None,
        targets: tuple[int, ...] = (),
        *,
        limits: EpisodeLimits | None = None,
        rate: float | None = None,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int | None = None,
        prior: float | None = None,
        batch: int = 1,
        worth: float = _NEW_OBJECTS,
        least: float | None = None,
        color: Color = "rgb",
        eye: WindowEye | None = None,
        follows: bool = False,
    ) -> None:
        super().__init__(classes, target, targets, limits, rate)
        self.evidence, self.eye, self.color = evidence, eye, color
        photograph = None if evidence is None else evidence.photograph
        self._closer = USUAL_WINDOW if photograph is None else photograph.window
        self.batch, self.worth, self._least = batch, worth, least
        self._confirm = 0.5 if confirm is None else confirm
        self._decisions: WindowDecisions | None = None
        if evidence is not None and target is not None:
            self._decisions = WindowDecisions(
                evidence, target, self._close_up,
                confirm=confirm, give_up=give_up, closer=closer, forgetting=self.forgetting, prior=prior,
            )  # fmt: skip
        elif self.searches:
            Prior.of(prior, None, 0)  # without evidence there is no probability
            self.criterion = f"a detection scores {self._confirm:g}"
        self._source: WindowLooks | None = None
        self._last: WindowStep[Any] | None = None
        self._newest: KeptLook | None = None
        self._closer_looks: list[KeptLook] = []
        self._camera = _followed_camera() if follows else None
        self._poses: KnownPoses | None = None
        self._lost = False
        self._concluded: Decision | None = None
        self._began = perf_counter()

    def open(self, source: WindowLooks, *, told: bool = False) -> Self:
        """Begin with a picture, or with the first frame of a stream."""
        self.certainty = None if self.evidence is None else self.evidence.certainty_in(source.lattice)
        # From this probability, or score, on objects count. Without evidence and in photographs slices are looked at.
        usual = LEAST if self.certainty is None else LIKELY
        self.least = usual if self._least is None else self._least
        self._slicing = self.evidence is None or source.lattice.levels == 1
        self._source, sought = source, self.targets or (() if self.target is None else (self.target,))
        self._steps: Iterator[WindowStep[Any]]
        still = self.forgetting is None or self.forgetting.rate == 0
        if isinstance(source, LiveWindowLooks) and still and not told and source.lattice.levels > 1:
            source.blank = cache(partial(blank_cells, source.view.picture, source.lattice))
        if self.forgetting is None and not told:
            # The choice after the overview asks for the first, and the record at the end for the second.
            source.meanwhile = lambda: (source.blank(), self._photograph)
        if told:
            self.searches, self._decisions = False, None
            belief = None if self.evidence is None else ZoomBelief(source.lattice, self.evidence, self.target or 0)
            self._steps = look_by_look(source, lambda looks, windows: [(self._window, 0.0)], belief)
        elif self.evidence is None or (self._slicing and not self.searches):
            order = ranked(usual_slices(source.lattice, source.blank()), sought)
            self._steps = look_by_look(
                source,
                order,
                None,
                forgetting=self.forgetting,
                guess=lambda looks, done, _: next(iter(order(looks, done)), None),
            )
        elif self.searches and self.target is not None:
            self._steps = look_for(source, self.evidence, self.target, forgetting=self.forgetting)
        else:
            self._steps = find_everything(
                source, self.evidence, self.target, batch=self.batch, worth=self.worth, forgetting=self.forgetting
            )
        return self

    def look(self, frame: ImageLike | LargePicture | None = None, window: Window | None = None) -> RecordedLook | None:
        """Look at the next window, at a given one, or closely at a place that seems to hold the target."""
        with torch.inference_mode():
            if frame is not None:
                assert self.eye is not None
                view = self.eye.open(open_large(frame, color=self.color))
                self._check_size(view.picture.size)
                if self._source is None:
                    self.open(LiveWindowLooks(self.eye, view))
                self._follow(view)
                if self._decisions is not None:
                    self._decisions.wait(self.passed)
            assert self._source is not None
            if window is not None:
                self._window = window
            candidate = None if self._decisions is None else self._decisions.candidate
            if self._decisions is not None and candidate is not None:
                self._decisions.look()
                self._closer_looks[-1].value = candidate.probability
            elif not self._step():
                return None
            if self.forgetting is None:
                if self._decisions is not None and self._decisions.outcome and self._decisions.candidate is None:
                    self.ending = "decision"
                elif self.searches and self.evidence is None and self.decision is not None:
                    self.ending = "detection" if self.decision.outcome == "found" else None
            assert self._newest is not None
            seen, lattice = self._newest, self._source.lattice
            return RecordedLook(
                seen.number,
                seen.taken.window.centre(lattice),
                seen.taken.window.region(lattice),
                seen.taken.detections,
                seen.seconds,
                seen.value if isfinite(seen.value) else None,
            )

    def _follow(self, view: WindowView) -> None:
        """Take the next frame of a stream, and carry what is known along with the camera."""
        assert isinstance(self._source, LiveWindowLooks)
        camera = self._camera_step(view)
        if camera is None or self._newest is None:
            self._source.show(view, self.passed)
            return
        self._source.show(view, self.passed, camera)
        self._lost = camera.motion is None and camera.recovered is None
        if camera.is_still:
            return
        if camera.motion is None:
            self._closer_looks = []
        else:
            for look in self._closer_looks:
                look.carry(camera.motion, self._source.lattice)
        if self._decisions is not None:
            self._decisions.follow(camera.motion)

    def _camera_step(self, view: WindowView) -> CameraStep | None:
        """How the camera moved since the last frame, by its pose or by the frames; None if it is not followed."""
        first = self._newest is None
        check(
            first or (self.pose is None) == (self._poses is None), "pose", "a pose of each frame, or of none", self.pose
        )
        if self.pose is not None:
            self._poses = self._poses or KnownPoses()
            return self._poses.step(self.pose)
        if self._camera is None:
            return None
        width, height = view.picture.size
        return self._camera.step(view.picture.pixels((0, 0, width, height)))

    def _step(self) -> bool:
        """Make the next look of the search or the exploration; returns whether one was left."""
        assert self._source is not None
        step = next(self._steps, None)
        if step is None:
            return False
        self._last = step
        self._number(step.newest)
        if self.forgetting is not None:
            oldest = self._source.time - self.forgetting.span
            self._closer_looks = [look for look in self._closer_looks if look.time >= oldest]
        if self._decisions is not None:
            last = step.ahead == 0 or self.limits.room(self.passes) <= 1
            self._decisions.see(step, self.passes, last=last)
            self.criterion = self._decisions.criterion
        return True

    def _close_up(self, box: Tensor) -> Detections:
        """Spend a pass on a closer look at a box."""
        assert self._source is not None
        look = KeptLook(look_closely(self._source, box, self._closer), self._source.time, 0.0)
        self._number(look)
        self._closer_looks.append(look)
        return look.taken.candidates

    def _number(self, look: KeptLook) -> None:
        """Give the newest look the number of its pass and the time at its end."""
        look.number, look.seconds = self.passes, perf_counter() - self._began
        self._newest = look
        self.passes += 1

    def _end(self, limit: Ending | None) -> None:
        decided: Ending = "decision"
        if self._decisions is not None:
            self._concluded = self._decisions.decision(over=self._decisions.outcome > 0)
        elif self.searches:
            self._concluded, decided = self.decision, "detection"
        found = self._concluded is not None and self._concluded.outcome == "found"
        usual: Ending = "windows" if self.searches or self._slicing else "worth"
        over = found or (self._decisions is not None and self._decisions.outcome > 0)
        self.ending = decided if over else limit or usual

    @property
    def decision(self) -> Decision | None:
        """The decision of a search as it stands; by the scores of detections alone where nothing was learned."""
        if self._concluded is not None:
            return self._concluded
        if self._decisions is not None:
            return self._decisions.decision()
        if not self.searches or self.target is None:
            return None
        best, box = 0.0, None
        for detections in (look.detections for look in self.window_looks):
            scores = detections.class_scores[0, :, self.target - 1]
            if len(scores) and float(scores.max()) > best:
                best, box = float(scores.max()), detections.boxes[0, scores.argmax()]
        return Decision("found", best, None, box) if best >= self._confirm else Decision("undecided", best)

    @property
    def belief(self) -> ZoomBelief | None:
        """The belief after the last look; None without evidence, and before the first look."""
        return None if self._last is None else self._last.belief

    @property
    def window_looks(self) -> list[WindowLook]:
        """The looks that count, in their order, where they lie in the present frame."""
        return [look.current for look in self._looks]

    @property
    def _looks(self) -> list[KeptLook]:
        """The looks that count, in their order."""
        chosen = () if self._last is None else self._last.kept
        return sorted([*chosen, *self._closer_looks], key=lambda look: look.number)

    def record(self) -> ZoomPath:
        picture = self._source.view.picture if isinstance(self._source, LiveWindowLooks) else None
        path = None if picture is None else picture.path
        return ZoomPath(
            **self._recorded(),
            photograph=self._photograph,
            source=None if path is None else str(path),
            shown=None if picture is None else picture.shown,
            ending=self.ending,
        )

    def moment(self) -> WindowMoment:
        assert self._last is not None
        assert isinstance(self._source, LiveWindowLooks)
        candidate = None if self._decisions is None else self._decisions.candidate
        return WindowMoment(
            **self._recorded(),
            photograph=reduced_copy(self._source.view.picture),
            number=self.passes - 1,
            lost=self._lost,
            next_window=self._last.choices[0][0]
            if candidate is None
            else closer_window(self._source.lattice, candidate.box, self._closer),
        )

    def _recorded(self) -> dict[str, Any]:
        """What the record of a picture and that of a frame share."""
        assert self._source is not None
        lattice, looks = self._source.lattice, self._looks
        window_looks = [look.current for look in looks]
        fading = self.forgetting is not None and self.forgetting.rate > 0
        closer = () if self._decisions is None else self._decisions.looks
        places = {look.number: place for place, look in enumerate(looks)}
        current = _without_replaced(window_looks, lattice) if fading else window_looks
        sought, unseen = self.targets or self.target, None
        if self.certainty is None:
            objects = merge(current, sought)
        else:
            belief = None if self.searches else self.belief
            # A belief about objects of any class says nothing about those of several.
            remaining = (0.0, 0.0) if belief is None or self.targets else belief.remaining()
            chosen = () if self._last is None else self._last.kept
            further = [look.value for look in chosen[1:] if isfinite(look.value)]
            objects, unseen = probable_objects(
                current, lattice, sought, self.certainty, remaining=remaining, promised=sum(further), latest=fading
            )
        if self._camera is not None or self._poses is not None:
            objects = objects[inside_frame(objects.boxes, lattice.size)]
        return {
            "lattice": lattice,
            "classes": self.classes,
            "target": self.target,
            "targets": self.targets,
            "decision": self.decision,
            "window_looks": tuple(window_looks),
            "values": tuple(look.value for look in looks),
            "seconds": tuple(look.seconds for look in looks),
            "candidates": objects,
            "unseen": unseen,
            "spread": SPREAD if self.certainty is None else self.certainty.spread,
            "least": self.least,
            "detector": None if self.eye is None else self.eye.detector.name,
            "closer": tuple(replace(look, number=places[look.number]) for look in closer if look.number in places),
        }

    @cached_property
    def _photograph(self) -> Tensor | None:
        """A reduced copy of the picture; None for stored looks."""
        return reduced_copy(self._source.view.picture) if isinstance(self._source, LiveWindowLooks) else None


def _followed_camera() -> CameraMotion | None:
    """What follows a camera that moves; without OpenCV a warning, and the camera is taken to stand still."""
    try:
        return CameraMotion()
    except InputError as error:
        warnings.warn(f"the camera is taken to stand still, unless poses are given: {error}", stacklevel=2)
        return None


def _without_replaced(looks: Sequence[WindowLook], lattice: Lattice) -> list[WindowLook]:
    """The looks at a stream, without detections whose place and surroundings a later look has shown as closely."""
    current = []
    for number, look in enumerate(looks):
        detections, left = look.detections, look.detections.mask[0]
        low, high = detections.boxes[0].split(2, -1)
        around = (high - low) / 2
        low, high = (low - around).clamp(min=0), (high + around).minimum(low.new_tensor(lattice.size))
        for later in (each.window for each in looks[number + 1 :]):
            if later.fixation[2] >= look.window.fixation[2]:
                first, last = low.new_tensor(later.region(lattice)).split(2)
                left = left & ~((low >= first) & (high <= last)).all(-1)
        current.append(replace(look, detections=detections.take(left), cut=look.cut[left]))
    return current
