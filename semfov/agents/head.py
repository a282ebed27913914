"""An agent that moves its eye and turns its head."""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.agents.episode import EpisodeLimits, Goal, PictureEpisode, on_cpu
from semfov.belief.observers import SemanticMap, SemanticSearch
from semfov.data.classes import class_index, class_numbers
from semfov.data.inputs import Color
from semfov.decision import OUTCOMES, Decision, check_thresholds, most_evident_box, place_known, settle
from semfov.detection.load import load_detector
from semfov.errors import InputError, check_number, check_whole
from semfov.eye import Eye
from semfov.head.belief import SceneObserver
from semfov.head.camera import SceneLike, open_scene
from semfov.head.closer import CloserLookOffers
from semfov.head.episode import HeadStep, live, look_around
from semfov.head.gain import FORESIGHT, UNSEEN_CHANCE, ExploreGain, LookGain, PerSecond, SearchGain
from semfov.head.views import Views
from semfov.io.compatibility import searching_for, trained_for
from semfov.io.pretrained import shipped_model
from semfov.kinds import HEAD
from semfov.observation.foveal import FovealObservationModel
from semfov.observation.thresholds import Thresholds
from semfov.paths import Ending, HeadPath
from semfov.paths.head import HeadLook, head_look
from semfov.paths.stimulus import reduced_copy
from semfov.sensor.foveation import Foveation
from semfov.settings import MOST_PASSES, ExploreSettings, FindSettings, SearchSettings, StartSettings, value_or

_SIGMA = 100.0  # width of the fovea that the shipped models were fitted with, in pixels of a view of 640 pixels
_PASSES = 40  # default of the largest number of looks
_DURATION = 30.0  # default time limit of a scene in seconds
_CONFIRM = 0.65  # probability of the target in the fixated cell at which a search ends as found


