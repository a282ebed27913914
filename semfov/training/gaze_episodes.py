"""Whole searches as differentiable functions of the policy: look, update the belief, choose softly, look again."""

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
    """F searches in one photograph.

    Attributes:
        view: the photograph, opened by the eye.
        grid: the grid of cells.
        targets: `(F,)`, classes to search for.
        goal: `(F, X·Y)` boolean, cells that an object of the target class overlaps.
        start: `(F,)`, first cells. None of them is a goal cell.
        classes: `(K,)`, all classes that may be searched for in the photograph.
        goals: `(K, X·Y)` boolean, cells that the objects of these classes overlap.
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
    """Settings of differentiable searches and of their loss.

    Attributes:
        shifts: maximum number of gaze shifts in a search.
        window: number of gaze shifts that a gradient flows through. Between two windows the belief is treated as a
            constant (truncated backpropagation through time).
        temperature: temperature of the Gumbel-softmax.
        discount: γ, discount factor of the loss per gaze shift.
        posterior: w, weight of the loss term for the belief.
        others: weight of the loss term for classes that are not searched for.
        hard: use straight-through fixations (True), or soft points between the cells (False).
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
    """Draw searches in a photograph with random targets and starting points.

    Args:
        eye: the sensor and the detector.
        scenes: the photographs.
        index: index of the photograph.
        grid: columns and rows of the grid.
        count: number of searches.
        generator: source of random numbers.

    Returns:
        The searches, or None if the photograph contains no class to search for.
    """
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
    """Add the gradient of `share` times the mean loss of the searches to the parameters.

    Args:
        gaze: the policy.
        eye: the sensor and the detector.
        searches: the searches in one photograph.
        noise: `(shifts, F, X·Y)`, random numbers, uniform in [0, 1).
        how: settings of the searches.
        share: weight of these searches in a batch.

    Returns:
        The loss, multiplied by `share`.
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
    r"""Run the searches and pass the loss of every window of gaze shifts to `finish`.

    .. math:: L = \sum_t \gamma^{t-1} \left( -\ln \sum_{x \in \text{goal}} \mathrm{softmax}(\ell_t)(x)
              - w \ln \frac{\sum_{x \in \text{goal}} p_t(x)}{\sum_x p_t(x)} \right),

    with the policy's logits ℓ and the belief's probabilities p of the target. The first term is the probability that
    the next fixation lands on the target. The second term rewards fixations that concentrate the belief on the target;
    its gradient flows through the foveated views alone. A search ends on its target. The loss is the mean over
    searches.

    The belief covers all classes, so the same looks also show where to look for other classes. The mean of their first
    terms is added, without a gradient through the fovea, because the gaze does not move for them.

    Args:
        gaze: the policy.
        eye: the sensor and the detector.
        searches: the searches in one photograph.
        noise: `(shifts, F, X·Y)`, random numbers, uniform in [0, 1).
        how: settings of the searches.
        finish: receives the loss of each window. Afterwards its graph is released.
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
    """Run the searches; each of them ends when its next fixation is on its target."""
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
    """Compute the loss for classes that are not searched for and were not found yet.

    Args:
        gaze: the policy.
        searches: the searches.
        belief: the beliefs of B running searches.
        visited: `(B, X·Y)` boolean, cells that were fixated.
        target: `(B,)`, the classes that are searched for.

    Returns:
        The mean of the first loss term over these classes, summed over the searches.
    """
    found = (searches.goals & visited[:, None]).any(-1)
    row, other = (~found & (searches.classes != target[:, None])).nonzero(as_tuple=True)
    if not len(row):
        return belief.beta.new_zeros(())
    constant = DirichletBelief(belief.beta.detach()[row], belief.closest.detach()[row])
    logits = gaze(constant, visited[row], searches.classes[other], searches.grid.columns)
    hit = log_share(logits.masked_fill(visited[row], -torch.inf), searches.goals[other])
    return -(hit / torch.bincount(row)[row]).sum()


def log_share(log_weights: Tensor, goal: Tensor) -> Tensor:
    """Compute the logarithm of the goal's share of the total weight.

    Args:
        log_weights: `(B, X·Y)`, logarithms of the weights of the cells.
        goal: `(B, X·Y)` boolean, the goal cells.

    Returns:
        `(B,)`; 0 if no goal cell has a finite logarithm, because all of them were visited.
    """
    inside = log_weights.masked_fill(~goal, -torch.inf)
    open_goal = inside.isfinite().any(-1)
    inside = torch.where(open_goal[:, None], inside, 0.0)
    return torch.where(open_goal, inside.logsumexp(-1) - log_weights.logsumexp(-1), 0.0)


@torch.no_grad()
def found_at(gaze: LearnedGaze, eye: Eye, searches: Searches, noise: Tensor) -> Tensor:
    """Run the searches as an agent does, without relaxation.

    Args:
        gaze: the policy.
        eye: the sensor and the detector.
        searches: F searches.
        noise: `(shifts, F, X·Y)`, random numbers, uniform in [0, 1), for breaking ties.

    Returns:
        The gaze shift at which each search finds its target, `(F,)`; `shifts + 1` if it does not find it.
    """
    found = torch.full((len(searches.targets),), len(noise) + 1)
    choice = Greedy(lambda shift, episodes: noise[shift, episodes])
    for step in _episodes(gaze, eye, searches, choice, len(noise)):
        found[step.episodes[_lands(searches, step) & ~step.visited.all(-1)]] = step.shift + 1
    return found
