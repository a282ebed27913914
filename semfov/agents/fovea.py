"""The part of an agent that looks by a fovea: its searches and explorations of photographs, and its streams."""

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from semfov.agents.episode import EpisodeLimits, on_cpu
from semfov.agents.fovea_episode import FoveaEpisode, FoveaStream, GazeParts, GazePlan
from semfov.belief import Grid
from semfov.belief.observers import SemanticMap
from semfov.belief.observers.any_of import TargetLike
from semfov.decision.stopping import AtDetection, AtGoal, LittleGain, StoppingCriterion
from semfov.errors import InputError, check, check_finite, check_shape, check_whole
from semfov.gaze.acquisition import ExpectedGain
from semfov.paths import GazePrediction, Scanpath
from semfov.settings import ExploreSettings, FindSettings, SearchSettings, StreamSettings, value_or

_MIN_GAIN = 0.1  # default for the least gain of a look, in cells that are classified correctly
# It is 0.1 a frame at 25 frames a second, chosen on ten photographs of the fit.
RATE = 2.5  # default rate at which the belief fades in a stream, per second
_CONFIRM = 0.5  # default for the score of a detection that ends a search without thresholds


class FoveaAgent(GazeParts):
    """The part of an agent that moves its gaze over a photograph."""

    def search(self, image: Tensor, target: TargetLike, settings: SearchSettings) -> Scanpath:
        """Search a photograph for a target, and decide whether the photograph holds it (`ActivePerception.search`).

        Args:
            image: the photograph, `(1, 3, H, W)`.
            target: class by name or index 1..K, several, or each with the probability that it is meant.
            settings: the settings of the search.

        Returns:
            The record, with its decision.
        """
        return self.open_search(image, target, settings).run()

    def open_search(
        self, image: Tensor, target: TargetLike, settings: SearchSettings, cells: Sequence[int] | None = None
    ) -> FoveaEpisode:
        """Make the episode of a search in a photograph, which has not taken a look yet.

        Args:
            image: the photograph, `(1, 3, H, W)`.
            target: class by name or index 1..K, several, or each with the probability that it is meant.
            settings: the settings of the search.
            cells: cells that are looked at one after the other; None follows the policy.

        Returns:
            The episode, which ends as a search does.
        """
        limits = EpisodeLimits.of(settings)
        strategy, index, weights = self.searching.sought(target, ("background", *self.eye.detector.classes))
        plan = GazePlan(
            self,
            index,
            strategy=strategy,
            start=settings.start,
            shifts=_shifts(settings.shifts, 30, limits),
            seed=settings.seed,
            # By the protocol of the paper a search ends at a box of the target, without closer looks.
            decisions=settings if settings.boxes is None else replace(settings, closer=0),
            cells=cells,
        )
        boxes = settings.boxes
        if boxes is not None:
            like = self.eye.sensor.like
            return FoveaEpisode(plan, image, limits, lambda grid: AtGoal(_goal_cells(boxes, grid, like)))
        if plan.thresholds is None:
            score = value_or(settings.confirm, _CONFIRM)
            return FoveaEpisode(plan, image, limits, lambda grid: AtDetection(grid, index, weights, score))
        return FoveaEpisode(plan, image, limits)

    def explore(self, image: Tensor, settings: ExploreSettings) -> Scanpath:
        """Explore a photograph, without a target (`ActivePerception.explore`).

        Args:
            image: the photograph, `(1, 3, H, W)`.
            settings: the settings of the exploration.

        Returns:
            The record.
        """
        limits = EpisodeLimits.of(settings)
        observer = on_cpu(self.exploring.observer)
        min_gain, policy = settings.min_gain, settings.policy
        if min_gain and not isinstance(observer, SemanticMap):
            raise InputError(
                f"min_gain: expected None for an agent without a semantic map, got {min_gain}; use a recommended agent"
            )
        plan = GazePlan(
            self,
            start=settings.start,
            shifts=_shifts(settings.shifts, 20, limits),
            seed=settings.seed,
            viewed=None if policy is None else GazePrediction.of(self.eye.detector, image[0]),
        )

        def criterion(grid: Grid) -> StoppingCriterion:
            if not isinstance(observer, SemanticMap) or (policy is not None and min_gain is None):
                return StoppingCriterion()
            gain = ExpectedGain(grid, self.eye.sensor.width(self.eye.sensor.settings()) / self.eye.reference)
            return LittleGain(gain, value_or(min_gain, _MIN_GAIN))

        return FoveaEpisode(plan, image, limits, criterion).run()

    def find_all(self, image: Tensor, targets: tuple[int, ...], settings: FindSettings) -> Scanpath:
        """Look for all objects of classes (`ActivePerception.find_all`).

        Args:
            image: the photograph, `(1, 3, H, W)`.
            targets: classes 1..K; none stand for all classes.
            settings: the settings of the task.

        Returns:
            The record, with its objects.
        """
        limits = EpisodeLimits.of(settings)
        target = targets[0] if len(targets) == 1 else None
        plan = GazePlan(self, target, shifts=_shifts(settings.shifts, 20, limits))
        episode = FoveaEpisode(plan, image, limits, lambda grid: StoppingCriterion())
        return replace(episode.run(), target=None, targets=targets)

    def stream(self, target: int | None, settings: StreamSettings) -> FoveaStream:
        """Make the episode of a stream (`ActivePerception.live`).

        Args:
            target: class 1..K to search for; None explores.
            settings: the settings of the task.

        Returns:
            The episode, to which frames are given.

        Raises:
            InputError: a setting is for windows alone.
        """
        check(
            settings.score_threshold is None,
            "score_threshold",
            "None for a fovea, or how='windows'",
            settings.score_threshold,
        )
        check(settings.passes in (None, 1), "passes", "1 for a fovea, or how='windows'", settings.passes)
        rate = value_or(settings.rate, RATE)
        plan = GazePlan(self, target, start=settings.start, seed=settings.seed, decisions=settings, rate=rate)
        return FoveaStream(plan, settings.color)


def _shifts(shifts: int | None, usual: int, limits: EpisodeLimits) -> int:
    """Choose the largest number of gaze shifts: the given one, else the usual one, or with a limit of passes all."""
    most = 10_000
    if shifts is None:
        shifts = usual if limits.passes is None else most
    check_whole(shifts, "shifts", 0, most)
    return shifts


def _goal_cells(boxes: Tensor | Sequence[Sequence[float]], grid: Grid, like: Tensor) -> Tensor:
    """Cells that boxes overlap; by the protocol of the paper a search ends when it fixates one of them.

    Shapes: boxes `(M, 4)` → `(X·Y,)`.
    """
    tensor = torch.as_tensor(boxes).to(like)
    check_shape(tensor, "boxes", None, 4)
    check(tensor.ndim == 2, "boxes", "shape (M, 4)", tuple(tensor.shape))
    check_finite(tensor, "boxes")
    got = "others; convert (x, y, width, height) to (x, y, x + width, y + height)"
    full = bool((tensor[:, 2:] > tensor[:, :2]).all())
    check(full, "boxes", "(x1, y1, x2, y2) with x1 < x2 and y1 < y2", got)
    return grid.footprint(tensor).any(-2)
