"""An agent that moves its eye and turns its head."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import LearnedMap, Target
from semfov.belief.target_evidence import TargetEvidence, Thresholds
from semfov.data.classes import class_index
from semfov.decision import Decision, conclude, place_known, settle
from semfov.detection.detections import Detections
from semfov.detection.load import load_detector
from semfov.errors import check_number, check_whole
from semfov.eye import Eye
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneObserver
from semfov.head.episode import HeadStep, live, look_around
from semfov.head.gain import FORESIGHT, PRIOR, ExploreGain, PerPrice, SearchGain
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.head.world import World
from semfov.io.compatibility import learned_for
from semfov.io.shipped import shipped_model
from semfov.paths import Ending, HeadPath
from semfov.sensor.foveation import Foveation

SIGMA = 100.0
"""Width of the fovea that the shipped evidence was learned with, in pixels of a view of 640 pixels."""

CONFIRM = 0.7
"""Probability of the target in the fixated cell at which a search ends as found."""


class HeadAgent(nn.Module):
    """An agent that looks around in a scene larger than its eye's field of view, and turns its head where that pays.

    Args:
        eye: sensor and detector.
        search: evidence model for a target.
        explore: evidence model for a map.
        speeds: of eye and head.
        fields: fields of view in degrees, narrowest first.

    Example::

        agent = HeadAgent.recommended("yolox-nano")
        path = agent.search(Panorama("street.jpg"), "bicycle")
        print(path, path.gaze(-1))
    """

    def __init__(
        self,
        eye: Eye,
        search: TargetEvidence,
        explore: MapEvidence,
        *,
        speeds: Speeds | None = None,
        fields: Sequence[float] = (60.0,),
    ) -> None:
        super().__init__()
        self.eye = eye
        self.target_evidence, self.map_evidence = search, explore
        self.speeds = Speeds() if speeds is None else speeds
        self.fields = tuple(fields)

    @classmethod
    def recommended(
        cls,
        name: str = "yolov3-tiny",
        *,
        speeds: Speeds | None = None,
        fields: Sequence[float] = (60.0,),
        **options: Any,
    ) -> Self:
        """Make the agent with the models that are shipped for a detector, as `ActivePerception.recommended` does.

        Args:
            name: `yolov3-tiny` or `yolox-nano`.
            speeds: of eye and head.
            fields: fields of view in degrees, narrowest first.
            options: options of `semfov.load_detector`.

        Returns:
            The agent in evaluation mode, without gradients for its weights.

        Raises:
            InputError: no models are shipped for a detector of this name.
            DataError: the weights cannot be obtained, or are damaged.
        """
        eye = Eye(Foveation(SIGMA, growth=2.0), load_detector(name, **options))
        shipped = shipped_model(TargetEvidence, learned_for(eye.detector.name, 2.0), name)
        models = TargetEvidence.from_pretrained(shipped), MapEvidence.from_pretrained(shipped)
        for model in models:
            model.check_compatible(eye.settings())
        return cls(eye, *models, speeds=speeds, fields=fields).eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first."""
        return ("background", *self.eye.detector.classes)

    def views(self, world: World) -> Views:
        """The views and fixations that are possible in a scene.

        Args:
            world: the scene.

        Returns:
            Views with the agent's fields of view and fovea.
        """
        return Views(world, self.fields, fovea=SIGMA / self.eye.reference)

    def search(
        self,
        world: World,
        target: str | int,
        *,
        start: int | None = None,
        passes: int = 40,
        seconds: float = 30.0,
        confirm: float = CONFIRM,
        foresight: float = FORESIGHT,
        prior: float = PRIOR,
        seed: int = 0,
    ) -> HeadPath:
        """Search a scene for a class, by the expected gain per second (`SearchGain`, `PerPrice`).

        The target is found when the gaze is on a cell that holds it with a probability of at least `confirm`. A search
        that ends without it decides that the target is absent if every cell that can be seen was fixated, or is less
        probable than one that was never seen, and no cell holds the target with a probability of one half.
        Otherwise it is undecided (`semfov.decision.settle`).

        Args:
            world: the scene, a `semfov.head.Panorama` or `Flat`.
            target: name or index (1..K) of the class.
            start: first action (`Views`); None looks straight ahead, at the middle of the middle view.
            passes: largest number of looks.
            seconds: time limit in seconds; a look that would end later is not taken.
            confirm: probability at which the search ends as found.
            foresight: weight of the gain in sharpness over the cells of a view (`SearchGain`).
            prior: probability that a cell that was never seen holds the target.
            seed: of the generator that breaks ties.

        Returns:
            The record of the search.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument is out of range.
        """
        index = class_index(target, self.classes[1:], "target")
        check_number(confirm, "confirm", 0, 1)
        check_number(foresight, "foresight", 0, 1e6)
        views = self.views(world)
        gain = SearchGain(views, foresight)
        observer = SceneObserver(Target(self.target_evidence), views, prior=prior)
        acquire: Callable[[int], AcquisitionFunction] = lambda action: PerPrice(gain, self.speeds, action)  # noqa: E731
        thresholds = Thresholds(confirm, prior, confirm)
        return self._look(views, observer, acquire, index, start, passes, seconds, thresholds, seed)

    def explore(
        self, world: World, *, start: int | None = None, passes: int = 40, seconds: float = 30.0, seed: int = 0
    ) -> HeadPath:
        """Explore a scene, by the expected number of additional correct cells per second (`ExploreGain`, `PerPrice`).

        Args:
            world: the scene, a `semfov.head.Panorama` or `Flat`.
            start: first action (`Views`); None looks straight ahead, at the middle of the middle view.
            passes: largest number of looks.
            seconds: time limit in seconds; a look that would end later is not taken.
            seed: of the generator that breaks ties.

        Returns:
            The record of the exploration.

        Raises:
            InputError: an argument is out of range.
        """
        views = self.views(world)
        gain, observer = ExploreGain(views, self.map_evidence), SceneObserver(LearnedMap(self.map_evidence), views)
        acquire: Callable[[int], AcquisitionFunction] = lambda action: PerPrice(gain, self.speeds, action)  # noqa: E731
        return self._look(views, observer, acquire, None, start, passes, seconds, None, seed)

    @torch.inference_mode()
    def _look(
        self,
        views: Views,
        observer: SceneObserver,
        acquire: Callable[[int], AcquisitionFunction],
        target: int | None,
        start: int | None,
        passes: int,
        seconds: float,
        thresholds: Thresholds | None,
        seed: int,
    ) -> HeadPath:
        check_whole(passes, "passes", 1, 1_000_000)
        check_number(seconds, "seconds", 0, float("inf"))
        check_whole(seed, "seed", 0, 2**63 - 1)
        middle = views.tiling[0][len(views.tiling[0]) // 2]
        first = middle[len(middle) // 2] * views.cells + views.cells // 2 + 5 if start is None else start
        check_whole(first, "start", 0, len(views.grid) - 1)
        actions, times, seen, maps = list[int](), list[float](), list[Detections](), list[Tensor]()
        decision, found = None, False
        for step in look_around(
            views, live(self.eye, views), observer, acquire, first,
            target=target, speeds=self.speeds, passes=passes, seconds=seconds, seed=seed,
        ):  # fmt: skip
            belief = step.belief
            told = 1 - belief.class_probabilities()[0, :, 0] if target is None else belief.probability(target)[0]
            unseen = belief.owner[0] < 0
            maps.append(told.masked_fill(unseen, 0.0) if target is None else told)
            actions.append(step.action)
            times.append(step.seconds)
            seen.append(step.detections)
            if target is not None and thresholds is not None:
                decision = decide_look(views, step, target, thresholds)
                found = decision.outcome == "found"
            if found:
                break
        ending: Ending = "decision" if found else "passes" if len(actions) == passes else "duration"
        if not found and len(actions) == len(views.grid):
            ending = "cells"
        return HeadPath(
            views=views,
            target=target,
            classes=self.classes,
            actions=tuple(actions),
            seconds=tuple(times),
            detections=tuple(seen),
            maps=torch.stack(maps),
            found=found,
            decision=decision,
            ending=ending,
        )


def decide_look(views: Views, step: HeadStep, target: int, thresholds: Thresholds) -> Decision:
    """Decide after a look, by the rule of all searches (`semfov.decision.settle`); only the present gaze can find.

    Args:
        views: the possible views and fixations.
        step: the look.
        target: class 1..K.
        thresholds: the thresholds; `give_up` is compared with the cells that can be seen and were not fixated.

    Returns:
        The decision. Its cell is one of the scene, and its box is in pixels of the view.
    """
    belief, cell = step.belief, views.gaze_cell[step.action]
    cells = belief.probability(target).double()
    looked = place_known(cells[:, cell, None], torch.ones(1, 1, dtype=torch.bool), thresholds.place)
    left = belief.chance(target).masked_fill(belief.examined | ~views.reachable, 0).amax(-1)
    outcome = int(settle(belief.presence(target).double(), looked, left, thresholds))
    decision = conclude(outcome, belief, [step.detections], views.view_grid, target, step.action % views.cells)
    return replace(decision, cell=int(cell)) if decision.outcome == "found" else decision
