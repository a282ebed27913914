"""The looks and beliefs of one episode of a fovea, from which its scanpath is made at any time."""

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from semfov.belief import Belief, Grid
from semfov.belief.observers.base import Observer
from semfov.detection.detections import Detections
from semfov.detection.objects import SCORE_THRESHOLD
from semfov.episode import Step
from semfov.paths.conversion import Values
from semfov.paths.fovea import FoveaLook, FoveaLooks
from semfov.paths.scanpath import Scanpath


class _Fixated(NamedTuple):
    """What a trace keeps of a fixation, a batch of one: what it showed, and the belief after it."""

    cell: Tensor
    fixation: Tensor
    detections: Detections
    belief: Belief
    values: Tensor


class Trace:
    """Keeps the looks of one episode of a fovea, and makes scanpaths of them at any time.

    Args:
        grid: the cells.
        classes: names of the classes, background first.
        target: class 1..K that is searched for; None for an exploration.
        beside: observer of the map of all classes beside the belief of a search; None if the belief is that map.
        score_threshold: score from which on objects count.

    Private attributes: `_posterior` and `_presence` have the probability of the target in each cell and in the picture
    after each fixation, `_maps` the map of all classes, and `_belief` is that of the last map, where one is kept beside
    the search.

    Invariant: `_fixated` has an entry for each fixation. So have, in a search, `_posterior` and `_presence`. `_maps`
    has those that were read so far, from the first fixation on.
    """

    def __init__(
        self,
        grid: Grid,
        classes: tuple[str, ...],
        target: int | None,
        beside: Observer | None,
        score_threshold: float = SCORE_THRESHOLD,
    ) -> None:
        self.grid = grid
        self.classes = classes
        self.target = target
        self.beside = beside
        self.score_threshold = score_threshold
        self._fovea = FoveaLooks(grid)
        self._fixated: list[_Fixated] = []
        self._posterior: list[Tensor] = []
        self._presence: list[Tensor] = []
        self._maps: list[Tensor] = []
        self._belief: Belief | None = None
        # Maps are made as if they had been made at once: with gradients and inference mode as they were then.
        self._modes = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    @property
    def looks(self) -> tuple[FoveaLook, ...]:
        """The looks so far."""
        return tuple(self._fovea.looks)

    def add(self, step: Step) -> FoveaLook:
        """Add the fixation of a step."""
        return self.fixate(step.cell, step.fixation, step.detections, step.belief, step.values, step.seconds)

    def fixate(
        self,
        cell: Tensor,
        fixation: Tensor,
        detections: Detections,
        belief: Belief,
        values: Tensor,
        stages: Mapping[str, float],
    ) -> FoveaLook:
        """Add a fixation.

        Args:
            cell: `(1,)`, the fixated cell.
            fixation: `(1, 2)`, the fixated point.
            detections: what it shows, a batch of one.
            belief: the belief after it, a batch of one.
            values: `(1, X·Y)`, values of the acquisition function after it.
            stages: seconds by stage; empty if they are not known.

        Returns:
            The look.
        """
        number = int(cell)
        value = float(self._fixated[-1].values[0, number]) if self._fixated else None
        probability = None
        presence = None
        if self.target is not None:
            probability = belief.probability(self.target)[0]
            self._posterior.append(probability)
            self._presence.append(belief.presence(self.target)[0])
            presence = float(self._presence[-1])
        self._fixated.append(_Fixated(cell, fixation, detections, belief, values))
        return self._fovea.fixate(number, fixation[0].tolist(), detections, stages, value, probability, presence)

    def look_closely(
        self,
        cell: int,
        region: Sequence[float],
        detections: Detections,
        stages: Mapping[str, float],
        value: float,
    ) -> FoveaLook:
        """Add a closer look (`FoveaLooks.look_closely`)."""
        return self._fovea.look_closely(cell, region, detections, stages, value)

    def scanpath(self, **outcome: Any) -> Scanpath:
        """Make the scanpath of the looks so far. Its map of all classes is made when it is read.

        Args:
            outcome: further attributes of the scanpath: decision, ending, photograph, …
        """
        cells = len(self.grid)
        fields: Values = {
            "grid": self.grid,
            "classes": self.classes,
            "target": self.target,
            "score_threshold": self.score_threshold,
            "looks": self.looks,
            "probabilities": partial(self._probabilities, len(self._fixated)),
            "values": _stacked([fixated.values[0] for fixated in self._fixated], cells),
            "found": False,
        }
        if self.target is not None:
            fields["posterior"] = _stacked(self._posterior, cells)
            fields["presence"] = _stacked(self._presence)
        return Scanpath(**{**fields, **outcome})

    def _probabilities(self, count: int) -> Tensor:
        """Make the map of all classes after each of the first fixations, `(count, X·Y, K+1)`."""
        has_gradients, is_inference = self._modes
        with torch.inference_mode(is_inference), torch.set_grad_enabled(has_gradients):
            for fixated in self._fixated[len(self._maps) : count]:
                self._maps.append(self._belief_about_all(fixated).class_probabilities()[0])
            return _stacked(self._maps[:count], len(self.grid), len(self.classes))

    def _belief_about_all(self, fixated: _Fixated) -> Belief:
        """Take the next fixation into the belief about all classes, which may be that of the episode."""
        if self.beside is None:
            return fixated.belief
        before = self.beside.start(1, self.grid, fixated.values) if self._belief is None else self._belief
        self._belief = self.beside(before, fixated.detections, fixated.fixation, self.grid)
        return self._belief


def _stacked(tensors: Sequence[Tensor], *shape: int) -> Tensor:
    """Stack n tensors of a shape, `(n, *shape)`, also none of them: an episode may have no fixation yet."""
    return torch.stack([*tensors]) if tensors else torch.zeros(0, *shape)
