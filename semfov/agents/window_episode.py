"""Episodes of looks at windows of a picture, of the frames of a stream, or at a given list of windows.

`WindowTask` says what is looked for, and with what. `WindowSession` looks at the windows of one source: it chooses
them, makes closer looks, and decides; the objects are merged when a record is read (`semfov.agents.window_objects`).
Three short drivers stand on it: `WindowEpisode` looks at a picture, whose record is a `ZoomPath`; `WindowStream` has
the looks that count at the present frame, a `WindowMoment`; and `GivenWindows` looks where it is asked to.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from math import isfinite

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from semfov.agents.episode import EpisodeLimits, Goal, PictureEpisode, StreamEpisode
from semfov.agents.stream_camera import StreamCamera
from semfov.agents.window_objects import MergedLooks, seen_by
from semfov.belief.prior import Prior
from semfov.data.inputs import Color, ImageLike
from semfov.data.large import ArrayPicture, open_large
from semfov.data.windowed import LargePicture
from semfov.decision import CandidatePlace, CloseUp, Decision
from semfov.detection import SCORE_THRESHOLD, Objects
from semfov.episode import Forgetting
from semfov.motion import CameraStep, LostScene, Motion
from semfov.observation.matching import inside_frame
from semfov.paths import Ending, WindowMoment, ZoomPath
from semfov.paths.conversion import Values
from semfov.paths.stimulus import reduced_copy
from semfov.paths.windows import LookAtWindow, look_at_window
from semfov.settings import DecisionSettings, value_or
from semfov.tracking import Tracker, Tracks
from semfov.tracking.gain import value_of_windows
from semfov.zoom.belief import ZoomBelief
from semfov.zoom.blank import blank_cells
from semfov.zoom.certainty import SPREAD
from semfov.zoom.closer import USUAL_WINDOW, closer_window, look_closely
from semfov.zoom.decision import DecisionsByScore, WindowDecisions, decisions_of
from semfov.zoom.episode import KeptLook, WindowStep, carry_along, find_everything, look_by_look, search_windows
from semfov.zoom.evidence import GlimpseEvidence
from semfov.zoom.eye import WindowEye, WindowView
from semfov.zoom.lattice import Lattice
from semfov.zoom.looks import LiveWindowLooks, Window, WindowLook, WindowLooks
from semfov.zoom.policy import WindowChoice, WindowValues
from semfov.zoom.slices import ranked, usual_slices

PASSES = 24  # default for the largest number of passes of the detector
# From 0.2 on half of a stream's list would be wrong where people are few (docs/measurements/stream.md).
LIKELY = 0.5  # default for the least probability of the objects that a record counts
NEW_OBJECTS = 0.01  # default for the least number of new objects that a look must be expected to find


@dataclass(frozen=True)
class WindowTask:
    """The goal of looks at windows, and the fitted models and settings for reaching it.

    Attributes:
        goal: what is looked for.
        evidence: predicts from a look how many objects smaller windows show; None looks at slices in the order of the
            overview's scores, and then nothing is `absent`.
        decisions: settings of the decision of a search.
        min_gain: an exploration ends when no look is expected to find more new objects than this; None for the usual
            number. In a photograph, and without evidence, all slices are looked at, and it means nothing.
        batch: number of windows that are chosen jointly (`semfov.zoom.policy.jointly`) and pass the detector together.
            It counts where all objects of a large picture are found with evidence; else there is one at a time: in a
            search, in a photograph, and in slices.
        score_threshold: probability, without evidence score, from which on objects count; None for the usual one.
        detector: name of the detector; None if it is not known.
        usual_score: score from which on objects count where neither evidence nor `score_threshold` says it
            (that of the detector).
    """

    goal: Goal
    evidence: GlimpseEvidence | None = None
    decisions: DecisionSettings = field(default_factory=DecisionSettings)
    min_gain: float | None = None
    batch: int = 1
    score_threshold: float | None = None
    detector: str | None = None
    usual_score: float = SCORE_THRESHOLD

    def __post_init__(self) -> None:
        if self.evidence is None and self.goal.searches:
            Prior.of(self.decisions.prior, None)  # without evidence there is no probability

    def takes_slices(self, lattice: Lattice) -> bool:
        """Tell whether the agent looks at slices, in the order of their scores in the first look at the whole picture.

        It does so without evidence, and in a photograph if it does not search; otherwise a belief chooses its windows.
        """
        return self.evidence is None or (lattice.levels == 1 and not self.goal.searches)


class WindowSession:
    """Looks at the windows of one source: a picture, or a scene that a camera shows frame by frame.

    Invariant: `step` is the last look that was no closer look, None before the first one. All numbers are those after
    the last look, and all places are where they lie in the present frame.

    Args:
        task: what is looked for.
        source: the source of looks.
        limits: where the episode ends; they have its clock.
        forgetting: how evidence fades in a stream; None for a picture.
        steps: the looks as they are made; None chooses windows by the task.

    Attributes:
        decisions: what is decided after each look.
        passes: number of passes of the detector so far.
        newest: the last look of any kind; None before the first one.
        follows: whether the camera is followed, so that objects may lie beyond the frame.
    """

    def __init__(
        self,
        task: WindowTask,
        source: WindowLooks,
        limits: EpisodeLimits,
        forgetting: Forgetting | None = None,
        steps: Iterator[WindowStep[ZoomBelief | None]] | None = None,
    ) -> None:
        evidence = task.evidence
        self.task = task
        self.source = source
        self.limits = limits
        self.forgetting = forgetting
        self.decisions = WindowDecisions()
        self.passes = 0
        self.newest: KeptLook | None = None
        self.step: WindowStep[ZoomBelief | None] | None = None
        self.follows = False
        photograph = None if evidence is None else evidence.photograph
        self._close_window = USUAL_WINDOW if photograph is None else photograph.window
        self._certainty = None if evidence is None else evidence.certainty_in(source.lattice)
        self.tracker = None if self._stands_still or evidence is None else Tracker()
        self._closer_looks: list[KeptLook] = []  # those that count
        self._lost_looks: LostScene[KeptLook] = LostScene()  # closer looks at a scene that may be found again
        self._steps = self._chosen_steps() if steps is None else steps

    @property
    def _stands_still(self) -> bool:
        """Whether nothing is forgotten, as in a picture."""
        return self.forgetting is None or self.forgetting.rate == 0

    def _chosen_steps(self) -> Iterator[WindowStep[ZoomBelief | None]]:
        """Choose by the task how windows are chosen, and what decides; returns the looks as they are made."""
        task = self.task
        source = self.source
        evidence = task.evidence
        # Sought once, so not in a stream, whose frames change.
        if isinstance(source, LiveWindowLooks) and self._stands_still and source.lattice.levels > 1:
            source.blank = cache(partial(blank_cells, source.view.picture, source.lattice))
        if task.goal.searched is not None:
            return self._search(task.goal.searched, evidence)
        if evidence is None or task.takes_slices(source.lattice):
            return self._slices()
        return find_everything(
            source,
            evidence,
            task.goal.target,
            batch=task.batch,
            min_gain=value_or(task.min_gain, NEW_OBJECTS),
            forgetting=self.forgetting,
            known=None if self.tracker is None else self._value_of_known,
        )

    def _search(self, target: int, evidence: GlimpseEvidence | None) -> Iterator[WindowStep[ZoomBelief | None]]:
        """Search for a class by a belief, or without evidence by the scores in slices."""
        settings = self.task.decisions
        if evidence is None:
            self.decisions = DecisionsByScore(target, settings.confirm)
            return self._slices()
        belief = ZoomBelief(self.source.lattice, evidence, target, self.source.blank)
        self.decisions = decisions_of(belief, settings, self.forgetting)
        return search_windows(self.source, belief, forgetting=self.forgetting)

    def _slices(self) -> Iterator[WindowStep[None]]:
        """Look at slices in the order of the overview's scores in them."""
        order = ranked(usual_slices(self.source.lattice, self.source.blank()), self.task.goal.sought)

        def next_slice(looks: Sequence[WindowLook], windows: set[Window], _: Window | None) -> WindowChoice | None:
            choices = order(looks, windows)
            return choices[0] if choices else None

        return look_by_look(self.source, order, None, forgetting=self.forgetting, guess=next_slice)

    def _value_of_known(self, level: int) -> WindowValues:
        """Value windows of a level by the objects that are known, and may have moved."""
        assert self.tracker is not None
        return value_of_windows(self.tracker.tracks, self.tracker.model, self.source.lattice, level)

    def look(self) -> KeptLook | None:
        """Look at the next window, or take a closer look at a likely place; returns None if no window is left."""
        if self.forgetting is not None:
            self._closer_looks = [look for look in self._closer_looks if self._counts(look)]
        if self.decisions.candidate is not None:
            return self._look_closely(self.decisions.candidate)
        step = next(self._steps, None)
        if step is None:
            return None
        self.step = step
        self._number(step.newest)
        self.decisions.see(step, self.kept_looks, self.passes, self.limits.room(self.passes))
        return step.newest

    def _look_closely(self, candidate: CandidatePlace) -> KeptLook:
        """Spend a pass on a closer look at the candidate."""
        original = look_closely(self.source, candidate.box, self._close_window)
        look = KeptLook(original, self.source.time, candidate.probability)
        self._number(look)
        self._closer_looks.append(look)
        # No look at another window forgets what has aged meanwhile, and places of old looks would be due for ever.
        self.decisions.examine(original, [kept for kept in self.kept_looks if self._counts(kept)])
        return look

    def _counts(self, look: KeptLook) -> bool:
        """Tell whether half of what a look showed, or more, is left."""
        return self.forgetting is None or look.time >= self.source.time - self.forgetting.span

    def _number(self, look: KeptLook) -> None:
        """Give the newest look the number of its pass and the time at its end."""
        look.number = self.passes
        look.seconds = self.limits.elapsed()
        self.newest = look
        self.passes += 1
        if self.tracker is not None:
            self.tracker.see(seen_by(look, self.source.lattice, self.task.goal.sought))

    def follow(self, camera: CameraStep) -> None:
        """Move the places of closer looks with the camera, or set them aside if the frame matches no earlier one."""
        if self.decisions.candidate is not None and self.step is not None:
            self.step.choose_anew()  # a closer look is due in this frame, and the choice is for one after it
        carry = partial(carry_along, lattice=self.source.lattice)
        self._closer_looks = self._lost_looks.follow(self._closer_looks, camera, carry)
        self.decisions.follow(camera, self.kept_looks)

    @property
    def next_window(self) -> Window:
        """The window of the next look, known after the first look."""
        candidate = self.decisions.candidate
        if candidate is not None:
            return closer_window(self.source.lattice, candidate.box, self._close_window)
        assert self.step is not None
        return self.step.choices[0][0]

    @property
    def belief(self) -> ZoomBelief | None:
        """The belief after the last look; None before the first look, and without fitted models."""
        return None if self.step is None else self.step.belief

    @property
    def kept_looks(self) -> list[KeptLook]:
        """The looks that have not been forgotten and show part of the present frame, in temporal order."""
        in_view = [look for look in (*self._chosen_looks, *self._closer_looks) if look.in_view]
        return sorted(in_view, key=lambda look: look.number)

    @property
    def _chosen_looks(self) -> Sequence[KeptLook]:
        """The looks that count but closer ones."""
        return () if self.step is None else self.step.kept_looks

    def record_fields(self, looks: Sequence[LookAtWindow]) -> Values:
        """Collect the fields that the records of a picture and of a frame have in common.

        Args:
            looks: the looks that count, in the order of `kept_looks`.
        """
        task = self.task
        places: dict[int | None, int] = {look.number: place for place, look in enumerate(self.kept_looks)}
        merged = self._merged(looks)
        return {
            "lattice": self.source.lattice,
            "classes": task.goal.classes,
            "target": task.goal.target,
            "prior": task.decisions.given_share,
            "assumed": self.decisions.prior.assumed,
            "targets": task.goal.targets,
            "looks": tuple(looks),
            "candidates": merged.objects if self.tracker is None else self._tracked(self.tracker.tracks, places),
            "unseen": merged.unseen,
            "spread": SPREAD if self._certainty is None else self._certainty.spread,
            "score_threshold": self._score_threshold,
            "detector": task.detector,
            "closer": _renumbered(self.decisions.looks, places),
        }

    def _tracked(self, tracks: Tracks, places: Mapping[int | None, int]) -> Callable[[], Objects]:
        """Make what lists the tracked objects in the frame, each with the place of its look in the record."""
        return partial(_objects_in_frame, tracks, places, self.source.lattice.size)

    @property
    def tracks(self) -> Tracks:
        """The tracked objects; empty in a still picture, and without fitted models."""
        return Tracks.none() if self.tracker is None else self.tracker.tracks

    @property
    def _score_threshold(self) -> float:
        """Probability, or score, from which on objects count."""
        if self.task.score_threshold is not None:
            return self.task.score_threshold
        return self.task.usual_score if self._certainty is None else LIKELY

    def _merged(self, looks: Sequence[LookAtWindow]) -> MergedLooks:
        """Make what merges the objects of looks when they are asked for; what changes is computed now."""
        goal = self.task.goal
        return MergedLooks(
            looks=tuple(look.shown for look in looks),
            lattice=self.source.lattice,
            sought=goal.sought,
            certainty=self._certainty,
            remaining=self._remaining(),
            promised=self._promised(),
            fades=not self._stands_still,
            in_frame=self.follows,
        )

    def _remaining(self) -> tuple[float, float]:
        """Ask the belief what further looks find; nothing in a search, and for several classes."""
        # A belief about objects of any class says nothing about those of several.
        if self.task.goal.searches or self.task.goal.targets or self.belief is None:
            return 0.0, 0.0
        return self.belief.remaining()

    def _promised(self) -> float:
        """Sum the values that looks after the overview were chosen for."""
        return sum(look.value for look in self._chosen_looks[1:] if isfinite(look.value))


