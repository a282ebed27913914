"""The agent: with a foveal sensor, it searches an image for a class or explores it."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike, fspath
from typing import Any, Self

import torch
from torch import Tensor, nn

from semfov.belief.grid import Grid, check_cells
from semfov.belief.observers import LearnedMap, Observer
from semfov.belief.observers.any_of import TargetLike, class_meant
from semfov.belief.verification import Verification
from semfov.data.classes import class_index
from semfov.data.inputs import ImageLike, as_image
from semfov.decision import (
    MOST_CLOSER,
    OUTCOMES,
    CandidateCells,
    Verifier,
    check_thresholds,
    conclude,
    goal_cells,
    outcome_by_gain,
    outcome_of,
)
from semfov.episode import LiveLooks, Step, rollout
from semfov.errors import InputError, check, check_whole
from semfov.eye import Eye
from semfov.gaze.acquisition import ExpectedGain
from semfov.gaze.choice import Greedy, drawn_by, first_cell
from semfov.gaze.policies import Policy
from semfov.io.schema import is_number
from semfov.live import RATE, LivePerception
from semfov.model_folder import open_folder
from semfov.paths import Ending, Scanpath, Stimulus, trace
from semfov.presets import published_arguments, raw_arguments, recommended_arguments
from semfov.strategy import Strategy

PRICE = 0.1
"""Default price of a look in an exploration by a learned map: the least expected increase in the number of correctly
classified cells for which the exploration continues."""

MOST_SHIFTS = 10_000
"""Largest number of gaze shifts that can be asked for."""


class ActivePerception(nn.Module):
    """An agent that moves its gaze over an image to find a target, or to learn which classes are where.

    Args:
        eye: sensor and detector.
        search: observer and policy for search.
        explore: observer and policy for exploration; during a search this observer keeps the map of all classes.
        verification: probabilities after closer looks (`semfov.belief.Verification`); None searches without them.
        grid: `(columns, rows)` of the belief, 1 to 200 each.

    Raises:
        InputError: `grid` is out of range.

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
        verification: Verification | None = None,
        grid: tuple[int, int] = (10, 10),
    ) -> None:
        super().__init__()
        self.eye = eye
        self.searching = Strategy(*search)
        self.exploring = Strategy(*explore)
        self.verification = verification
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
        """The agent for everyday use: it searches with learned target evidence and explores with a learned map.

        Args:
            name: a detector that models are shipped for, `yolov3-tiny` or `yolox-nano`.
            sigma: width of the fovea, in pixels of an image whose longer side is 640; the models are fitted for 100.
            growth: growth of the fovea (`Foveation`); the models are fitted for 2, and for 1 as in the paper.
            grid: `(columns, rows)` of the belief; the models are fitted on 10 x 10 cells, and hold for 5 to 20 a side.
            context: whether search also uses the usual places of the target and its co-occurrence with other classes
                (`ContextPrior`).
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: no models are shipped for this detector, this sensor or this grid.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(recommended_arguments(name, sigma, growth, grid, context, **options))

    @classmethod
    def from_pretrained(cls, name: str | PathLike[str] = "yolov3-tiny", **options: Any) -> Self:
        """The agent from a folder that `semfov.fit_detector` wrote, or the recommended agent for a detector.

        Args:
            name: the folder, or the name of a detector as for `recommended`.
            options: options of `recommended`; for a folder, of `semfov.model_folder.ModelFolder.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: it is no folder, and no models are shipped for the name; the message has the commands for both.
            DataError: a file is missing or damaged, or the detector is not the one that the models were fitted to.
        """
        folder = open_folder(name)
        return cls.recommended(fspath(name), **options) if folder is None else cls._of(folder.arguments(**options))

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
        """The agent of Luzio, Bernardino and Moreno (2024), with one of the small detectors that have shipped models.

        It has 10 x 10 cells with a uniform prior of 0.5. Kaplan's rule updates every cell that a box overlaps, with
        scores calibrated by Dirichlets of maximum likelihood. Exploration maximises the Kullback-Leibler divergence.
        The paper does not give the widths of its wide and its narrow fovea; ours are 100 and 50 pixels of 640. Its
        detector is YOLOv3, larger than ours. With a folder of models, detector, sensor, grid and observation model are
        those of the folder.

        Args:
            name: a detector that models are shipped for, `yolov3-tiny` or `yolox-nano`, or a folder of models.
            sensor: `published`, the wide fovea, or `published-narrow`; None is the wide one, or that of the folder.
            search: `predictive` or `non-predictive`.
            calibrated: whether scores are calibrated by the observation model before fusion ("Modified Kaplan").
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: no models are shipped for this detector or this sensor, or the folder has no observation model.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(published_arguments(name, sensor, search, calibrated, **options))

    @classmethod
    def raw(cls, name: str = "yolov3-tiny", *, sensor: str = "published", **options: Any) -> Self:
        """An agent for any detector, without fitted models: raw scores as likelihoods, and random exploration.

        Args:
            name: name or path of the detector, as for `semfov.load_detector`.
            sensor: name of the sensor (`semfov.sensor.SENSORS`).
            options: options of `semfov.load_detector`.

        Returns:
            The agent, in `eval` mode and without gradients.

        Raises:
            InputError: the detector or the sensor is unknown.
            DataError: the weights cannot be downloaded, or are damaged.
        """
        return cls._of(raw_arguments(name, sensor, **options))

    @classmethod
    def _of(cls, parts: dict[str, Any]) -> Self:
        """The agent with these parts, ready for use."""
        return cls(**parts).eval().requires_grad_(False)

    @property
    def classes(self) -> tuple[str, ...]:
        """Names of the classes, background first, in the order of the belief's components."""
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
        closer: int = MOST_CLOSER,
    ) -> Scanpath:
        """Search an image for a target class, and decide whether it is there (`Scanpath.decision`).

        The recommended agent looks closely at places that seem to hold the target: it enlarges a window around them to
        the detector's input (`semfov.decision.Verifier`). The search ends with `found` when the target is probable
        enough at such a place. It ends without the target when no remaining cell is probable enough to be worth a look,
        and after `shifts` gaze shifts.

        Without closer looks the search ends with `found` when the image holds the target with enough probability, and a
        fixated cell is nearly as probable as the most probable one (`semfov.decision.decide`).

        The belief by Kaplan's rule has no calibrated thresholds, so it never gives up. Such a search finds the target
        when a detection that overlaps the fixated cell has the target as its best class, with a score of at least
        `confirm`.

        With `boxes` the search makes no decision: it ends when the gaze is on a cell that a box overlaps, which is the
        protocol of the paper.

        Args:
            image: a picture of any common kind (`semfov.as_image`): a path, a Pillow image, an array or a tensor.
            target: class by name or index 1..K; or several, each with the probability that it is meant (`AnyOf`,
                `semfov.data.spread`). The target of the scanpath is then the most probable of them.
            start: first cell; None draws one at random.
            shifts: largest number of gaze shifts, 0 to 10,000.
            seed: seed of the generator that draws the start and breaks ties.
            boxes: `(M, 4)`, true boxes `(x1, y1, x2, y2)` of the target in pixels of the image.
            confirm: least probability for `found`: with closer looks, that the target is at the place; otherwise, that
                the image holds it. None takes the threshold that was chosen when the model was fitted, or a score of
                0.5 for a belief without thresholds.
            give_up: probability below which a cell is not worth a look; None takes the threshold of the model.
            closer: largest number of closer looks, 0 to 100; each takes one more pass of the detector. 0 decides from
                the foveated looks alone, as does an agent without a model of verification.

        Returns:
            The scanpath, with its decision.

        Raises:
            InputError: the class is unknown (the message suggests the nearest names), or an argument does not fit.
            DataError: the file of the image cannot be read.
        """
        strategy, index, wanted = self.searching.sought(target, self.classes)
        check_thresholds(confirm, give_up)
        check_whole(closer, "closer", 0, 100)
        image, grid = self._frame(image)
        goal = None if boxes is None else goal_cells(boxes, grid, image)
        chosen = strategy.observer.thresholds
        thresholds = None if chosen is None else chosen.changed(confirm, give_up)
        outcome: Callable[[Step], Tensor]
        verifier, model = None, self._verification(closer)
        if model is not None and model.thresholds is not None and goal is None:
            at = model.thresholds.changed(confirm, give_up)
            places, close_up = CandidateCells(grid, index), partial(self.eye.close_up, image)
            outcome = verifier = Verifier(model, places, close_up, at, closer)
        else:
            outcome = outcome_of(wanted, grid, goal, thresholds, 0.5 if confirm is None else confirm)
        scanpath, ended, last = self._gaze(image, grid, strategy, index, start, shifts, seed, outcome)
        index = class_meant(last.belief, index)
        scanpath = replace(scanpath, found=OUTCOMES[ended] == "found", target=index)
        if goal is not None:
            return replace(scanpath, ending="box") if ended else scanpath
        if ended:
            scanpath = replace(scanpath, ending="decision")
        if verifier is not None:
            decision = verifier.conclude()
            found = decision.outcome == "found"
            index = verifier.best.target if found else index
            return replace(scanpath, found=found, target=index, decision=decision, closer=tuple(verifier.looks))
        # Without thresholds the target was found in the fixated cell.
        cell = None if thresholds is not None else int(last.cell)
        return replace(scanpath, decision=conclude(ended, last.belief, scanpath.detections, grid, index, cell))

    def explore(
        self, image: ImageLike, *, start: int | None = None, shifts: int = 20, seed: int = 0, until: float | None = None
    ) -> Scanpath:
        """Explore an image: learn which classes are where, without a target.

        The exploration ends after `shifts` gaze shifts, or when every cell was fixated. With a learned map it also ends
        when no look is expected to classify at least `until` more cells correctly.

        Args:
            image: a picture of any common kind (`semfov.as_image`): a path, a Pillow image, an array or a tensor.
            start: first cell; None draws one at random.
            shifts: largest number of gaze shifts, 0 to 10,000.
            seed: seed of the generator that draws the start and breaks ties.
            until: least expected increase in the number of correctly classified cells that is worth a look
                (`semfov.acquisition.ExpectedGain`). 0 makes all shifts. None takes `PRICE` for a learned map.

        Returns:
            The scanpath, without target and decision.

        Raises:
            InputError: an argument does not fit, or `until` is given for an agent without a learned map.
            DataError: the file of the image cannot be read.
        """
        check(until is None or (is_number(until) and until >= 0), "until", "0 or more cells, or None", until)
        image, grid = self._frame(image)
        observer = self.exploring.observer
        if not isinstance(observer, LearnedMap):
            if until:
                raise InputError(
                    f"until: expected None for an agent without a learned map, got {until}; use the recommended agent"
                )
            return self._gaze(image, grid, self.exploring, None, start, shifts, seed, None)[0]
        explored = outcome_by_gain(ExpectedGain(observer.model, grid), PRICE if until is None else until)
        scanpath, ended, _ = self._gaze(image, grid, self.exploring, None, start, shifts, seed, explored)
        return replace(scanpath, ending="worth") if ended else scanpath

    def live(
        self,
        target: str | int | None = None,
        *,
        rate: float = RATE,
        start: int | None = None,
        seed: int = 0,
        confirm: float | None = None,
        give_up: float | None = None,
        closer: int = MOST_CLOSER,
    ) -> LivePerception:
        """Search or explore a camera or a video: one look at every frame, with a belief that fades between frames.

        When a place seems to hold the target, the recommended agent spends a frame on a closer look (`search`).

        Args:
            target: class to search for, by name or index 1..K; None explores.
            rate: rate at which belief fades, per frame; 0 forgets nothing (`semfov.live.LivePerception`).
            start: first cell; None draws one at random.
            seed: seed of the generator that draws the start and breaks ties.
            confirm: least probability for `found`, as for `search`; None takes that of the model.
            give_up: probability below which a cell is not worth a look; None takes that of the belief alone, which a
                belief that fades can reach, or with rate 0 that of `search`.
            closer: largest number of frames, 0 to 100, that are spent on closer looks in the time until half of the
                evidence is forgotten (ln 2 / rate frames). 0 decides from the foveated looks alone, as for `search`.

        Returns:
            An object whose `step` takes the frames one by one.

        Raises:
            InputError: the class is unknown, or an argument does not fit.
        """
        index = None if target is None else class_index(target, self.classes[1:], "target")
        check_thresholds(confirm, give_up)
        check_whole(closer, "closer", 0, 100)
        strategy = self.exploring if index is None else self.searching
        model = None if index is None else self._verification(closer)
        own = strategy.observer.thresholds
        chosen = own if model is None else model.thresholds
        usual = own.give_up if rate and own is not None else None
        at = None if chosen is None else chosen.changed(give_up=usual).changed(confirm, give_up)
        parts = self.eye, strategy.observer, strategy.policy, self.classes, (self.columns, self.rows)
        return LivePerception(
            *parts, target=index, rate=rate, start=start, seed=seed, thresholds=at, verification=model, closer=closer
        )

    def _verification(self, closer: int) -> Verification | None:
        """The model for closer looks, if they are wanted and it can decide."""
        model = self.verification
        return model if closer and model is not None and model.thresholds is not None else None

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
        """Move the gaze until an outcome, or until no shift or cell is left; returns the outcome and last step, too."""
        check_whole(shifts, "shifts", 0, MOST_SHIFTS)
        first, generator = first_cell(start, seed, len(grid))
        looks = LiveLooks(self.eye, self.eye.open(image), grid, target)
        ended: tuple[int, Step] | None = None

        def ends(step: Step) -> Tensor:
            nonlocal ended
            number = torch.zeros_like(step.cell) if outcome is None else outcome(step)
            ended = int(number), step
            return number > 0

        begin, choice = torch.tensor([first], device=image.device), Greedy(drawn_by(generator, len(grid), image))
        policy = strategy.policy(target, grid)
        steps = rollout(looks, strategy.observer, policy, begin, choice, most=shifts + 1, ends=ends)
        mapper = self.exploring.observer
        beside = None if mapper is strategy.observer else mapper
        scanpath = trace(steps, grid, self.classes, target, beside)
        assert ended is not None
        ending: Ending = "cells" if bool(ended[1].visited.all()) else "shifts"
        return replace(scanpath, ending=ending, stimulus=Stimulus.of(self.eye, image)), *ended