class HeadAgent(nn.Module):
    """Agent for scenes larger than the eye's field of view, which turns its head when that is worth the time.

    A scene is a `semfov.Panorama`, a `semfov.Flat`, a camera of your own (`semfov.head.PanTiltCamera`), or a picture of
    any common kind, which is a panorama if it is twice as wide as high. The scene has the fields of view and the speeds
    of eye and head. The belief is about directions, so that it survives turns of the head.

    Args:
        eye: sensor and detector.
        search: observation model fitted for searches.
        explore: observation model for a map.

    Attributes:
        classes: names of the classes, background first.

    Example::

        agent = HeadAgent.recommended("yolox-nano")
        path = agent.search("street.jpg", "bicycle")
        print(path, path.gaze(-1))
    """

    def __init__(self, eye: Eye, search: FovealObservationModel, explore: FovealObservationModel) -> None:
        super().__init__()
        self.eye, self.classes = eye, ("background", *eye.detector.classes)
        self.searching = search
        self.observation = explore

    @classmethod
    def recommended(cls, name: str = "yolox-nano", **options: Any) -> Self:
        """Make the agent with the models that are shipped for a detector, as `ActivePerception.recommended` does.

        Args:
            name: `yolox-nano`, `yolov3-tiny`, or `nanodet-plus-m-1.5x` with `weights=`.
            options: options of `semfov.load_detector`.

        Returns:
            The agent in evaluation mode, without gradients for its weights.

        Raises:
            InputError: no models are shipped for a detector of this name.
            DataError: the weights cannot be obtained, or are damaged.
        """
        eye = Eye(Foveation(_SIGMA, growth=2.0), load_detector(name, **options))
        fitted = shipped_model(FovealObservationModel, searching_for(eye.detector.name), eye.detector.name, name)
        search = FovealObservationModel.from_pretrained(fitted)
        explore = FovealObservationModel.from_pretrained(trained_for(eye.detector.name, growth=2))
        search.check_compatible(eye.settings())
        explore.check_compatible(eye.settings())
        return cls(eye, search, explore).eval().requires_grad_(False)

    def views(self, scene: SceneLike, color: Color = "rgb") -> Views:
        """Make the list of all views and fixations that are possible in a scene.

        Args:
            scene: the scene (`semfov.head.open_scene`).
            color: order of the channels of an array, a tensor, or the frames of a camera (`semfov.as_image`).

        Returns:
            Views with the scene's fields of view and the agent's fovea.
        """
        return Views(open_scene(scene, color), fovea=_SIGMA / self.eye.reference)

    def search(
        self,
        scene: SceneLike,
        target: str | int,
        settings: SearchSettings | None = None,
        *,
        foresight: float = FORESIGHT,
        chance: float = UNSEEN_CHANCE,
        color: Color = "rgb",
    ) -> HeadPath:
        """Search a scene for a class, by the expected gain per second (`SearchGain`, `PerSecond`).

        The target is found when the gaze is on a cell that holds it with a probability of at least `confirm` (None:
        0.65). It is absent if every cell that the views show was fixated, or is less probable than `stop_below` (None:
        than a cell that was never seen), and no cell holds it with a probability of one half. Both end the search. A
        search that a limit ends is undecided (`semfov.decision.settle`).

        Args:
            scene: the scene: a `semfov.Panorama`, a `semfov.Flat`, a camera, or a picture (`semfov.head.open_scene`).
            target: name or index (1..K) of the class.
            settings: the settings of the search; None for the usual ones. A look that would end after `duration`, as
                the `speeds` of the scene have it, is not taken.
            foresight: weight of the gain in sharpness over the cells of a view (`SearchGain`).
            chance: probability that a cell that was never seen holds the target, by the prior of the fit.
            color: order of the channels of an array, a tensor, or the frames of a camera (`semfov.as_image`).

        Returns:
            The record of the search, with its decision.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or a setting is not for a head.
            DataError: a file cannot be read, or the camera gives no frame from the right direction.
        """
        settings = SearchSettings() if settings is None else settings
        settings.check_suitable(HEAD)
        index = class_index(target, self.classes[1:], "target")
        check_thresholds(settings.confirm, settings.stop_below)
        check_number(foresight, "foresight", 0, 1e6)
        limits = EpisodeLimits.of(settings, _PASSES)
        views = self.views(scene, color)
        model = on_cpu(self.searching)  # where the geometry of the scene is
        # Views are resampled to the cells of the scene, in which a single cell would be blurred.
        inner = SemanticSearch(model, footprint="overlap").with_prior(settings.prior, index)
        never_seen = inner.prior(chance)
        gain = SearchGain(views, foresight)
        observer = SceneObserver(inner, views, unseen_chance=never_seen)
        confirm = value_or(settings.confirm, _CONFIRM)
        thresholds = Thresholds(confirm, value_or(settings.stop_below, never_seen), place=confirm)
        return HeadEpisode(
            self, observer, gain, index,
            thresholds=thresholds, limits=limits, start=_first_action(settings),
            duration=value_or(settings.duration, _DURATION),
            seed=settings.seed, prior=settings.given_share, assumed=inner.prior.assumed,
        ).run()  # fmt: skip

    def find_all(
        self,
        scene: SceneLike,
        target: str | int | Sequence[str | int] | None = None,
        settings: FindSettings | None = None,
        *,
        color: Color = "rgb",
    ) -> HeadPath:
        """Find all objects of one class, of several, or of every class: an exploration that records these objects.

        Args:
            scene: the scene: a `semfov.Panorama`, a `semfov.Flat`, a camera, or a picture (`semfov.head.open_scene`).
            target: name or index (1..K) of the class, or several of them; None for all classes.
            settings: the settings of the task; None for the usual ones.
            color: order of the channels of an array, a tensor, or the frames of a camera (`semfov.as_image`).

        Returns:
            The record, with the objects.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or a setting is not for a head.
            DataError: a file cannot be read, or the camera gives no frame from the right direction.
        """
        indices = class_numbers(target, self.classes[1:], "target")
        return self._look_around(scene, indices, FindSettings() if settings is None else settings, color)

    def explore(self, scene: SceneLike, settings: ExploreSettings | None = None, *, color: Color = "rgb") -> HeadPath:
        """Explore a scene, by the expected number of additional correct cells per second (`ExploreGain`, `PerSecond`).

        Args:
            scene: the scene: a `semfov.Panorama`, a `semfov.Flat`, a camera, or a picture (`semfov.head.open_scene`).
            settings: the settings of the exploration; None for the usual ones.
            color: order of the channels of an array, a tensor, or the frames of a camera (`semfov.as_image`).

        Returns:
            The record of the exploration.

        Raises:
            InputError: a setting is not for a head.
            DataError: a file cannot be read, or the camera gives no frame from the right direction.
        """
        settings = ExploreSettings() if settings is None else settings
        return self._look_around(scene, (), settings, color, _first_action(settings), settings.seed)

    def _look_around(
        self,
        scene: SceneLike,
        targets: tuple[int, ...],
        settings: FindSettings | ExploreSettings,
        color: Color,
        start: int | None = None,
        seed: int = 0,
    ) -> HeadPath:
        """Look for all objects of classes 1..K, or of all classes, by the expected gain of the map."""
        settings.check_suitable(HEAD)
        limits = EpisodeLimits.of(settings, _PASSES)
        views = self.views(scene, color)
        path = HeadEpisode(
            self,
            SceneObserver(SemanticMap(on_cpu(self.observation)), views),
            ExploreGain(views),
            None,
            targets,
            min_gain=value_or(settings.min_gain, 0.0),
            limits=limits,
            start=start,
            duration=value_or(settings.duration, _DURATION),
            seed=seed,
        ).run()
        return path if settings.score_threshold is None else replace(path, score_threshold=settings.score_threshold)