class _WindowsOfPicture(PictureEpisode[ZoomPath]):
    """Base of looks at windows of a picture, which keeps them as the record has them.

    Args:
        session: looks at the windows.
        limits: where the episode ends, unless it decides before.
    """

    def __init__(self, session: WindowSession, limits: EpisodeLimits) -> None:
        super().__init__(session.task.goal, limits)
        self.source = session.source
        self.session = session
        self._looks: list[LookAtWindow] = []

    @property
    def looks(self) -> tuple[LookAtWindow, ...]:
        return tuple(self._looks)

    def _record_look(self, look: KeptLook) -> LookAtWindow:
        """Keep a look as the record has it."""
        recorded = look_at_window(look.original, self.source.lattice, look.number, look.seconds, look.value)
        self._looks.append(recorded)
        return recorded


class WindowEpisode(_WindowsOfPicture):
    """Looks at windows of a picture.

    A search decides by closer looks (`semfov.decision.PlaceVerifier`), or without them by the probability of the
    picture and a detection that shows the target (`semfov.decision.settle`). Without evidence slices are looked at in
    the order of the overview's scores, and nothing is `absent`.

    Args:
        task: what is looked for.
        source: looks at the picture.
        limits: where the episode ends, unless it decides before.
    """

    def __init__(self, task: WindowTask, source: WindowLooks, limits: EpisodeLimits | None = None) -> None:
        limits = limits or EpisodeLimits()
        super().__init__(WindowSession(task, source, limits), limits)
        # The choice after the overview asks for the first, and the record at the end for the second.
        source.meanwhile = lambda: (source.blank(), self._photograph)
        self._final_decision: Decision | None = None

    @property
    def criterion(self) -> str | None:
        return self.session.decisions.criterion

    @property
    def decision(self) -> Decision | None:
        return self.session.decisions.decision if self._final_decision is None else self._final_decision

    @torch.inference_mode()
    def look(self) -> LookAtWindow | None:
        """Look at the next window, or take a closer look at a place that seems to hold the target."""
        look = self.session.look()
        if look is None:
            return None
        decisions = self.session.decisions
        if decisions.outcome and decisions.candidate is None:
            self.ending = decisions.ending
        return self._record_look(look)

    def _end(self, limit: Ending | None) -> None:
        decisions = self.session.decisions
        self._final_decision = decisions.decision_if_ended_now()
        is_found = self._final_decision is not None and self._final_decision.outcome == "found"
        if is_found or decisions.outcome:
            self.ending = decisions.ending
        else:
            # A search and an order of slices end where no window is left, an exploration where none is worth it.
            is_sliced = self.session.task.takes_slices(self.source.lattice)
            self.ending = limit or ("windows" if self.goal.searches or is_sliced else "min_gain")

    def record(self) -> ZoomPath:
        picture = self.source.view.picture if isinstance(self.source, LiveWindowLooks) else None
        path = None if picture is None else picture.path
        return ZoomPath(
            **self.session.record_fields(self._looks),
            decision=self.decision,
            photograph=self._photograph,
            source=None if path is None else str(path),
            shown=None if picture is None else picture.shown,
            ending=self.ending,
        )

    @cached_property
    def _photograph(self) -> Tensor | None:
        """A reduced copy of the picture; None for stored looks."""
        return reduced_copy(self.source.view.picture) if isinstance(self.source, LiveWindowLooks) else None


