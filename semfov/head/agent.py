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
"""Width of the fovea, in pixels of a view of 640, that the shipped evidence was learned with."""

CONFIRM = 0.7


@dataclass(frozen=True)
class HeadPath:
    """What eye and head did in an episode.

    Attributes:
        views: all that could be looked at.
        target: class that was searched for; None for an exploration.
        classes: names of the classes, background first.
        actions: pose and cell of each look (`Views`).
        seconds: at the end of each look.
        detections: of each look, a batch of one, boxes in pixels of its view.
        maps: `(N, S)`, after each look, the probability that a cell of the scene holds the target, or in an exploration
            any object.
        found: whether the target was found, with the last look.
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
        """How often the head moved."""
        poses = [action // self.views.cells for action in self.actions]
        return sum(one != other for one, other in pairwise(poses))

    def pose(self, look: int) -> Tensor:
        """Pose of the head in a look, `(3,)`."""
        return self.views.poses[self.actions[look] // self.views.cells]

    def gaze(self, look: int) -> Tensor:
        """Point of the scene that the eye looked at: a direction, or pixels of a flat scene, `(D,)`."""
        return self.views.gaze[self.actions[look]]

    def places(self, look: int, score: float = 0.1) -> tuple[Places, Tensor, Tensor]:
        """Objects of a look in scene coordinates, their classes and their scores.

        Args:
            look: which.
            score: objects with a lower one are left out; of a search, all others than the target are.
        """
        seen = self.detections[look]
        best, label = seen.scores[0, :, 1:].max(-1)
        label = label + 1
        kept = seen.mask[0] & (best >= score)
        if self.target is not None:
            kept &= label == self.target
        return self.views.world.places(seen.boxes[0, kept], self.pose(look)), label[kept], best[kept]

    def __repr__(self) -> str:
        """What came of it."""
        what = "exploration" if self.target is None else self.classes[self.target]
        found = "" if self.target is None else (", found" if self.found else ", not found")
        return f"HeadPath: {what}{found}, {len(self)} looks, {self.turns} turns of the head, {self.seconds[-1]:.1f} s"


class HeadAgent(nn.Module):
    """Looks around in a scene that is larger than the field of its eye, and turns its head where that pays.

    Args:
        eye: sensor and detector.
        search: evidence for a target.
        explore: evidence for a map.
        speeds: of eye and head.
        fields: of view in degrees, narrowest first.

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
        """The agent with the evidence that is shipped for a detector, that of `ActivePerception.recommended`.

        Args:
            name: `yolov3-tiny` or `yolox-nano`.
            speeds: of eye and head.
            fields: of view in degrees, narrowest first.
            options: of `semfov.load_detector`.

        Raises:
            InputError: no models are shipped for a detector of this name.
            DataError: the weights cannot be had, or are damaged.
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
        """All that can be looked at in a scene."""
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
        """Search a scene for a class, by the gain that is expected per second (`SearchGain`, `PerPrice`).

        It is found when the gaze rests on a cell that holds it with a probability of `confirm`.

        Args:
            world: `semfov.head.Panorama` or `Flat`.
            target: name or index (1..K) of the class.
            start: first action (`Views`); None looks ahead, at the middle of the first view.
            passes: looks at most.
            seconds: at most.
            confirm: probability.
            foresight: share of what a look shows from aside that counts towards a find.
            prior: probability that a cell that was never seen holds the target.
            seed: of the generator that breaks ties.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
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
        """Explore a scene, by the cells that are expected to be named right per second; arguments as for `search`."""
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