def _first_action(settings: StartSettings) -> int | None:
    """Take the first action of a head, which has no columns and rows."""
    start = settings.start
    if isinstance(start, tuple):
        raise InputError(f"start: expected the number of an action for a head (semfov.head.views.Views), got {start}")
    return start


class HeadEpisode(PictureEpisode[HeadPath]):
    """Episode of a head that turns: each look is at the fixation with the largest expected gain per second.

    Args:
        agent: the agent.
        observer: the belief about the scene.
        gain: expected gain of a look.
        target: class 1..K to search for; None finds all objects.
        targets: classes 1..K whose objects are all to be found; none: of all classes.
        min_gain: least expected gain for which a look is worth it.
        thresholds: thresholds of the decision of a search; None decides nothing.
        limits: where the episode ends, unless it decides before.
        start: first action (`Views`); None looks straight ahead.
        duration: time limit of the scene in seconds.
        seed: of the generator that breaks ties.
        prior: how often the target is there, as it was given for the observer; None for none.
        assumed: how often the observer assumes that it is there; None if it is not known.
    """

    def __init__(
        self,
        agent: HeadAgent,
        observer: SceneObserver,
        gain: LookGain,
        target: int | None,
        targets: tuple[int, ...] = (),
        *,
        min_gain: float = 0.0,
        thresholds: Thresholds | None = None,
        limits: EpisodeLimits | None = None,
        start: int | None = None,
        duration: float = _DURATION,
        seed: int = 0,
        prior: float | None = None,
        assumed: float | None = None,
    ) -> None:
        super().__init__(Goal.of(agent.classes, target, targets), limits)
        check_number(duration, "duration", 0, float("inf"))
        check_whole(seed, "seed", 0, 2**63 - 1)
        views = observer.views
        speeds = views.world.speeds
        zooms = len(views.fields) > 1
        first = value_or(start, views.ahead)
        check_whole(first, "start", 0, len(views.grid) - 1)
        self.views = views
        self.thresholds = thresholds
        self.duration = duration
        self.score_threshold = agent.eye.detector.score_threshold
        self._detector = agent.eye.detector.name
        self._prior = prior
        self._assumed = assumed
        self._steps = look_around(
            views,
            live(agent.eye, views),
            observer,
            lambda action: PerSecond(gain, speeds, action),
            first,
            target=self.goal.target,
            closer=CloserLookOffers(gain, speeds, self.goal.target) if zooms else None,
            passes=MOST_PASSES,
            duration=duration,
            min_gain=min_gain,
            seed=seed,
        )
        self._last: HeadStep | None = None
        self._looks: list[HeadLook] = []
        self._maps: list[Tensor] = []  # the map of the scene after each look, `(S,)`
        self._decision: Decision | None = None

    @property
    def looks(self) -> tuple[HeadLook, ...]:
        return tuple(self._looks)

    @property
    def decision(self) -> Decision | None:
        return self._decision

    @property
    def criterion(self) -> str | None:
        if self.thresholds is None:
            return None
        return f"p is {self.thresholds.confirm:g} and the gaze is at the place"

    @torch.inference_mode()
    def look(self) -> HeadLook | None:
        """Turn the eye, or eye and head, and look."""
        step = next(self._steps, None)
        if step is None:
            return None
        self._last = step
        target = self.goal.target
        map_after = _scene_map(step, target)
        self._maps.append(map_after)
        if self.thresholds is not None and target is not None:
            self._decision = _decide_look(self.views, step, target, self.thresholds)
            self.ending = "decision" if self._decision.outcome != "undecided" else None
        number = len(self._looks)
        look = head_look(self.views, step.action, step.detections, map_after, number, step.seconds, step.gain)
        self._looks.append(look)
        return look

    def _end(self, limit: Ending | None) -> None:
        step = self._last
        assert step is not None
        if self.ending is None:
            self.ending = limit or self._usual_ending(step)

    def _usual_ending(self, step: HeadStep) -> Ending:
        """Find why no look is left after a step, which neither a decision nor a limit ended."""
        if len(self._looks) == len(self.views.grid):
            return "cells"
        return "duration" if step.seconds + step.ahead > self.duration else "min_gain"

    def record(self) -> HeadPath:
        decision = self.decision
        picture = self.views.world.image()
        return HeadPath(
            views=self.views,
            target=self.goal.target,
            classes=self.goal.classes,
            score_threshold=self.score_threshold,
            looks=self.looks,
            maps=torch.stack(self._maps) if self._maps else torch.zeros(0, len(self.views.world.scene)),
            found=decision is not None and decision.outcome == "found",
            decision=decision,
            ending=self.ending,
            prior=self._prior,
            assumed=self._assumed,
            targets=self.goal.targets,
            photograph=None if picture is None else reduced_copy(picture),
            detector=self._detector,
            duration=self.duration if math.isfinite(self.duration) else None,
        )