class GivenWindows(_WindowsOfPicture):
    """Looks at a given list of windows, which begins with the whole picture; there is no decision.

    Args:
        goal: what is looked for.
        evidence: evidence for the belief; None for no belief.
        source: looks at the picture.
    """

    def __init__(self, goal: Goal, evidence: GlimpseEvidence | None, source: WindowLooks) -> None:
        self._next = Window.overview(source.lattice)
        belief = None if evidence is None else ZoomBelief(source.lattice, evidence, goal.target or 0)
        steps = look_by_look(source, lambda looks, windows: [(self._next, 0.0)], belief)
        limits = EpisodeLimits()
        task = WindowTask(replace(goal, searches=False), evidence)
        super().__init__(WindowSession(task, source, limits, steps=steps), limits)

    @property
    def criterion(self) -> str | None:
        return None

    @property
    def decision(self) -> Decision | None:
        return None

    @torch.inference_mode()
    def look(self, window: Window | None = None) -> LookAtWindow:
        """Look at a window; None stands for the whole picture, and later for the window of the last look."""
        self._next = window or self._next
        look = self.session.look()
        assert look is not None
        return self._record_look(look)

    def _end(self, limit: Ending | None) -> None:
        self.ending = limit

    def record(self) -> ZoomPath:
        return ZoomPath(**self.session.record_fields(self._looks), ending=self.ending)


