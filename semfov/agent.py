"""The chain: look, weigh what was seen, update the belief, choose where to look next."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.belief import Belief, dirichlet_belief
from semfov.belief.context import ContextPrior
from semfov.belief.context_observer import ContextObserver
from semfov.belief.evidence import Observation
from semfov.belief.grid import Footprint, Grid
from semfov.belief.observer import Observer, SemanticObserver
from semfov.belief.target_evidence import TargetEvidence
from semfov.belief.target_observer import TargetObserver
from semfov.detection.detections import Detections
from semfov.detection.detector import Detector
from semfov.detection.load import load_detector
from semfov.errors import check, check_shape, lookup
from semfov.eye import Eye
from semfov.gaze.acquisition import AcquisitionFunction
from semfov.gaze.policies import Policy, exploration_policy, search_policy
from semfov.gaze.selection import select_fixation
from semfov.observation.compatibility import recommended
from semfov.observation.foveal import FovealObservationModel
from semfov.scanpath import Scanpath
from semfov.sensor.foveation import Foveation
from semfov.sensor.named import named_sensor

PUBLISHED_SENSORS = ("published", "published-narrow")
"""Named sensors of the paper, for which observation models of maximum likelihood are shipped."""


@dataclass(frozen=True)
class Step:
    """What one look leaves behind.

    Attributes:
        belief: the belief after the look.
        visited: `(B, X·Y)`, cells that inhibition of return keeps the gaze from.
        values: `(B, X·Y)`, acquisition values.
        cell: `(B,)`, the next cell to fixate, -1 where none is left.
    """

    belief: Belief
    visited: Tensor
    values: Tensor
    cell: Tensor


def step(
    observer: Observer,
    belief: Belief,
    visited: Tensor,
    cell: Tensor,
    evidence: Any,
    acquisition: AcquisitionFunction,
    noise: Tensor,
) -> Step:
    """One cycle of active perception for a batch of episodes; agent and evaluation both call it.

    Args:
        observer: turns looks into belief.
        belief: before the look.
        visited: `(B, X·Y)` boolean, cells fixated before.
        cell: `(B,)`, the cell that is fixated now.
        evidence: what the look from there says (`Observer.weigh`).
        acquisition: values the cells by the new belief.
        noise: `(B, X·Y)`, random numbers that break ties.
    """
    belief = observer.update(belief, evidence)
    visited = visited.scatter(-1, cell[:, None], True)
    values = acquisition(belief, visited)
    return Step(belief, visited, values, select_fixation(values, visited, noise))


class ActivePerception(nn.Module):
    """An agent with a foveal sensor that searches an image for a class, or explores it.

    Args:
        sensor: the foveal sensor; its σ is in pixels of an image whose longer side is `reference`.
        detector: turns foveated views into detections.
        observation: calibrates scores by class and distance to the fovea; None takes them raw.
        grid: `(columns, rows)` of the belief.
        policy: makes the acquisition function (`semfov.search_policy`, `semfov.exploration_policy`).
        prior: Dirichlet parameter of every class before the first look.
        fusion: `kaplan`, `product` or `sum`.
        footprint: which cells a detection updates (`Grid.footprint`).
        semantics: observer that keeps the map of all classes; None makes one of the four settings before.
        observer: observer that search goes by, where it is another one (`semfov.belief.TargetObserver`).
        exploration: policy of `explore`, where it is another one.
        reference: longer side in pixels of the image that the sensor's σ is meant for.

    Example::

        agent = ActivePerception.from_pretrained("yolov3-tiny")
        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
    """

    def __init__(
        self,
        sensor: Foveation,
        detector: Detector,
        observation: Observation | None,
        grid: tuple[int, int],
        policy: Policy,
        *,
        prior: float = 0.5,
        fusion: str = "kaplan",
        footprint: Footprint = "overlap",
        semantics: SemanticObserver | None = None,
        observer: Observer | None = None,
        exploration: Policy | None = None,
        reference: float = 640.0,
    ) -> None:
        super().__init__()
        self.eye = Eye(sensor, detector, reference=reference)
        self.observation = observation
        self.columns, self.rows = grid
        self.policy = policy
        self.exploration = exploration or policy
        self.semantics = semantics or SemanticObserver(
            len(self.classes), observation, prior=prior, fusion=fusion, footprint=footprint
        )
        self.observer: Observer = observer or self.semantics
        # Observers are no modules; what they learned moves with the agent.
        learned = dict.fromkeys([*models_of(self.semantics), *models_of(self.observer)])
        known = set(self.modules())
        self.learned = nn.ModuleList(model for model in learned if model not in known)

    @classmethod
    def from_pretrained(
        cls,
        name: str = "yolov3-tiny",
        *,
        sigma: float = 100.0,
        growth: float = 2.0,
        grid: tuple[int, int] = (10, 10),
        context: bool = False,
        **options: Any,
    ) -> Self:
        """The recommended agent: learned target evidence for search, the closer look for exploration.

        Args:
            name: a detector for which models are shipped, `yolov3-tiny` or `yolox-nano`.
            sigma: width of the fovea in pixels of an image of 640; the models are fitted for 100.
            growth: see `Foveation`; the models are fitted for 2, the observation model for 1 too.
            grid: `(columns, rows)` of the belief.
            context: whether search also goes by the usual places and company of the target (`ContextPrior`).
            options: of `semfov.load_detector`.

        Raises:
            InputError: no models are shipped for a detector of this name.
            DataError: the weights cannot be had, or are damaged.
        """
        detector = load_detector(name, **options)
        fitted = recommended(detector.name, growth)
        observation = FovealObservationModel.from_pretrained(fitted, detector=detector).requires_grad_(False)
        evidence = TargetEvidence.from_pretrained(detector.name).requires_grad_(False)
        observer: Observer = TargetObserver(evidence)
        if context:
            prior = ContextPrior.from_pretrained().requires_grad_(False)
            prior.check_compatible(detector.classes)
            observer = ContextObserver(observer, prior)
        agent = cls(
            Foveation(sigma, growth=growth),
            detector,
            observation,
            grid,
            search_policy("non-predictive"),
            semantics=SemanticObserver(len(detector.classes) + 1, tempering=0.5),
            observer=observer,
            exploration=exploration_policy("closer-look", fovea=sigma / 640),
        )
        evidence.check_compatible(agent.eye.settings())
        return agent.eval().requires_grad_(False)

    @classmethod
    def published(
        cls,
        name: str = "yolov3-tiny",
        *,
        sensor: str = "published",
        search: str = "predictive",
        calibrated: bool = True,
        **options: Any,
    ) -> Self:
        """The agent of Luzio, Bernardino and Moreno (2024), with the small detectors that models are shipped for.

        10 x 10 cells with a uniform prior of 0.5, every cell that a box overlaps updated by Kaplan's rule, scores
        calibrated by Dirichlets of maximum likelihood; exploration maximises the Kullback-Leibler divergence. The paper
        prints no width of its wide and its narrow fovea: ours are 100 and 50 pixels of 640. The detectors are smaller
        than its YOLOv3.

        Args:
            name: a detector for which models are shipped, `yolov3-tiny` or `yolox-nano`.
            sensor: `published`, the wide fovea, or `published-narrow`.
            search: `predictive` or `non-predictive`.
            calibrated: whether scores go through the observation model before they are fused ("Modified Kaplan").
            options: of `semfov.load_detector`.

        Raises:
            InputError: no models are shipped for a detector or a sensor of this name.
            DataError: the weights cannot be had, or are damaged.
        """
        lookup(sensor, PUBLISHED_SENSORS, "published sensor")
        lookup(search, ["predictive", "non-predictive"], "published search policy")
        detector = load_detector(name, **options)
        fitted = f"{detector.name}-{sensor}"
        observation = FovealObservationModel.from_pretrained(fitted, detector=detector).requires_grad_(False)
        agent = cls(
            named_sensor(sensor),
            detector,
            observation if calibrated else None,
            (10, 10),
            search_policy(search, observation),
            exploration=exploration_policy("kl", observation),
        )
        observation.check_compatible(agent.eye.settings())
        return agent.eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the belief's components, background first."""
        return ("background", *self.eye.detector.classes)

    def search(
        self,
        image: Tensor,
        target: str | int,
        *,
        start: int | None = None,
        shifts: int = 30,
        seed: int = 0,
        boxes: Tensor | None = None,
        confirm: float = 0.5,
    ) -> Scanpath:
        """Search an image for a target class.

        The search ends when the target is found, after `shifts` gaze shifts, or when no cell is left. With `boxes`
        the target is found when the gaze is on a cell that one of them overlaps (the protocol of the paper);
        without, when a detection that overlaps the fixated cell has the target as its best class with a score of
        `confirm`.

        Args:
            image: `(3, H, W)` or `(1, 3, H, W)`, RGB in [0, 1].
            target: name or index (1..K) of the class.
            start: first cell; None draws one.
            shifts: most gaze shifts to make.
            seed: of the generator that draws the start and breaks ties.
            boxes: `(M, 4)`, where the target really is.
            confirm: score at which a detection at the fixation counts as finding the target.

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
        """
        image, grid = self._frame(image)
        index = self._target(target)
        goal = None if boxes is None else grid.footprint(boxes.to(image)).any(-2)

        def ends(cell: int, detections: Detections) -> bool:
            return bool(goal[cell]) if goal is not None else confirms(detections, grid, cell, index, confirm)

        policy = self.policy(index, grid)
        return self._gaze(image, grid, self.observer, policy, index, start, shifts, seed, ends)

    def explore(self, image: Tensor, *, start: int | None = None, shifts: int = 20, seed: int = 0) -> Scanpath:
        """Explore an image: build up the belief about the whole map, with no target.

        The exploration ends after `shifts` gaze shifts, or when no cell is left. Arguments as for `search`; the
        scanpath has no target, and nothing is found.

        Raises:
            InputError: the policy needs a target, or an argument does not fit.
        """
        image, grid = self._frame(image)
        policy = self.exploration(None, grid)
        return self._gaze(
            image, grid, self.semantics, policy, None, start, shifts, seed, lambda cell, detections: False
        )

    def _frame(self, image: Tensor) -> tuple[Tensor, Grid]:
        """The image as a batch of one, and the grid over it."""
        image = image[None] if image.ndim == 3 else image
        check_shape(image, "image", 1, 3, None, None)
        return image, Grid(self.columns, self.rows, (image.shape[-1], image.shape[-2]))

    def _gaze(
        self,
        image: Tensor,
        grid: Grid,
        observer: Observer,
        acquisition: AcquisitionFunction,
        target: int | None,
        start: int | None,
        shifts: int,
        seed: int,
        ends: Callable[[int, Detections], bool],
    ) -> Scanpath:
        """Move the gaze until `ends` says so, for what is seen from a cell, or no shift or cell is left."""
        generator = torch.Generator().manual_seed(seed)
        if start is None:
            start = int(torch.randint(len(grid), (1,), generator=generator))
        check(0 <= start < len(grid), "start", f"a cell from 0 to {len(grid) - 1}", start)
        view = self.eye.open(image)
        belief, semantics = observer.start(1, grid, image), self.semantics.start(1, grid, image)
        visited = torch.zeros(1, len(grid), dtype=torch.bool, device=image.device)
        cell, cells, seen, beliefs, present, values, found = start, [], [], [], [], [], False
        while True:
            fixation = grid.centres[cell].to(image)[None]
            detections = self.eye.look(view, fixation)
            evidence = observer.weigh(detections, fixation, grid, target)
            noise = torch.rand(1, len(grid), generator=generator).to(image)
            here = torch.tensor([cell], device=image.device)
            after = step(observer, belief, visited, here, evidence, acquisition, noise)
            belief, visited = after.belief, after.visited
            if observer is self.semantics:
                semantics = dirichlet_belief(belief)
            else:
                semantics = self.semantics.update(semantics, self.semantics.weigh(detections, fixation, grid))
            cells.append(cell)
            seen.append(detections)
            beliefs.append(semantics.beta[0])
            if target is not None:
                present.append(belief.probability(target)[0])
            values.append(after.values[0])
            found = ends(cell, detections)
            cell = int(after.cell)
            if found or len(cells) > shifts or cell < 0:
                break
        visits = torch.tensor(cells, device=image.device)
        return Scanpath(
            grid=grid,
            classes=self.classes,
            target=target,
            cells=visits,
            fixations=grid.centres.to(image)[visits],
            detections=tuple(seen),
            beliefs=torch.stack(beliefs),
            values=torch.stack(values),
            found=found,
            posterior=torch.stack(present) if present else None,
        )

    def _target(self, target: str | int) -> int:
        if isinstance(target, str):
            return self.classes.index(lookup(target, self.classes[1:], "target class"))
        check(1 <= target < len(self.classes), "target", f"a class from 1 to {len(self.classes) - 1}", target)
        return target


def models_of(observer: object) -> Iterator[nn.Module]:
    """Modules that an observer holds: its own, those of an observer inside it, and those whose methods it calls."""
    for value in vars(observer).values():
        owner = getattr(value, "__self__", value)
        if isinstance(owner, nn.Module):
            yield owner
        elif hasattr(owner, "weigh"):
            yield from models_of(owner)


def confirms(detections: Detections, grid: Grid, cell: int, target: int, score: float) -> bool:
    """Whether a detection that overlaps `cell` has `target` as its best class, with at least this score."""
    sure = (detections.scores.argmax(-1) == target) & (detections.scores[..., target] >= score)
    return bool((grid.footprint(detections.boxes)[..., cell] & sure & detections.mask).any())
