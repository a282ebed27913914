"""Whole searches as differentiable functions of the policy: look, believe, choose softly, look again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov import Eye, Grid
from semfov.agent import step
from semfov.belief import DirichletBelief, SemanticObserver
from semfov.data.scene import Scenes
from semfov.eye import View
from semfov.gaze.learned import LearnedGaze
from semfov.gaze.relaxation import soft_fixation


@dataclass(frozen=True)
class Searches:
    """Searches in one photograph.

    Attributes:
        view: the photograph, as the eye holds it.
        grid: the cells over it.
        targets: `(F,)`, classes to search for.
        goal: `(F, X·Y)` boolean, cells that an object of the class overlaps.
        start: `(F,)`, first cells, none of them in the goal.
        classes: `(K,)`, all classes that may be searched for in the photograph.
        goals: `(K, X·Y)` boolean, cells that their objects overlap.
    """

    view: View
    grid: Grid
    targets: Tensor
    goal: Tensor
    start: Tensor
    classes: Tensor
    goals: Tensor


@dataclass(frozen=True)
class Relaxation:
    """How searches are made differentiable, and what their loss weighs.

    Attributes:
        shifts: gaze shifts of a search, at most.
        window: shifts that a gradient flows through; at the border of two windows the belief is a constant
            (truncated backpropagation through time).
        temperature: of the Gumbel-softmax.
        discount: γ, weight of a shift against the one before.
        posterior: weight of the belief's term.
        others: weight of the classes that are not searched for.
        hard: straight-through fixations, or soft points between the cells.
    """

    shifts: int = 9
    window: int = 3
    temperature: float = 1.0
    discount: float = 0.9
    posterior: float = 0.3
    others: float = 1.0
    hard: bool = True


def draw_searches(
    eye: Eye, scenes: Scenes, index: int, grid: tuple[int, int], count: int, generator: torch.Generator
) -> Searches | None:
    """So many searches in a photograph, targets and starts at random; None where nothing can be searched for."""
    annotation = scenes.annotation(index)
    cells = Grid(*grid, annotation.size)
    covered = cells.footprint(annotation.boxes)
    goals = {target: covered[annotation.labels == target].any(0) for target in scenes.targets(index)}
    goals = {target: goal for target, goal in goals.items() if goal.any() and not goal.all()}
    if not goals:
        return None
    known, places = torch.tensor(list(goals)), torch.stack(list(goals.values()))
    drawn = torch.randint(len(known), (count,), generator=generator)
    start = torch.multinomial((~places[drawn]).float(), 1, generator=generator)[:, 0]
    view = eye.open(scenes[index].image[None])
    return Searches(view, cells, known[drawn], places[drawn], start, known, places)


def backpropagate(
    gaze: LearnedGaze, eye: Eye, searches: Searches, noise: Tensor, how: Relaxation, share: float = 1.0
) -> float:
    """Add the gradient of `share` times the mean loss of the searches to the parameters; returns that loss.

    Args:
        gaze: the policy.
        eye: sensor and detector.
        searches: in one photograph.
        noise: `(shifts, F, X·Y)`, uniform in [0, 1).
        how: settings.
        share: weight of these searches in a batch.
    """
    total = 0.0

    def finish(loss: Tensor) -> None:
        nonlocal total
        loss = share * loss
        if loss.requires_grad:
            loss.backward()
        total += float(loss.detach())

    unroll(gaze, eye, searches, noise, how, finish)
    return total


def unroll(
    gaze: LearnedGaze,
    eye: Eye,
    searches: Searches,
    noise: Tensor,
    how: Relaxation,
    finish: Callable[[Tensor], None],
) -> None:
    r"""Search, and hand the loss of every window of shifts to `finish`, after which nothing refers to it any more.

    .. math:: L = \sum_t \gamma^{t-1} \left( -\ln \sum_{x \in \text{goal}} \mathrm{softmax}(\ell_t)(x)
              - w \ln \frac{\sum_{x \in \text{goal}} p_t(x)}{\sum_x p_t(x)} \right),

    the first term for the chance that the next fixation lands on the target, the second for what the looks so far have
    made of the belief: its gradient comes by way of the views alone. A search ends on its target. The loss is the
    mean over searches.

    The belief is about all classes, so the same looks teach where to look for the others, too: the mean of their first
    terms is added, without a gradient through the fovea, which is not moved for them.
    """
    grid, count = searches.grid, len(searches.targets)
    observer = gaze.observer(len(eye.detector.classes) + 1)
    like = searches.view.bands.base
    centres = grid.centres.to(like)
    belief = observer.start(count, grid, like)
    visited = torch.zeros_like(searches.goal)
    active, cell = torch.arange(count), searches.start
    fixation = centres[cell]
    loss = like.new_zeros(())
    for shift in range(how.shifts):
        goal, target = searches.goal[active], searches.targets[active]
        belief = _look(observer, eye, searches, belief, fixation)
        visited = visited.scatter(-1, cell[:, None], True)
        logits = gaze(belief, visited, target, grid.columns)
        hit = log_share(logits.masked_fill(visited, -torch.inf), goal)
        present = belief.probability(target)
        weight = how.discount**shift / count
        loss = loss - weight * (hit + how.posterior * log_share(present.log(), goal)).sum()
        if how.others > 0:
            loss = loss + weight * how.others * others_loss(gaze, searches, belief, visited, target)
        drawn = noise[shift, active]
        fixation, cell = soft_fixation(logits, visited, centres, drawn, temperature=how.temperature, hard=how.hard)
        if not how.hard:
            cell = grid.cell_of(fixation.detach())
        left = ~goal.gather(1, cell[:, None])[:, 0] & ~visited.all(-1)
        active, cell, fixation, belief, visited = active[left], cell[left], fixation[left], belief[left], visited[left]
        last = shift == how.shifts - 1 or not len(active)
        if last or (shift + 1) % how.window == 0:
            finish(loss)
            loss, fixation = like.new_zeros(()), fixation.detach()
            belief = DirichletBelief(belief.beta.detach(), belief.closest.detach())
        if last:
            return


def others_loss(
    gaze: LearnedGaze, searches: Searches, belief: DirichletBelief, visited: Tensor, target: Tensor
) -> Tensor:
    """Sum over searches of the mean first term of the loss for classes other than `target`, not yet found."""
    found = (searches.goals & visited[:, None]).any(-1)
    row, other = (~found & (searches.classes != target[:, None])).nonzero(as_tuple=True)
    if not len(row):
        return belief.beta.new_zeros(())
    constant = DirichletBelief(belief.beta.detach()[row], belief.closest.detach()[row])
    logits = gaze(constant, visited[row], searches.classes[other], searches.grid.columns)
    hit = log_share(logits.masked_fill(visited[row], -torch.inf), searches.goals[other])
    return -(hit / torch.bincount(row)[row]).sum()


def log_share(log_weights: Tensor, goal: Tensor) -> Tensor:
    """Logarithm of the goal's share in weights `(B, X·Y)`, `(B,)`; an empty goal (all of it visited) gives 0."""
    inside = log_weights.masked_fill(~goal, -torch.inf)
    open_goal = inside.isfinite().any(-1)
    inside = torch.where(open_goal[:, None], inside, 0.0)
    return torch.where(open_goal, inside.logsumexp(-1) - log_weights.logsumexp(-1), 0.0)


