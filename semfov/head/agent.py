"""An agent that moves its eye and turns its head."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import LearnedMap, Target
from semfov.belief.target_evidence import TargetEvidence
from semfov.data.classes import class_index
from semfov.detection.detections import Detections
from semfov.detection.load import load_detector
from semfov.errors import check_number, check_whole
from semfov.eye import Eye
from semfov.gaze.acquisition.base import AcquisitionFunction
from semfov.head.belief import SceneObserver
from semfov.head.episode import live, look_around
from semfov.head.gain import FORESIGHT, PRIOR, ExploreGain, PerPrice, SearchGain
from semfov.head.speeds import Speeds
from semfov.head.views import Views
from semfov.head.world import Places, World
from semfov.io.compatibility import learned_for
from semfov.io.shipped import shipped_model
from semfov.sensor.foveation import Foveation

SIGMA = 100.0
"""Width of the fovea that the shipped evidence was learned with, in pixels of a view of 640 pixels."""

CONFIRM = 0.7
"""Probability of the target in the fixated cell at which a search ends as found."""


@dataclass(frozen=True)
class HeadPath:
    """The record of an episode: where eye and head looked, what was seen and what was believed.

    Attributes:
        views: the views and fixations that were possible.
        target: class that was searched for; None for an exploration.
        classes: names of the classes, background first.
        actions: number of the pose and cell of each look (`Views`).
        seconds: time at the end of each look.
        detections: detections of each look, a batch of one, with boxes in pixels of its view.
        maps: `(N, S)`, after each look, the probability that a cell of the scene holds the target, or any object in an
            exploration.
        found: whether the last look found the target.

    Example::

        path = agent.search(Panorama("street.jpg"), "bicycle")
        print(path.turns, path.seconds[-1])  # turns of the head, and the time taken
        regions, labels, scores = path.places(-1)  # objects of the last look
    """

    views: Views
    target: int | None
    classes: tuple[str, ...]
    actions: tuple[int, ...]
    seconds: tuple[float, ...]
    detections: tuple[Detections, ...]
    maps: Tensor
    found: bool

    def __len__(self) -> int:
        """Number of looks."""
        return len(self.actions)

    @property
    def turns(self) -> int:
        """Number of times that the head moved."""
        poses = [action // self.views.cells for action in self.actions]
        return sum(one != other for one, other in pairwise(poses))

    def pose(self, look: int) -> Tensor:
        """Pose of the head in a look.

        Args:
            look: number of the look; negative numbers count from the end.

        Returns:
            `(3,)`, as `World` defines it: the position of the window, and its field of view in degrees.
        """
        return self.views.poses[self.actions[look] // self.views.cells]

    def gaze(self, look: int) -> Tensor:
        """Point of the scene that the eye fixated in a look.

        Args:
            look: number of the look; negative numbers count from the end.

        Returns:
            `(D,)`, a unit direction in a panorama, or pixels of a flat scene.
        """
        return self.views.gaze[self.actions[look]]

    def places(self, look: int, score: float = 0.1) -> tuple[Places, Tensor, Tensor]:
        """Objects detected in a look, in coordinates of the scene.

        Args:
            look: number of the look; negative numbers count from the end.
            score: least score of an object. For a search, only objects of the target class are returned.

        Returns:
            The regions that the objects cover, their classes `(M,)` and their scores `(M,)`.
        """
        seen = self.detections[look]
        best, label = seen.scores[0, :, 1:].max(-1)
        label = label + 1
        kept = seen.mask[0] & (best >= score)
        if self.target is not None:
            kept &= label == self.target
        return self.views.world.places(seen.boxes[0, kept], self.pose(look)), label[kept], best[kept]

    def __repr__(self) -> str:
        """One line on the outcome of the episode."""
        what = "exploration" if self.target is None else self.classes[self.target]
        found = "" if self.target is None else (", found" if self.found else ", not found")
        return f"HeadPath: {what}{found}, {len(self)} looks, {self.turns} turns of the head, {self.seconds[-1]:.1f} s"


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

        The target is found when the gaze is on a cell that holds it with a probability of at least `confirm`.

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
        return self._look(views, observer, acquire, index, start, passes, seconds, confirm, seed)

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
        return self._look(views, observer, acquire, None, start, passes, seconds, 1.0, seed)

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
        confirm: float,
        seed: int,
    ) -> HeadPath:
        check_whole(passes, "passes", 1, 1_000_000)
        check_number(seconds, "seconds", 0, float("inf"))
        check_whole(seed, "seed", 0, 2**63 - 1)
        middle = views.tiling[0][len(views.tiling[0]) // 2]
        first = middle[len(middle) // 2] * views.cells + views.cells // 2 + 5 if start is None else start
        check_whole(first, "start", 0, len(views.grid) - 1)
        actions, times, seen, maps, found = list[int](), list[float](), list[Detections](), list[Tensor](), False
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
            found = target is not None and float(told[views.gaze_cell[step.action]]) >= confirm
            if found:
                break
        return HeadPath(
            views, target, self.classes, tuple(actions), tuple(times), tuple(seen), torch.stack(maps), found
        )