def _scene_map(step: HeadStep, target: int | None) -> Tensor:
    """Probability `(S,)` of the target, or of any object where the cell was seen, in each cell of the scene."""
    belief = step.belief
    if target is not None:
        return belief.probability(target)[0]
    return (1 - belief.class_probabilities()[0, :, 0]).masked_fill(belief.owner[0] < 0, 0.0)


def _decide_look(views: Views, step: HeadStep, target: int, thresholds: Thresholds) -> Decision:
    """Decide after a look, by the rule of all searches (`semfov.decision.settle`); only the present gaze can find.

    Args:
        views: the views and fixations that are possible.
        step: the look, and the belief after it.
        target: class 1..K.
        thresholds: thresholds of the search.

    Returns:
        The decision; its cell and its box are those of the scene.
    """
    belief = step.belief
    pose, cell_of_view = divmod(step.action, views.cells)
    cell = views.gaze_cell[step.action]
    probability = belief.probability(target)
    at_gaze = probability.double()[:, cell, None]
    is_detected = torch.ones(1, 1, dtype=torch.bool)
    located = place_known(at_gaze, is_detected, thresholds.place)
    # The chance of a view assumes that the target is in it, which is one of many. It keeps the precision of the belief,
    # in which a cell that was never seen has exactly the threshold.
    best_unseen = probability.masked_fill(belief.examined | ~views.reachable, 0).amax(-1)
    outcome = int(settle(belief.presence(target).double(), located, best_unseen, thresholds))
    presence = float(belief.presence(target))
    if OUTCOMES[outcome] != "found":
        return Decision(OUTCOMES[outcome], presence, confirm=thresholds.confirm)
    in_view = most_evident_box([step.detections], views.view_grid, target, cell_of_view)
    box = None if in_view is None else views.world.boxes(in_view[None], views.poses[pose])[0]
    return Decision("found", presence, int(cell), box, float(at_gaze[0, 0]), thresholds.confirm)