@torch.no_grad()
def found_at(gaze: LearnedGaze, eye: Eye, searches: Searches, noise: Tensor) -> Tensor:
    """Gaze shift at which each search finds its target as an agent makes it, `(F,)`; one more than `noise` allows for
    where it does not."""
    grid, count = searches.grid, len(searches.targets)
    observer = gaze.observer(len(eye.detector.classes) + 1)
    belief = observer.start(count, grid, searches.view.bands.base)
    visited = torch.zeros_like(searches.goal)
    found = torch.full((count,), len(noise) + 1)
    active, cell = torch.arange(count), searches.start
    for shift in range(len(noise)):
        fixation = grid.centres[cell]
        seen = observer.weigh(eye.look(searches.view, fixation), fixation, grid)
        policy = gaze.policy(searches.targets[active], grid)
        after = step(observer, belief, visited, cell, seen, policy, noise[shift, active])
        hit = searches.goal[active].gather(1, after.cell[:, None])[:, 0]
        found[active[hit]] = shift + 1
        active, cell, belief, visited = active[~hit], after.cell[~hit], after.belief[~hit], after.visited[~hit]
        if not len(active):
            break
    return found


def _look(
    observer: SemanticObserver, eye: Eye, searches: Searches, belief: DirichletBelief, fixation: Tensor
) -> DirichletBelief:
    """The belief after a look of every search from `fixation` `(F, 2)`."""
    detections = eye.look(searches.view, fixation)
    return observer.update(belief, observer.weigh(detections, fixation, searches.grid))
