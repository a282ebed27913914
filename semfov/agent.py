"""An agent with a foveal sensor: it searches an image for a class, or explores it."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike, fspath
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.context import ContextPrior
from semfov.belief.grid import Grid, check_cells
from semfov.belief.map_evidence import MapEvidence
from semfov.belief.observers import AnyBelief, AnyOf, Context, LearnedMap, Observer, Semantic, Target
from semfov.belief.observers.any_of import TargetLike, weights_by_class
from semfov.belief.target_evidence import TargetEvidence
from semfov.data.classes import class_index
from semfov.data.inputs import ImageLike, as_image
from semfov.decision import check_thresholds, conclude, goal_cells, outcome_of
from semfov.detection.load import load_detector
from semfov.episode import LiveLooks, Step, rollout
from semfov.errors import InputError, check, check_whole, lookup
from semfov.eye import Eye
from semfov.gaze.acquisition import ExpectedGain
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.gaze.policies import KL, Closer, NonPredictive, Policy, Predictive, Random
from semfov.io.compatibility import check_shipped_sensor, learned_for
from semfov.io.schema import is_number
from semfov.io.shipped import shipped_model
from semfov.live import RATE, LivePerception
from semfov.model_folder import open_folder
from semfov.observation.foveal import FovealObservationModel
from semfov.scanpath import Ending, Scanpath, Stimulus, trace
from semfov.sensor.foveation import Foveation
from semfov.sensor.named import named_sensor

PUBLISHED_SENSORS = ("published", "published-narrow")
"""Named sensors of the paper, for which observation models of maximum likelihood are shipped."""

PRICE = 0.1
"""How many more cells a look must be expected to name right, for an exploration by a learned map to go on."""

MOST_SHIFTS = 10_000
"""More gaze shifts than any episode has."""


class Strategy(nn.Module):
    """How to go about a task.

    Args:
        observer: turns looks into belief.
        policy: chooses where to look by it.
    """

    def __init__(self, observer: Observer, policy: Policy) -> None:
        super().__init__()
        self.observer = observer
        self.policy = policy


class ActivePerception(nn.Module):
    """An agent that moves its gaze over an image, to find a class or to learn what is where.

    Args:
        eye: sensor and detector.
        search: observer and policy of searches.
        explore: observer and policy of explorations; its observer keeps the map of all classes during searches, too.
        grid: `(columns, rows)` of the belief.

    Example::

        agent = ActivePerception.recommended("yolov3-tiny")
        scanpath = agent.search(read_image("kitchen.jpg"), "cup")
    """

    def __init__(
        self,
        eye: Eye,
        search: tuple[Observer, Policy],
        explore: tuple[Observer, Policy],
        *,
        grid: tuple[int, int] = (10, 10),
    ) -> None:
        super().__init__()
        self.eye = eye
        self.searching = Strategy(*search)
        self.exploring = Strategy(*explore)
        check_cells(grid)
        self.columns, self.rows = grid

    @classmethod
    def recommended(
        cls,
        name: str = "yolov3-tiny",
        *,
        sigma: float = 100.0,
        growth: float = 2.0,
        grid: tuple[int, int] = (10, 10),
        context: bool = False,
        **options: Any,
    ) -> Self:
        """The agent for daily use: it searches by learned target evidence, and explores by a learned map.

        Args:
            name: a detector for which models are shipped, `yolov3-tiny` or `yolox-nano`.
            sigma: width of the fovea in pixels of an image of 640; the models are fitted for 100.
            growth: see `Foveation`; models are fitted for 2, and for 1 as published.
            grid: `(columns, rows)` of the belief; models are fitted on 10 x 10 cells, and hold for 5 to 20 a side.
            context: whether search also goes by the usual places and company of the target (`ContextPrior`).
            options: of `semfov.load_detector`.

        Raises:
            InputError: no models are shipped for a detector of this name, for such a sensor or on such a grid.
            DataError: the weights cannot be had, or are damaged.
        """
        check_shipped_sensor(sigma, growth)
        check_cells(grid)
        detector = load_detector(name, **options)
        eye = Eye(Foveation(sigma, growth=growth), detector)
        name = shipped_model(TargetEvidence, learned_for(detector.name, growth), name)
        evidence = TargetEvidence.from_pretrained(name)
        evidence.check_compatible(eye.settings(), grid)
        everything = MapEvidence.from_pretrained(name)
        everything.check_compatible(eye.settings(), grid)
        observer: Observer = Target(evidence)
        if context:
            prior = ContextPrior.from_pretrained()
            prior.check_compatible(detector.classes)
            observer = Context(observer, prior)
        mapping = LearnedMap(everything), Closer(sigma / eye.reference)
        return cls(eye, (observer, NonPredictive()), mapping, grid=grid).eval().requires_grad_(False)

    @classmethod
    def from_pretrained(cls, name: str | PathLike[str] = "yolov3-tiny", **options: Any) -> Self:
        """The agent of a folder that `semfov.fit_detector` wrote, or the recommended one of a detector's name.

        Args:
            name: the folder, or a name as for `recommended`.
            options: of `recommended`; for a folder those of `semfov.model_folder.ModelFolder.load_detector`.

        Raises:
            InputError: it is no folder, and no models are shipped for the name (the message has the command for both).
            DataError: a file is missing, damaged, or another than the models were fitted to.
        """
        folder = open_folder(name)
        if folder is None:
            return cls.recommended(fspath(name), **options)
        return cls(**folder.parts(**options)).eval().requires_grad_(False)

    @classmethod
    def published(
        cls,
        name: str | PathLike[str] = "yolov3-tiny",
        *,
        sensor: str | None = None,
        search: str = "predictive",
        calibrated: bool = True,
        **options: Any,
    ) -> Self:
        """The agent of Luzio, Bernardino and Moreno (2024), with the small detectors that models are shipped for.

        10 x 10 cells with a uniform prior of 0.5, every cell that a box overlaps updated by Kaplan's rule, scores
        calibrated by Dirichlets of maximum likelihood; exploration maximises the Kullback-Leibler divergence. The paper
        prints no width of its wide and its narrow fovea: ours are 100 and 50 pixels of 640. The detectors are smaller
        than its YOLOv3. Of a folder of models it takes detector, sensor, grid and observation model.

        Args:
            name: a detector for which models are shipped, `yolov3-tiny` or `yolox-nano`, or a folder of models.
            sensor: `published`, the wide fovea, or `published-narrow`; None: the wide one, or the folder's own.
            search: `predictive` or `non-predictive`.
            calibrated: whether scores go through the observation model before they are fused ("Modified Kaplan").
            options: of `semfov.load_detector`.

        Raises:
            InputError: no models are shipped for a detector or a sensor of this name, or the folder has none.
            DataError: the weights cannot be had, or are damaged.
        """
        lookup(search, ["predictive", "non-predictive"], "published search policy")
        folder = open_folder(name)
        if folder is not None:
            check(sensor is None, "sensor", "None beside a folder of models, which has its own", sensor)
            eye, model, grid = folder.eye(**options), folder.observation(), folder.manifest.grid
        else:
            fovea, grid = lookup(sensor or "published", PUBLISHED_SENSORS, "published sensor"), (10, 10)
            eye = Eye(named_sensor(fovea), load_detector(name, **options))
            shipped = shipped_model(FovealObservationModel, f"{eye.detector.name}-{fovea}", fspath(name))
            model = FovealObservationModel.from_pretrained(shipped)
        model.check_compatible(eye.settings(), eye.detector.classes)
        observer = Semantic(len(eye.detector.classes) + 1, model if calibrated else None)
        policy = Predictive(model) if search == "predictive" else NonPredictive()
        return cls(eye, (observer, policy), (observer, KL(model)), grid=grid).eval().requires_grad_(False)

    @classmethod
    def raw(cls, name: str = "yolov3-tiny", *, sensor: str = "published", **options: Any) -> Self:
        """The agent that needs no fitted model, for any detector: scores are likelihoods, exploration is at random.

        Args:
            name: of the detector, as for `semfov.load_detector`.
            sensor: name of the sensor (`semfov.sensor.SENSORS`).
            options: of `semfov.load_detector`.

        Raises:
            InputError: the detector or the sensor is unknown.
            DataError: the weights cannot be had, or are damaged.
        """
        eye = Eye(named_sensor(sensor), load_detector(name, **options))
        observer = Semantic(len(eye.detector.classes) + 1)
        return cls(eye, (observer, NonPredictive()), (observer, Random())).eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the belief's components, background first."""
        return ("background", *self.eye.detector.classes)

    def search(
        self,
        image: ImageLike,
        target: TargetLike,
        *,
        start: int | None = None,
        shifts: int = 30,
        seed: int = 0,
        boxes: Tensor | Sequence[Sequence[float]] | None = None,
        confirm: float | None = None,
        give_up: float | None = None,
        price: float | None = None,
    ) -> Scanpath:
        """Search an image for a target class, and decide whether it is there (`Scanpath.decision`).

        The search ends when the target is found: it is probable enough that the image holds it, and the gaze has been
        on a cell that is about as probable as any. It ends without the target when no cell is left that is probable
        enough to be worth a look, and after `shifts` gaze shifts (`semfov.decision.decide`).

        Beliefs that no thresholds were chosen for (those of Kaplan's rule) do not give up. They find the target when a
        detection that overlaps the fixated cell has it as its best class, with a score of `confirm`.

        With `boxes` no decision is made: the search ends when the gaze is on a cell that one of them overlaps (the
        protocol of the paper).

        Args:
            image: a picture of any common kind (`semfov.as_image`): a path, an image of Pillow's, an array or a tensor.
            target: name or index (1..K) of the class; or several, each with the probability that it is meant (`AnyOf`,
                `semfov.data.spread`): the scanpath's is then the most probable of them.
            start: first cell; None draws one.
            shifts: most gaze shifts to make.
            seed: of the generator that draws the start and breaks ties.
            boxes: `(M, 4)`, where the target really is.
            confirm: probability that the image holds the target, from which on it counts as found; None takes the one
                that was chosen when the belief was fitted, or a score of 0.5.
            give_up: probability below which a cell is not worth a look; None takes the one that was chosen.
            price: of a look, in right decisions: the search then ends when looking on is not worth it, in place of the
                thresholds (`semfov.decision.decide_by_price`).

        Raises:
            InputError: the class is unknown (the nearest names are suggested), or an argument does not fit.
            DataError: the image's file cannot be read.
        """
        strategy, index, wanted = self._sought(target)
        check_thresholds(confirm, give_up)
        check(price is None or (is_number(price) and price >= 0), "price", "0 or more right decisions", price)
        image, grid = self._frame(image)
        goal = None if boxes is None else goal_cells(boxes, grid, image)
        chosen = self.searching.observer.thresholds
        if price is not None and (chosen is None or confirm is not None or give_up is not None):
            raise InputError("price: expected None, with thresholds or for a belief that tells no presence")
        thresholds = None if chosen is None else chosen.changed(confirm, give_up)

        outcome = outcome_of(wanted, grid, goal, price, thresholds, 0.5 if confirm is None else confirm)
        scanpath, ended, last = self._gaze(image, grid, strategy, index, start, shifts, seed, outcome)
        index = int(last.belief.likeliest()) if isinstance(last.belief, AnyBelief) else index
        scanpath = replace(scanpath, found=ended == 1, target=index)
        if goal is not None:
            return replace(scanpath, ending="box") if ended else scanpath
        if ended:
            scanpath = replace(scanpath, ending="decision")
        # A belief without thresholds found what it looked at.
        cell = None if thresholds is not None else int(last.cell)
        return replace(scanpath, decision=conclude(ended, last.belief, scanpath.detections, grid, index, cell))

    def explore(
        self, image: ImageLike, *, start: int | None = None, shifts: int = 20, seed: int = 0, until: float | None = None
    ) -> Scanpath:
        """Explore an image: build up the belief about the whole map, with no target.

        The exploration ends after `shifts` gaze shifts, when no cell is left, and, where the map was learned, when no
        look is expected to name `until` more cells right. Other arguments as for `search`; the scanpath has no target,
        and nothing is found.

        Args:
            until: the price of a look in cells that are named right (`semfov.acquisition.ExpectedGain`); 0 goes on to
                the end; None takes `PRICE` where the map was learned.

        Raises:
            InputError: an argument does not fit, or only a learned map could tell what a look will bring.
        """
        check(until is None or (is_number(until) and until >= 0), "until", "a price in cells, 0 or more", until)
        image, grid = self._frame(image)
        observer = self.exploring.observer
        if not isinstance(observer, LearnedMap):
            if until:
                raise InputError("until: expected None, for only a learned map tells what a look will bring")
            return self._gaze(image, grid, self.exploring, None, start, shifts, seed, None)[0]
        gain, price = ExpectedGain(observer.model, grid), PRICE if until is None else until

        def spent(step: Step) -> Tensor:
            worth = gain(step.belief, step.visited).masked_fill(step.visited, -math.inf).amax(-1)
            return ((worth < price) & (price > 0) & ~step.visited.all(-1)).long()

        scanpath, ended, _ = self._gaze(image, grid, self.exploring, None, start, shifts, seed, spent)
        return replace(scanpath, ending="price") if ended else scanpath

    def live(
        self,
        target: str | int | None = None,
        *,
        rate: float = RATE,
        start: int | None = None,
        seed: int = 0,
        confirm: float | None = None,
        give_up: float | None = None,
    ) -> LivePerception:
        """Search a camera or a video, or explore it: a look at every frame, by a belief that goes on and fades.

        `target` is a name or an index, None to explore. The other arguments are those of `semfov.live.LivePerception`,
        and `confirm` and `give_up` those of `search`.
        """
        index = None if target is None else class_index(target, self.classes[1:], "target")
        check_thresholds(confirm, give_up)
        strategy = self.exploring if index is None else self.searching
        chosen = strategy.observer.thresholds
        return LivePerception(
            self.eye,
            strategy.observer,
            strategy.policy,
            self.classes,
            (self.columns, self.rows),
            target=index,
            rate=rate,
            start=start,
            seed=seed,
            thresholds=None if chosen is None else chosen.changed(confirm, give_up),
        )

    def _sought(self, target: TargetLike) -> tuple[Strategy, int, dict[int, float]]:
        """How to search for a target, the class that is most wanted, and the weights of all that are."""
        if not isinstance(target, Mapping):
            index = class_index(target, self.classes[1:], "target")
            return self.searching, index, {index: 1.0}
        wanted, policy = weights_by_class(target, self.classes[1:]), self.searching.policy
        suits = isinstance(policy, NonPredictive | Random) or policy.by_place
        check(suits, "target", f"one class, for policy {policy.name!r}, which does not go by probability", dict(target))
        several = Strategy(AnyOf(self.searching.observer, wanted), policy)
        return several, max(wanted, key=wanted.__getitem__), wanted

    def _frame(self, picture: ImageLike) -> tuple[Tensor, Grid]:
        """The image as a batch of one, and the grid over it."""
        image = as_image(picture, like=self.eye.sensor.like)[None]
        return image, Grid(self.columns, self.rows, (image.shape[-1], image.shape[-2]))

    def _gaze(
        self,
        image: Tensor,
        grid: Grid,
        strategy: Strategy,
        target: int | None,
        start: int | None,
        shifts: int,
        seed: int,
        outcome: Callable[[Step], Tensor] | None,
    ) -> tuple[Scanpath, int, Step]:
        """Move the gaze until there is an outcome, or no shift or cell is left; also the outcome and the last step."""
        check_whole(shifts, "shifts", 0, MOST_SHIFTS)
        first, generator = first_cell(start, seed, len(grid))
        looks = LiveLooks(self.eye, self.eye.open(image), grid, target)
        ended: tuple[int, Step] | None = None

        def ends(step: Step) -> Tensor:
            nonlocal ended
            came = torch.zeros_like(step.cell) if outcome is None else outcome(step)
            ended = int(came), step
            return came > 0

        steps = rollout(
            looks,
            strategy.observer,
            strategy.policy(target, grid),
            torch.tensor([first], device=image.device),
            Greedy(drawn_by(generator, len(grid), image)),
            most=shifts + 1,
            ends=ends,
        )
        mapper = self.exploring.observer
        beside = None if mapper is strategy.observer else mapper
        scanpath = trace(steps, grid, self.classes, target, beside)
        assert ended is not None
        ending: Ending = "cells" if bool(ended[1].visited.all()) else "shifts"
        return replace(scanpath, ending=ending, stimulus=Stimulus.of(self.eye, image)), *ended
