"""Whole searches as differentiable functions of the policy: look, believe, choose softly, look again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from semfov.belief.belief import DirichletBelief, dirichlet_belief
from semfov.belief.grid import Grid
from semfov.data.scene import Scenes
from semfov.episode import LiveLooks, Step, rollout
from semfov.eye import Eye, View
from semfov.gaze.choice import Choice, Greedy, Relaxed
from semfov.gaze.learned import LearnedGaze
from semfov.gaze.policies import Learned


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
    count = len(searches.targets)
    loss = searches.view.canvas.new_zeros(())
    choice = Relaxed(
        lambda shift, episodes: noise[shift, episodes],
        searches.grid.cell_of,
        temperature=how.temperature,
        hard=how.hard,
    )
    for step in _episodes(gaze, eye, searches, choice, how.shifts, how.window):
        goal, target = searches.goal[step.episodes], searches.targets[step.episodes]
        hit = log_share(step.values.masked_fill(step.visited, -torch.inf), goal)
        present = step.belief.probability(target)
        weight = how.discount**step.shift / count
        loss = loss - weight * (hit + how.posterior * log_share(present.log(), goal)).sum()
        if how.others > 0:
            others = others_loss(gaze, searches, dirichlet_belief(step.belief), step.visited, target)
            loss = loss + weight * how.others * others
        if (step.shift + 1) % how.window == 0:
            finish(loss)
            loss = torch.zeros_like(loss)
    if loss.requires_grad:
        finish(loss)


def _episodes(
    gaze: LearnedGaze, eye: Eye, searches: Searches, choice: Choice, most: int, window: int | None = None
) -> Iterator[Step]:
    """Steps of the searches, each of which ends when its next fixation is on its target."""
    policy = Learned(gaze)
    return rollout(
        LiveLooks(eye, searches.view, searches.grid),
        gaze.observer(len(eye.detector.classes) + 1),
        lambda episodes, _: policy(searches.targets[episodes], searches.grid),
        searches.start,
        choice,
        most=most,
        ends=lambda step: _lands(searches, step),
        window=window,
    )


def _lands(searches: Searches, step: Step) -> Tensor:
    return searches.goal[step.episodes].gather(1, step.next_cell[:, None])[:, 0]


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
    found = torch.full((len(searches.targets),), len(noise) + 1)
    choice = Greedy(lambda shift, episodes: noise[shift, episodes])
    for step in _episodes(gaze, eye, searches, choice, len(noise)):
        found[step.episodes[_lands(searches, step) & ~step.visited.all(-1)]] = step.shift + 1
    return found
