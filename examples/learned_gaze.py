"""Learn where to look: a small network values the cells, and learns from rewards alone (policy gradient).

The network reads the belief about the target: how probable it is in each cell and around it, where the gaze has been,
and how many gaze shifts were made. Before training it values all cells alike, which is random gaze. A search that finds
its target after n gaze shifts is worth 0.9 ** n. The looks from all cells are stored first, so that searches take no
time of the detector.

Run it from a checkout: python -m examples.learned_gaze
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

import semfov
from semfov.episode import Step, StoredLooks
from semfov.gaze import Choice, Greedy, Softmax
from semfov.gaze.acquisition import AcquisitionFunction, TargetPosterior, Uniform
from semfov.sensor import named_sensor

COLUMNS, ROWS = 8, 6  # cells of the map
SHIFTS = 8  # gaze shifts at most
DISCOUNT = 0.9  # factor by which each gaze shift lowers the value of a search

Maker = Callable[[Tensor], AcquisitionFunction]
"""Makes an acquisition function for the targets `(A,)` of the episodes that still run."""


class LearnedValue(AcquisitionFunction):
    """Values of the cells by a network, from the belief in a neighbourhood of 5 × 5 cells.

    Args:
        network: maps five features of the cells, `(B, 5, Y, X)`, to their values `(B, 1, Y, X)`.
        target: classes `(B,)` to search for.
    """

    def __init__(self, network: nn.Module, target: Tensor) -> None:
        super().__init__()
        self.network = network
        self.target = target

    def forward(self, belief: semfov.Belief, visited: Tensor) -> Tensor:
        """Compute the values of all cells, `(B, X·Y)`."""
        present = belief.probability(self.target).clamp(min=1e-9).log()
        best = present.masked_fill(visited, -torch.inf).amax(-1, keepdim=True)
        fixated = visited.to(present)
        shifts = (fixated.sum(-1, keepdim=True) / SHIFTS).expand_as(present)
        mean = present.mean(-1, keepdim=True)
        features = torch.stack([present - best, present - mean, belief.closest, fixated, shifts], 1)
        values: Tensor = self.network(features.unflatten(-1, (-1, COLUMNS)))
        return values.flatten(1)


def gaze_network(width: int = 8) -> nn.Module:
    """Make the network of `LearnedValue`; before training it values all cells alike."""
    last = nn.Conv2d(width, 1, 1)
    nn.init.zeros_(last.weight)
    return nn.Sequential(
        nn.Conv2d(5, width, 3, padding=1),
        nn.GELU(),
        nn.Conv2d(width, width, 3, padding=1),
        nn.GELU(),
        last,
    )


@dataclass(frozen=True)
class Searches:
    """Searches in one scene for each of its classes, from every cell without an object of the class."""

    looks: StoredLooks  # detections from every cell
    targets: Tensor  # (B,), classes to search for
    start: Tensor  # (B,), first cells
    goal: Tensor  # (B, X·Y), whether an object of the class overlaps the cell


def searches_in(scenes: semfov.EmbeddedScenes, eye: semfov.Eye) -> list[Searches]:
    """Look at every scene from all cells, and list its searches."""
    searches = []
    for index in range(len(scenes)):
        scene = scenes[index]
        grid = semfov.Grid(COLUMNS, ROWS, scene.size)
        with torch.no_grad():
            detections = eye(scene.image[None], grid.centres)
        classes = torch.tensor(scenes.targets(index))
        covered = grid.footprint(scene.boxes)
        goals = torch.stack([covered[scene.labels == target].any(0) for target in classes])
        number, start = (~goals).nonzero(as_tuple=True)
        targets = classes[number]
        looks = StoredLooks(detections, grid, targets)
        searches.append(Searches(looks, targets, start, goals[number]))
    return searches


def run(searches: Searches, observer: semfov.observers.Observer, make: Maker, choice: Choice) -> tuple[Tensor, Tensor]:
    """Run all searches in a scene.

    Args:
        searches: the searches.
        observer: turns looks into a belief.
        make: makes the acquisition function for targets `(A,)`.
        choice: chooses the next cell.

    Returns:
        The gaze shift that found each target, `(B,)`, with `SHIFTS + 1` for none; and the logarithm of the probability
        of all choices in a search if they are drawn from a softmax over the values, `(B,)`.
    """

    def is_found(step: Step) -> Tensor:
        """Tell which of the episodes of a step reach an object of their class by it."""
        return searches.goal[step.episodes, step.next_cell]

    shifts = torch.full_like(searches.start, SHIFTS + 1)
    logarithm = torch.zeros(len(searches.start))
    steps = semfov.rollout(
        searches.looks,
        observer,
        lambda episodes, _: make(searches.targets[episodes]),
        searches.start,
        choice,
        most=SHIFTS,
        ends=is_found,
    )
    for step in steps:
        shifts[step.episodes[is_found(step)]] = step.shift + 1
        # ln of the softmax over the cells that were not visited, of the cell that was drawn.
        shares = step.values.masked_fill(step.visited, -torch.inf).log_softmax(-1)
        share_of_choice = shares.gather(-1, step.next_cell[:, None])[:, 0]
        logarithm = logarithm.index_add(0, step.episodes, share_of_choice)
    return shifts, logarithm


def train(
    network: nn.Module,
    scenes: Sequence[Searches],
    observer: semfov.observers.Observer,
    noise: Callable[[int, Tensor], Tensor],
    steps: int,
) -> None:
    """Train a network by the policy gradient: choices of searches that were worth more than the mean get likelier."""
    optimiser = torch.optim.Adam(network.parameters(), lr=0.01)
    choice = Softmax(noise, 1.0)
    for step in range(steps):
        searches = scenes[step % len(scenes)]
        shifts, logarithm = run(searches, observer, lambda target: LearnedValue(network, target), choice)
        value = torch.where(shifts <= SHIFTS, DISCOUNT**shifts, 0.0)
        advantage = value - value.mean()
        optimiser.zero_grad()
        (-advantage * logarithm).mean().backward()
        optimiser.step()
        if step % 25 == 0:
            print(f"step {step:3d}: mean value of a search {float(value.mean()):.2f}")


def main() -> None:
    """Train in some embedded scenes, and compare with random gaze and the non-predictive policy in others."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=int, default=6, help="training scenes, and as many test scenes (default: 6)")
    parser.add_argument("--steps", type=int, default=120, help="steps of Adam (default: 120)")
    arguments = parser.parse_args()
    torch.manual_seed(0)
    detector = semfov.load_detector("yolox-nano")
    eye = semfov.Eye(named_sensor("gradual"), detector).requires_grad_(False)
    observer = semfov.observers.Semantic(len(detector.classes) + 1, tempering=0.25, footprint="box_centre")
    count = arguments.scenes
    training = searches_in(semfov.EmbeddedScenes(detector.classes, count=count, seed=1), eye)
    test = searches_in(semfov.EmbeddedScenes(detector.classes, count=count, seed=2), eye)
    network = gaze_network()
    generator = torch.Generator().manual_seed(0)

    def noise(shift: int, episodes: Tensor) -> Tensor:
        return torch.rand(len(episodes), COLUMNS * ROWS, generator=generator)

    train(network, training, observer, noise, arguments.steps)
    policies: dict[str, Maker] = {
        "random": lambda _: Uniform(),
        "learned": lambda target: LearnedValue(network, target),
        "non-predictive": TargetPosterior,
    }
    for name, make in policies.items():
        with torch.no_grad():
            shifts = torch.cat([run(searches, observer, make, Greedy(noise))[0] for searches in test])
        shares = ", ".join(f"{100 * float((shifts <= n).float().mean()):.0f} % within {n}" for n in (1, 3, SHIFTS))
        print(f"{name}: of {len(shifts)} targets in other scenes, gaze shifts find {shares}")


if __name__ == "__main__":
    main()