class WindowStream(StreamEpisode[WindowMoment]):
    r"""Looks at windows of the frames of a stream, one or more windows in each frame.

    A look counts for :math:`\ln 2 / r` seconds, with the rate r, or until the next look at the same window
    (`semfov.zoom.episode.look_by_look`), and what a later look has shown as closely replaces what earlier ones did.
    If the camera moves, earlier looks and their detections move with the scene. With rate 0, frames of a still picture
    give the same looks and objects as an episode of the picture, up to its end.

    Args:
        task: what is looked for.
        eye: resamples a window and detects in it.
        rate: rate at which looks are forgotten, per second.
        passes: number of looks at each frame.
        color: order of the channels of frames that are arrays or tensors.
        follows: whether the camera's motion is estimated from the frames, where no poses are given.
    """

    def __init__(
        self,
        task: WindowTask,
        eye: WindowEye,
        rate: float,
        *,
        passes: int = 1,
        color: Color = "rgb",
        follows: bool = False,
    ) -> None:
        super().__init__(task.goal, rate)
        self.passes_of_frame = passes
        self.task = task
        self.eye = eye
        self.color = color
        self._limits = EpisodeLimits()
        self._camera = StreamCamera(follows=follows)
        self._session: WindowSession | None = None  # from the first frame on
        self._frames = 0  # number of frames so far
        self._is_lost = False  # whether what was known of an earlier scene is set aside

    @property
    def looks(self) -> tuple[LookAtWindow, ...]:
        """The looks that have not been forgotten, at their places in the present frame."""
        return () if self._moment is None else self._moment.looks

    @property
    def criterion(self) -> str | None:
        """What a search needs for the decision `found`, in words, after the first frame."""
        return None if self._session is None else self._session.decisions.criterion

    def _look_at(self, frame: ImageLike | LargePicture, passed: float, pose: Motion | ArrayLike | None) -> None:
        picture = open_large(frame, color=self.color)
        # A camera writes the next frame into the same memory, and the photograph of the moment is made when it is read.
        view = self.eye.open(picture.copied() if isinstance(picture, ArrayPicture) else picture)
        self._check_size(view.picture.size)
        session = self._session
        if session is None:
            source = LiveWindowLooks(self.eye, view)
            session = self._session = WindowSession(self.task, source, self._limits, self.forgetting)
        self._follow(session, view, passed, pose)
        session.decisions.wait(passed)
        for _ in range(self.passes_of_frame):
            session.look()
            self._passes += 1
        self._frames += 1
        self._keep(self._made(session, view))

    def _follow(self, session: WindowSession, view: WindowView, passed: float, pose: Motion | ArrayLike | None) -> None:
        """Show the next frame, and carry what is known along with the camera."""
        assert isinstance(session.source, LiveWindowLooks)
        camera = self._camera.step(view, pose)
        session.follows = self._camera.is_followed
        if session.newest is not None and session.tracker is not None:
            session.tracker.follow(passed, camera, self._camera.flow)
        if camera is None or session.newest is None:
            session.source.show(view, passed)
            return
        session.source.show(view, passed, camera)
        # What was known is set aside from a frame that fits none before it, until its scene is found again or given up.
        self._is_lost = camera.recovered is None and (camera.motion is None or camera.waits)
        if not camera.is_still:
            session.follow(camera)

    def _made(self, session: WindowSession, view: WindowView) -> WindowMoment:
        """Make the record of the present frame, after its look."""
        lattice = session.source.lattice
        looks = [
            look_at_window(look.current, lattice, number, look.seconds, look.value)
            for number, look in enumerate(session.kept_looks)
        ]
        return WindowMoment(
            **session.record_fields(looks),
            decision=session.decisions.decision,
            photograph=partial(reduced_copy, view.picture),  # type: ignore[arg-type]
            number=self._frames - 1,
            lost=self._is_lost,
            tracks=session.tracks,
            next_window=session.next_window,
        )


def _objects_in_frame(tracks: Tracks, places: Mapping[int | None, int], size: tuple[int, int]) -> Objects:
    """List the tracked objects in a frame, each with the place of its look in the record; -1 for none there."""
    objects = tracks.objects()
    passes = torch.tensor([places.get(number, -1) for number in objects.passes.tolist()], dtype=torch.long)
    return replace(objects, passes=passes)[inside_frame(objects.boxes, size)]


def _renumbered(closer: Sequence[CloseUp], places: Mapping[int | None, int]) -> tuple[CloseUp, ...]:
    """Give the closer looks that count the places of their looks in the record as indices."""
    return tuple(replace(look, index=places[look.index]) for look in closer if look.index in places)
