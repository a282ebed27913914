"""What is believed of a scene that is seen one window at a time."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from semfov.belief.belief import Belief, pick
from semfov.belief.grid import Grid
from semfov.belief.observers.base import Look, Observer, own
from semfov.belief.observers.learned_map import LearnedMap, MapLook
from semfov.belief.observers.target import Target, TargetLook
from semfov.detection.detections import Detections
from semfov.errors import InputError, check
from semfov.head.views import Views


@dataclass(frozen=True)
class SceneLook(Look):
    """What a look says about the cells of a view.

    Attributes:
        pose: of the head.
        said: about the view.
        gaze: `(1,)`, the scene's cell that is looked at.
    """

    pose: int
    said: Look
    gaze: Tensor

    def __getitem__(self, index: Tensor | slice) -> "SceneLook":
        """The look itself: there is one."""
        return self

    @classmethod
    def join(cls, looks: object) -> "SceneLook":
        """Looks from several poses are none from one."""
        raise InputError("looks: expected one look, for each is from a pose of its own")


@dataclass(frozen=True)
class SceneBelief(Belief):
    """Belief about the cells of a scene, in one episode.

    Attributes:
        values: `(1, S, C)`: of a target, the probability that a cell holds it, and the same if no fixated cell does; of
            all classes, the probability of each, background first.
        closest: `(1, S)`, how near the gaze has come to each cell, in longer sides of the narrowest view
            (`Views.distances`); infinite where it was never seen.
        owner: `(1, S)`, the pose from which it was; -1 for none.
        examined: `(1, S)` boolean, cells that were fixated.
        looks: `(1,)`, number of looks.
        views: what is believed of the view from each pose; None where there was no look.
    """

    values: Tensor
    closest: Tensor
    owner: Tensor
    examined: Tensor
    looks: Tensor
    views: tuple[Belief | None, ...]

    @property
    def about_all(self) -> bool:
        """Whether it is about all classes."""
        return self.values.shape[-1] > 2

    def probability(self, target: int | Tensor) -> Tensor:
        """Probability that each cell holds the target, `(1, S)`."""
        return pick(self.values, torch.as_tensor(target)) if self.about_all else self.values[..., 0]

    def chance(self, target: int | Tensor) -> Tensor:
        """The same if no fixated cell holds it, `(1, S)`."""
        return self.probability(target) if self.about_all else self.values[..., 1]

    def class_probabilities(self) -> Tensor:
        """Probabilities of all classes, `(1, S, K+1)`."""
        return self.values if self.about_all else super().class_probabilities()

    def map(self, function: Callable[[Tensor], Tensor]) -> "SceneBelief":
        """The belief with all tensors replaced."""
        values, closest, owner = function(self.values), function(self.closest), function(self.owner)
        views = tuple(None if view is None else view.map(function) for view in self.views)
        return SceneBelief(values, closest, owner, function(self.examined), function(self.looks), views)


class SceneObserver(Observer):
    """Keeps a belief about a scene that is seen one window at a time.

    Each view is believed of as an agent does that moves its eye alone. Cells of the scene take that over from the view
    in which the gaze has come nearest to them. A cell that was never seen has the value of one that was seen from a
    whole longer side away, and showed nothing.

    Args:
        inner: observer of a view: `semfov.observers.Target` or `LearnedMap`.
        views: all that can be looked at.
        prior: probability that a cell that was never seen holds the target; None goes by the observer.
    """

    by_target = True

    def __init__(self, inner: Target | LearnedMap, views: Views, *, prior: float | None = None) -> None:
        super().__init__()
        check(prior is None or 0 < prior < 1, "prior", "a probability", prior)
        self.inner, self.views, self.prior = inner, views, prior

    def start(self, batch: int, grid: Grid, like: Tensor) -> SceneBelief:
        """Nothing seen yet; `grid` is the strip of all views."""
        check(batch == 1, "batch", "one episode at a time", batch)
        cells = len(self.views.world.scene)
        nothing = like.new_zeros(1, cells)
        values = like.new_zeros(1, cells, 2 if isinstance(self.inner, Target) else len(self.inner.model.prior))
        never = tuple(None for _ in self.views.poses)
        return SceneBelief(values, nothing + torch.inf, nothing.long() - 1, nothing.bool(), like.new_zeros(1), never)

    def weigh(self, detections: Detections, fixation: Tensor, grid: Grid, target: int | None = None) -> SceneLook:
        """What a look from a point `(1, 2)` of the strip says; boxes are in pixels of the view."""
        pose, point = self.views.action_of(fixation[0])
        said = self.inner.weigh(detections, point[None], self.views.view_grid, target)
        action = self.views.grid.cell_of(fixation)
        return SceneLook(pose, said, self.views.gaze_cell[action])

    def update(self, belief: Belief, look: Look) -> SceneBelief:
        """Belief after one more look."""
        known, seen = own(belief, SceneBelief, "belief"), own(look, SceneLook, "look")
        views, grid, pose = self.views, self.views.view_grid, seen.pose
        values = known.values
        if not bool(known.looks):
            values = self._unseen(seen.said, values)
        before = known.views[pose]
        view = self.inner.update(self.inner.start(1, grid, values) if before is None else before, seen.said)
        told = views.spread(self._told(view), pose).mT
        cells = views.seen[pose].cells
        nearest = torch.minimum(
            self._distance(pose, seen),
            torch.where(known.owner[0, cells] == pose, known.closest[0, cells], torch.inf),
        )
        mine = (nearest <= known.closest[0, cells]) | (known.owner[0, cells] == pose)
        at = cells[mine]
        values, closest, owner = values.clone(), known.closest.clone(), known.owner.clone()
        values[0, at], closest[0, at], owner[0, at] = told[mine], nearest[mine], pose
        examined = known.examined.scatter(-1, seen.gaze[:, None], True)
        after = (*known.views[:pose], view, *known.views[pose + 1 :])
        return SceneBelief(values, closest, owner, examined, known.looks + 1, after)

    def _distance(self, pose: int, look: SceneLook) -> Tensor:
        """From the gaze to the cells that its view shows, `(V,)`."""
        said = look.said
        assert isinstance(said, TargetLook | MapLook)
        return self.views.distances[pose][int(said.fixated)]

    def _told(self, view: Belief) -> Tensor:
        """What is believed of a view, `(C, cells)`."""
        if isinstance(self.inner, Target):
            return torch.cat([view.probability(0), view.chance(0)])
        return view.class_probabilities()[0].mT

    def _unseen(self, look: Look, like: Tensor) -> Tensor:
        """Values `(1, S, C)` of what was never seen."""
        if isinstance(look, TargetLook) and self.prior is not None:
            return torch.full_like(like, self.prior)
        assert isinstance(look, TargetLook | MapLook)
        evidence = torch.zeros_like(look.evidence) + self.inner.model.unseen(look.evidence)
        blank = replace(look, evidence=evidence, distance=torch.ones_like(look.distance), score=0 * look.score)
        told = self._told(self.inner.update(self.inner.start(1, self.views.view_grid, like), blank))
        # Not the cell that counts as fixated.
        return told.median(-1).values.expand_as(like).clone()
